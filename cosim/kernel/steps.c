/* The couplings of Co-Simulation: between two communication points every component solves itself. */
#include <string.h>

#include "fmi_calls.h"

/* A step of a component, with its events on the way. */
static bool one_step(Agent *agent, int c, double time, double step) {
    double start = time, end = time + step, length = step, reached;
    bool uses_events = agent->components[c].uses_events, needed, early;
    for (int i = 0; i < EVENTS_PER_STEP; i++) {
        if (!step_once(agent, c, start, length, &needed, &early, &reached)) return false;
        if (needed && uses_events && !(change_mode(agent, c, ENTER_EVENT_MODE) && leave_events(agent, c))) return false;
        if (!early || (uses_events && end - reached <= SHORTEST * step)) return true;
        if (!uses_events) return fail(agent, (Failure){.reason = EARLY_RETURN, .component = c, .value = reached});
        start = reached, length = end - reached;
    }
    return fail(agent, (Failure){.reason = TOO_MANY_EVENTS, .component = c});
}

/* A micro step of a component, or half of one, in as many steps of its own as it makes. */
static bool do_step(Agent *agent, int c, double time, double step, int halved) {
    int parts = agent->components[c].parts[halved];
    double length = step / (double)parts;
    for (int i = 0; i < parts; i++)
        if (!one_step(agent, c, time + (double)i * length, length)) return false;
    return true;
}

/* Set the connected inputs of a component, in Event Mode where it takes them there only. */
static bool set_inputs(Agent *agent, int c, const double *source) {
    bool discrete = agent->components[c].discrete;
    return (!discrete || change_mode(agent, c, ENTER_EVENT_MODE)) && carry_out(agent, agent->inputs[c], source) &&
           (!discrete || leave_events(agent, c));
}

static bool jacobi(Agent *agent, double t, double h) {
    for (int c = 0; c < agent->n_components; c++)
        if (!set_inputs(agent, c, agent->signals) || !do_step(agent, c, t, h, 0)) return false;
    for (int c = 0; c < agent->n_components; c++)
        if (!carry_out(agent, agent->outputs[c], agent->signals)) return false;
    return true;
}

static bool gauss_seidel(Agent *agent, double t, double h) {
    for (int c = 0; c < agent->n_components; c++)
        if (!set_inputs(agent, c, agent->signals) || !do_step(agent, c, t, h, 0) ||
            !carry_out(agent, agent->outputs[c], agent->signals))
            return false;
    return true;
}

/* Inputs of component `c`: outputs of components that have stepped already from `earlier`, the others extrapolated. */
static bool set_mixed_inputs(Agent *agent, int c, const double *earlier) {
    for (int32_t i = 0; i < agent->n_signals; i++) {
        bool stepped = agent->owner[i] >= 0 && agent->owner[i] < c;
        agent->source[i] = stepped ? earlier[i] : agent->middle[i];
    }
    return set_inputs(agent, c, agent->source);
}

static bool midpoint_component(Agent *agent, int c, double t, double h) {
    if (!agent->components[c].reads_earlier)
        return set_inputs(agent, c, agent->middle) && do_step(agent, c, t, h, 0);
    double half = 0.5 * h;
    return set_mixed_inputs(agent, c, agent->before) && do_step(agent, c, t, half, 1) &&
           set_mixed_inputs(agent, c, agent->signals) && do_step(agent, c, t + half, half, 1);
}

/* The weight of an output's last change at the middle of a step: cosim/agents/extrapolation.py says why. */
static double middle_weight(double step, double previous_step) {
    if (previous_step <= 0.0) return 0.0;
    double ratio = step / previous_step;
    return ratio <= LONGER ? 0.5 * ratio : LONGER / ratio;
}

static bool midpoint(Agent *agent, double t, double h) {
    size_t bytes = (size_t)agent->n_signals * sizeof(double);
    double weight = middle_weight(h, agent->steps[0]);
    if (bytes > 0) memcpy(agent->before, agent->signals, bytes);
    for (int32_t i = 0; i < agent->n_signals; i++)
        agent->middle[i] = agent->continuous[i]
                               ? agent->before[i] + weight * (agent->before[i] - agent->previous[i])
                               : agent->before[i];
    for (int c = 0; c < agent->n_components; c++)
        if (!midpoint_component(agent, c, t, h) || !carry_out(agent, agent->outputs[c], agent->signals)) return false;
    if (bytes > 0) memcpy(agent->previous, agent->before, bytes);
    agent->steps[0] = h;
    return true;
}

bool step_components(Agent *agent, int64_t start_ns, int64_t end_ns) {
    double h;
    int64_t n = micro_steps(agent, start_ns, end_ns, &h);
    double start = to_seconds(start_ns);
    for (int64_t i = 0; i < n; i++) {
        double t = start + (double)i * h;
        *agent->time = t;
        bool ok = agent->method == JACOBI         ? jacobi(agent, t, h)
                  : agent->method == GAUSS_SEIDEL ? gauss_seidel(agent, t, h)
                                                  : midpoint(agent, t, h);
        if (!ok) return false;
    }
    return true;
}
