/* The coupling `joint`: the states of all components are integrated together.
 *
 * Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993): Runge-Kutta 4, table 1.2; the pair of
 * Dormand and Prince, table 5.2, with its step size control, section II.4. Sums run from left to right, terms of weight
 * zero included, as in the reference.
 */
#include <string.h>

#include "fmi_calls.h"

static const double DP_NODES[5] = {1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0};
static const double DP_WEIGHTS[5][5] = {
    {1.0 / 5.0},
    {3.0 / 40.0, 9.0 / 40.0},
    {44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0},
    {19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0},
    {9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0},
};
static const double DP_RESULT[6] = {35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0};
/* Weights of order 5 less those of the embedded order 4. */
static const double DP_ERROR[7] = {71.0 / 57600.0,      0.0,          -71.0 / 16695.0, 71.0 / 1920.0,
                                   -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0};

static double *stage(const Agent *agent, int number) { return agent->stages + (size_t)number * (size_t)agent->n_states; }

static void copy_states(const Agent *agent, double *to, const double *from) {
    if (agent->n_states > 0) memcpy(to, from, (size_t)agent->n_states * sizeof(double));
}

static bool get_all_states(Agent *agent) {
    for (int c = 0; c < agent->n_components; c++)
        if (!get_states(agent, c, agent->states + agent->components[c].first_state)) return false;
    return true;
}

/* Bring all components to a time and the joint states `x`. */
static bool place(Agent *agent, double time, const double *x) {
    for (int c = 0; c < agent->n_components; c++)
        if (!set_time(agent, c, time) || !set_states(agent, c, x + agent->components[c].first_state)) return false;
    return true;
}

/* Derivatives of all states, with outputs carried to inputs in between. */
static bool derivatives(Agent *agent, double time, const double *x, double *result) {
    *agent->time = time;
    if (!place(agent, time, x) || !carry_out(agent, agent->follow, agent->signals)) return false;
    for (int c = 0; c < agent->n_components; c++)
        if (!get_derivatives(agent, c, result + agent->components[c].first_state)) return false;
    return true;
}

static bool states_are_finite(Agent *agent, const double *x) {
    for (int c = 0; c < agent->n_components; c++) {
        const Component *component = &agent->components[c];
        for (int32_t i = 0; i < component->n_states; i++)
            if (!isfinite(x[component->first_state + i]))
                return fail(agent, (Failure){.reason = STATE_NOT_FINITE, .component = c, .index = i});
    }
    return true;
}

static bool get_all_indicators(Agent *agent, double *indicators) {
    for (int c = 0; c < agent->n_components; c++) {
        const Component *component = &agent->components[c];
        double *own = indicators + component->first_indicator;
        if (!get_indicators(agent, c, own)) return false;
        for (int32_t i = 0; i < component->n_indicators; i++)
            if (isnan(own[i]))
                return fail(agent, (Failure){.reason = INDICATOR_NAN, .component = c, .index = i});
    }
    return true;
}

static bool indicators_at(Agent *agent, double time, const double *x, double *indicators) {
    *agent->time = time;
    return place(agent, time, x) && carry_out(agent, agent->follow, agent->signals) &&
           get_all_indicators(agent, indicators);
}

/* Tell all components that a step is final. */
static bool complete(Agent *agent, bool *event) {
    for (int c = 0; c < agent->n_components; c++)
        if (!completed_step(agent, c, event)) return false;
    return true;
}

/* Make a step to `agent->states` final. A component may ask for an event, which may change the states. */
static bool accept(Agent *agent, double time, bool *event) {
    *agent->time = time;
    *event = false;
    if (!states_are_finite(agent, agent->states) || !place(agent, time, agent->states)) return false;
    if (!complete(agent, event)) return false;
    return !*event || (enter_event_mode(agent) && iterate_events(agent) &&
                       get_all_indicators(agent, agent->indicators) && get_all_states(agent));
}

/* --- State events ----------------------------------------------------------------------------------------------- */

/* A step from `agent->states` to `agent->new_states`. */
typedef bool (*MakeStep)(Agent *agent, double t, double length);
typedef struct {
    MakeStep make;
    double start;
} Step;

/* Whether an event indicator crosses zero in a step to `agent->new_states`; if not, they are the next step's first. */
static bool crosses(Agent *agent, double time, bool *crossed) {
    double *before = agent->indicators, *after = before + agent->n_indicators;
    *crossed = false;
    if (agent->n_indicators == 0) return true;
    if (!states_are_finite(agent, agent->new_states) || !indicators_at(agent, time, agent->new_states, after))
        return false;
    *crossed = any_crossed(agent, before, after);
    if (!*crossed) memcpy(before, after, (size_t)agent->n_indicators * sizeof(double));
    return true;
}

