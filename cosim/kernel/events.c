/* Ticks, arrivals and time events: Event Mode of Model Exchange (FMI 3.0, section 2.3.5). */
#include <string.h>

#include "fmi_calls.h"

bool enter_event_mode(Agent *agent) {
    for (int c = 0; c < agent->n_components; c++)
        if (!change_mode(agent, c, ENTER_EVENT_MODE)) return false;
    return true;
}

static bool update_discrete_states(Agent *agent, int component, double *next_event) {
    for (int i = 0; i < DISCRETE_STATE_ITERATIONS; i++) {
        bool again;
        if (!update_once(agent, component, &again, next_event)) return false;
        if (!again) return true;
    }
    return fail(agent, (Failure){.reason = DISCRETE_STATES_UNSETTLED, .component = component});
}

/* Whether the signals are as they were; continuous ones, as far as a loop that was solved again can tell. */
static bool settled(const Agent *agent) {
    for (int32_t i = 0; i < agent->n_signals; i++) {
        double now = agent->signals[i], before = agent->before[i];
        bool close = fabs(now - before) <= SETTLED * fmax(fabs(now), fabs(before));
        if (!(now == before || (close && agent->continuous[i]))) return false;
    }
    return true;
}

bool iterate_events(Agent *agent) {
    bool done = false;
    if (!carry_out(agent, agent->propagate, agent->signals)) return false;
    for (int i = 0; !done && i < EVENT_ITERATIONS; i++) {
        for (int c = 0; c < agent->n_components; c++)
            if (!update_discrete_states(agent, c, &agent->next_event[c])) return false;
        memcpy(agent->before, agent->signals, (size_t)agent->n_signals * sizeof(double));
        if (!carry_out(agent, agent->propagate, agent->signals)) return false;
        done = settled(agent);
    }
    if (!done) return fail(agent, (Failure){.reason = EVENTS_UNSETTLED});
    for (int c = 0; c < agent->n_components; c++)
        if (!change_mode(agent, c, ENTER_CONTINUOUS_TIME_MODE)) return false;
    return true;
}

bool leave_events(Agent *agent, int component) {
    double next_event;
    return update_discrete_states(agent, component, &next_event) && change_mode(agent, component, ENTER_STEP_MODE);
}

static bool listen_between_steps(Agent *agent) {
    for (int c = 0; c < agent->n_components; c++)
        if (agent->components[c].uses_events && !change_mode(agent, c, ENTER_EVENT_MODE)) return false;
    if (!carry_out(agent, agent->listen, agent->signals)) return false;
    for (int c = 0; c < agent->n_components; c++)
        if (agent->components[c].uses_events && !leave_events(agent, c)) return false;
    return true;
}

bool handle_event(Agent *agent, int64_t time_ns, bool listen) {
    *agent->time = to_seconds(time_ns);
    if (agent->method != JOINT) return !listen || listen_between_steps(agent);
    return enter_event_mode(agent) && (!listen || carry_out(agent, agent->listen, agent->signals)) &&
           iterate_events(agent);
}
