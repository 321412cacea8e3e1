/* The yardstick of benchmarks/coupling.py: the loop over TwoLinkArm and ArmSyncController of FMI 3.0, written by hand.
 *
 * The same FMI calls in the same order as cosim/kernel makes, with everything known when it is compiled: two components,
 * p and v from the arm to the controller, u back, one agent that hears nobody.
 */
#include <string.h>

#include "fmi3FunctionTypes.h"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { ARM_STATES = 4, CONTROLLER_STATES = 15, STATES = ARM_STATES + CONTROLLER_STATES };

typedef struct {
    void *instance;
    fmi3SetTimeTYPE *set_time;
    fmi3SetContinuousStatesTYPE *set_states;
    fmi3GetContinuousStatesTYPE *get_states;
    fmi3GetContinuousStateDerivativesTYPE *get_derivatives;
    fmi3CompletedIntegratorStepTYPE *completed_step;
    fmi3EnterEventModeTYPE *enter_event_mode;
    fmi3UpdateDiscreteStatesTYPE *update_discrete_states;
    fmi3EnterContinuousTimeModeTYPE *enter_continuous_time_mode;
    fmi3DoStepTYPE *do_step;
    fmi3GetFloat64TYPE *get;
    fmi3SetFloat64TYPE *set;
} Fmu;

typedef struct {
    Fmu arm, controller;
    fmi3ValueReference arm_p_v[2], arm_u, controller_p_v[2], controller_u;
    double p_v[4], u[2];
} Pair;

#define CHECK(call) \
    if ((call) > fmi3Warning) return 0

static int get_p_v(Pair *x) {
    CHECK(x->arm.get(x->arm.instance, x->arm_p_v, 2, x->p_v, 4));
    return 1;
}

static int get_u(Pair *x) {
    CHECK(x->controller.get(x->controller.instance, &x->controller_u, 1, x->u, 2));
    return 1;
}

static int set_p_v(Pair *x) {
    CHECK(x->controller.set(x->controller.instance, x->controller_p_v, 2, x->p_v, 4));
    return 1;
}

static int set_u(Pair *x) {
    CHECK(x->arm.set(x->arm.instance, &x->arm_u, 1, x->u, 2));
    return 1;
}

static int propagate(Pair *x) { return get_p_v(x) && set_p_v(x) && get_u(x) && set_u(x); }

static int place(Pair *x, double t, const double *states) {
    CHECK(x->arm.set_time(x->arm.instance, t));
    CHECK(x->arm.set_states(x->arm.instance, states, ARM_STATES));
    CHECK(x->controller.set_time(x->controller.instance, t));
    CHECK(x->controller.set_states(x->controller.instance, states + ARM_STATES, CONTROLLER_STATES));
    return 1;
}

static int derivatives(Pair *x, double t, const double *states, double *result) {
    if (!place(x, t, states) || !propagate(x)) return 0;
    CHECK(x->arm.get_derivatives(x->arm.instance, result, ARM_STATES));
    CHECK(x->controller.get_derivatives(x->controller.instance, result + ARM_STATES, CONTROLLER_STATES));
    return 1;
}

static int completed(Fmu *fmu) {
    fmi3Boolean event = false, stop = false;
    CHECK(fmu->completed_step(fmu->instance, true, &event, &stop));
    return !event && !stop;
}

static int update(Fmu *fmu) {
    fmi3Boolean again = false, stop = false, nominals = false, states = false, defined = false;
    double time;
    CHECK(fmu->update_discrete_states(fmu->instance, &again, &stop, &nominals, &states, &defined, &time));
    return !again && !stop;
}

static int tick_event(Pair *x) {
    CHECK(x->arm.enter_event_mode(x->arm.instance));
    CHECK(x->controller.enter_event_mode(x->controller.instance));
    if (!propagate(x)) return 0;
    for (;;) {
        double before[6], after[6];
        memcpy(before, x->p_v, sizeof x->p_v);
        memcpy(before + 4, x->u, sizeof x->u);
        if (!update(&x->arm) || !update(&x->controller) || !propagate(x)) return 0;
        memcpy(after, x->p_v, sizeof x->p_v);
        memcpy(after + 4, x->u, sizeof x->u);
        if (memcmp(before, after, sizeof before) == 0) break;
    }
    CHECK(x->arm.enter_continuous_time_mode(x->arm.instance));
    CHECK(x->controller.enter_continuous_time_mode(x->controller.instance));
    return 1;
}

/* One period of `n` steps of Runge-Kutta 4 over both, and the events of the tick. */
EXPORT int bare_joint(Pair *x, double start, double end, int n, double h) {
    double s[STATES], y[STATES], k1[STATES], k2[STATES], k3[STATES], k4[STATES];
    double half = 0.5 * h, sixth = h / 6.0;
    CHECK(x->arm.get_states(x->arm.instance, s, ARM_STATES));
    CHECK(x->controller.get_states(x->controller.instance, s + ARM_STATES, CONTROLLER_STATES));
    for (int i = 0; i < n; i++) {
        double t = start + i * h;
        if (!derivatives(x, t, s, k1)) return 0;
        for (int j = 0; j < STATES; j++) y[j] = s[j] + half * k1[j];
        if (!derivatives(x, t + half, y, k2)) return 0;
        for (int j = 0; j < STATES; j++) y[j] = s[j] + half * k2[j];
        if (!derivatives(x, t + half, y, k3)) return 0;
        for (int j = 0; j < STATES; j++) y[j] = s[j] + h * k3[j];
        if (!derivatives(x, t + h, y, k4)) return 0;
        for (int j = 0; j < STATES; j++) s[j] = s[j] + sixth * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]);
        if (!place(x, i + 1 == n ? end : start + (i + 1) * h, s)) return 0;
        if (!completed(&x->arm) || !completed(&x->controller)) return 0;
    }
    return tick_event(x);
}

static int step(Fmu *fmu, double t, double h) {
    fmi3Boolean event, stop, early;
    double reached;
    CHECK(fmu->do_step(fmu->instance, t, h, true, &event, &stop, &early, &reached));
    return !stop && !early;
}

/* One period of `n` communication steps, the arm first (Gauss-Seidel). */
EXPORT int bare_steps(Pair *x, double start, double end, int n, double h) {
    (void)end;
    for (int i = 0; i < n; i++) {
        double t = start + i * h;
        if (!set_u(x) || !step(&x->arm, t, h) || !get_p_v(x)) return 0;
        if (!set_p_v(x) || !step(&x->controller, t, h) || !get_u(x)) return 0;
    }
    return 1;
}