static bool step_to(Agent *agent, const void *step, int64_t time_ns, double *indicators) {
    const Step *s = step;
    double time = to_seconds(time_ns);
    return s->make(agent, s->start, time - s->start) && indicators_at(agent, time, agent->new_states, indicators);
}

/* Bring all components to the state event of a step and make the step up to there final. */
static bool locate(Agent *agent, Bracket ends, Step step, Stop *stop) {
    double *before = agent->indicators, *after = before + agent->n_indicators;
    bool event = false;
    if (!first_crossing(agent, ends, step_to, &step, &stop->time_ns) || !step_to(agent, &step, stop->time_ns, after))
        return false;
    stop->component = 0;
    for (int32_t c = agent->n_components - 1; c >= 0; c--)
        for (int32_t i = 0; i < agent->components[c].n_indicators; i++) {
            int32_t at = agent->components[c].first_indicator + i;
            if (has_crossed(before[at], after[at])) stop->component = c;
        }
    return complete(agent, &event); /* there will be an event in any case */
}

/* --- Steps of equal length -------------------------------------------------------------------------------------- */

/* new_states = states + length * slope */
static double *advanced(const Agent *agent, double length, const double *slope) {
    for (int32_t i = 0; i < agent->n_states; i++) agent->new_states[i] = agent->states[i] + length * slope[i];
    return agent->new_states;
}

static bool euler_step(Agent *agent, double t, double h) {
    if (!derivatives(agent, t, agent->states, stage(agent, 0))) return false;
    advanced(agent, h, stage(agent, 0));
    return true;
}

static bool runge_kutta_step(Agent *agent, double t, double h) {
    double half = 0.5 * h, sixth = h / 6.0;
    const double *x = agent->states;
    double *k1 = stage(agent, 0), *k2 = stage(agent, 1), *k3 = stage(agent, 2), *k4 = stage(agent, 3);
    if (!derivatives(agent, t, x, k1) || !derivatives(agent, t + half, advanced(agent, half, k1), k2) ||
        !derivatives(agent, t + half, advanced(agent, half, k2), k3) ||
        !derivatives(agent, t + h, advanced(agent, h, k3), k4))
        return false;
    for (int32_t j = 0; j < agent->n_states; j++)
        agent->new_states[j] = x[j] + sixth * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]);
    return true;
}

/* After a step event at a time in seconds: whether a time event before `stop` has been scheduled, which then is the stop. */
static bool stops_earlier(const Agent *agent, double time, Stop *stop) {
    int64_t earlier_ns = next_stop(agent, time, stop->time_ns);
    if (earlier_ns >= stop->time_ns) return false;
    stop->scheduled = true;
    stop->time_ns = earlier_ns;
    return true;
}

static bool equal_steps(Agent *agent, int64_t start_ns, Stop *stop) {
    MakeStep make = agent->integrator == EULER ? euler_step : runge_kutta_step;
    double h;
    int64_t n = micro_steps(agent, start_ns, stop->time_ns, &h), i = 0;
    double start = to_seconds(start_ns), end = to_seconds(stop->time_ns);
    bool event, crossed;

    if (!get_all_states(agent)) return false;
    while (i < n) {
        bool final = i + 1 == n;
        double t = start + (double)i * h, reached = final ? end : start + (double)(i + 1) * h;
        if (!make(agent, t, h) || !crosses(agent, reached, &crossed)) return false;
        if (crossed) return locate(agent, bracket(t, reached, start_ns, stop->time_ns, final), (Step){make, t}, stop);
        copy_states(agent, agent->states, agent->new_states);
        if (!accept(agent, reached, &event)) return false;
        i++;
        if (event && stops_earlier(agent, reached, stop)) {
            start = reached, end = to_seconds(stop->time_ns), i = 0;
            n = (int64_t)fmax(1.0, ceil((end - start) / to_seconds(agent->step_ns))) * agent->refinement;
            h = (end - start) / (double)n;
        }
    }
    return true;
}

/* --- Dormand-Prince 5(4) ---------------------------------------------------------------------------------------- */

/* Weighted sum over the first `n` stages of state `i`. */
static double combine(const Agent *agent, const double *weights, int n, int32_t i) {
    double total = weights[0] * stage(agent, 0)[i];
    for (int j = 1; j < n; j++) total = total + weights[j] * stage(agent, j)[i];
    return total;
}

/* new_states = states + length * weighted sum of the first `n` stages */
static double *combined(const Agent *agent, double length, const double *weights, int n) {
    for (int32_t i = 0; i < agent->n_states; i++)
        agent->new_states[i] = agent->states[i] + length * combine(agent, weights, n, i);
    return agent->new_states;
}

/* The result is in `new_states`; the first stage is there, the last is left out. */
static bool dormand_prince_step(Agent *agent, double t, double length) {
    for (int j = 0; j < 5; j++) {
        const double *x = combined(agent, length, DP_WEIGHTS[j], j + 1);
        if (!derivatives(agent, t + DP_NODES[j] * length, x, stage(agent, j + 1))) return false;
    }
    combined(agent, length, DP_RESULT, 6);
    return true;
}

/* The largest error as a multiple of what is tolerated, NaN if any is; `worst` is the state that has it. */
static double error_ratio(const Agent *agent, double length, int32_t *worst) {
    double largest = 0.0;
    *worst = 0;
    for (int32_t i = 0; i < agent->n_states; i++) {
        double error = length * combine(agent, DP_ERROR, STAGES, i);
        double old = fabs(agent->states[i]), new = fabs(agent->new_states[i]);
        double scale = agent->absolute_tolerance + agent->relative_tolerance * (old > new ? old : new);
        double ratio = fabs(error) / scale;
        if (isnan(largest) || !(isnan(ratio) || ratio > largest)) continue;
        largest = ratio;
        *worst = i;
    }
    return largest;
}

static int owner_of_state(const Agent *agent, int32_t state) {
    int c = 0;
    while (state >= agent->components[c].first_state + agent->components[c].n_states) c++;
    return c;
}

static double step_factor(double ratio) {
    if (ratio == 0.0) return 5.0;
    if (!isfinite(ratio)) return 0.2;
    double factor = 0.9 * pow(ratio, -0.2);
    return fmin(5.0, fmax(0.2, factor));
}

static bool dormand_prince(Agent *agent, int64_t start_ns, Stop *stop) {
    double start = to_seconds(start_ns), end = to_seconds(stop->time_ns), largest = to_seconds(agent->step_ns);
    double t = start;
    double h = agent->steps[1] != 0.0 ? agent->steps[1] : largest;

    if (!get_all_states(agent) || !derivatives(agent, t, agent->states, stage(agent, 0))) return false;
    while (t < end) {
        if (h > largest) h = largest;
        bool final = t + h >= end - 1e-12 * largest;
        double length = final ? end - t : h;
        if (!dormand_prince_step(agent, t, length) ||
            !derivatives(agent, t + length, agent->new_states, stage(agent, 6)))
            return false;
        int32_t worst;
        double ratio = error_ratio(agent, length, &worst);
        if (!isfinite(ratio) && !states_are_finite(agent, agent->new_states)) return false;
        bool accepted = ratio <= 1.0;
        if (accepted) {
            bool event, crossed;
            double reached = final ? end : t + length;
            if (!crosses(agent, reached, &crossed)) return false;
            if (crossed) {
                agent->steps[1] = h;
                Bracket ends = bracket(t, reached, start_ns, stop->time_ns, final);
                return locate(agent, ends, (Step){dormand_prince_step, t}, stop);
            }
            t = reached;
            copy_states(agent, agent->states, agent->new_states);
            if (!accept(agent, t, &event)) return false;
            if (!event)
                copy_states(agent, stage(agent, 0), stage(agent, 6)); /* the last stage is the next step's first */
            else if (!derivatives(agent, t, agent->states, stage(agent, 0)))
                return false;
            if (event && stops_earlier(agent, t, stop)) end = to_seconds(stop->time_ns);
        }
        if (!accepted || !final) h = length * step_factor(ratio); /* a cut step says nothing about the next length */
        if (h < 1e-12 * largest)
            return fail(agent, (Failure){
                                   .reason = STEP_TOO_SMALL, .component = owner_of_state(agent, worst), .value = h});
    }
    agent->steps[1] = h;
    return true;
}

bool integrate_states(Agent *agent, int64_t start_ns, int64_t end_ns, Stop *stop) {
    *stop = (Stop){.time_ns = end_ns, .component = -1};
    if (agent->n_states == 0 && agent->n_indicators == 0) { /* nothing to integrate */
        bool event;
        return accept(agent, to_seconds(end_ns), &event);
    }
    if (!get_all_indicators(agent, agent->indicators)) return false;
    bool adaptive = agent->integrator == DORMAND_PRINCE && agent->n_states > 0;
    return (adaptive ? dormand_prince : equal_steps)(agent, start_ns, stop);
}
