/* From one tick to the next: the part of the loop that does not depend on the coupling. See kernel.h. */
#include "kernel.h"

#include <math.h>
#include <stddef.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

EXPORT int64_t cosim_kernel_advance(Block *block, int64_t tick, int64_t n_ticks, const Mail *mail, double *samples,
                                    double *rows);
EXPORT uint64_t cosim_kernel_sizes(void);

bool fail(Agent *agent, Failure failure) {
    agent->failure = failure;
    return false;
}

int64_t micro_steps(const Agent *agent, int64_t start_ns, int64_t end_ns, double *length) {
    int64_t n = (end_ns - start_ns + agent->step_ns - 1) / agent->step_ns * agent->refinement;
    *length = agent->grid ? to_seconds(agent->step_ns) : to_seconds(end_ns - start_ns) / (double)n;
    return n;
}

/* The first whole nanosecond that, in seconds, is not before a time (network/units.py). */
static int64_t first_nanosecond(double seconds) {
    int64_t nanoseconds = (int64_t)floor(seconds * NANOSECONDS_PER_SECOND) - 2;
    while (to_seconds(nanoseconds) < seconds) nanoseconds++;
    return nanoseconds;
}

int64_t next_stop(const Agent *agent, double start, int64_t end_ns) {
    int64_t stop_ns = end_ns;
    for (int c = 0; c < agent->n_components; c++) {
        double event = agent->next_event[c];
        if (start < event && event < to_seconds(stop_ns)) stop_ns = first_nanosecond(event);
    }
    return stop_ns;
}

static bool integrate_joint(Agent *agent, int64_t start_ns, int64_t end_ns) {
    int events = 0;
    int64_t since_ns = start_ns;
    while (start_ns < end_ns) {
        int64_t known_ns = next_stop(agent, to_seconds(start_ns), end_ns), stop_ns = known_ns;
        int64_t cautious_ns = (int64_t)agent->steps[0];
        if (cautious_ns && start_ns + cautious_ns < stop_ns) stop_ns = start_ns + cautious_ns;
        Stop stop;
        if (!integrate_states(agent, start_ns, stop_ns, &stop)) return false;
        bool located = stop.component >= 0;
        if (located) {
            if (stop.time_ns - since_ns > agent->step_ns) events = 0, since_ns = stop.time_ns;
            if (++events > STATE_EVENTS_PER_STEP)
                return fail(agent, (Failure){.reason = CHATTERING, .component = stop.component});
            agent->steps[0] = (double)cautious_step(agent->step_ns);
        } else if (cautious_ns) {
            agent->steps[0] = (double)less_cautious(cautious_ns, agent->step_ns);
        }
        bool event = located || stop.scheduled || stop.time_ns == known_ns;
        if (stop.time_ns < end_ns && event && !handle_event(agent, stop.time_ns, false)) return false;
        start_ns = stop.time_ns;
    }
    return true;
}

/* From one event to the next, breaking at time events and state events of the components. */
static bool integrate(Agent *agent, int64_t start_ns, int64_t end_ns) {
    if (start_ns >= end_ns) return true;
    return agent->method == JOINT ? integrate_joint(agent, start_ns, end_ns)
                                  : step_components(agent, start_ns, end_ns);
}

/* Whether message number `i` is fresher than what the mailbox holds of its sender (cosim/agents/mailbox.py). */
static bool is_fresh(const Agent *agent, const Mail *mail, int64_t i) {
    return (double)mail->stamp[i] > agent->signals[agent->mailbox_stamp[mail->slot[i]]];
}

static void deliver(Agent *agent, const Mail *mail, int64_t i, int64_t period_ns) {
    int64_t slot = mail->slot[i];
    for (int32_t j = 0; j < agent->width; j++)
        agent->signals[agent->mailbox_values[slot * agent->width + j]] = mail->values[i * agent->width + j];
    agent->signals[agent->mailbox_stamp[slot]] = (double)mail->stamp[i];
    agent->signals[agent->mailbox_time[slot]] = to_seconds(mail->stamp[i] * period_ns);
}

/* When an arrival takes effect: at once, or at the end of a micro step that must not be cut. */
static int64_t effect_of(const Agent *agent, int64_t start_ns, int64_t arrival_ns) {
    if (!agent->grid) return arrival_ns;
    return start_ns + (arrival_ns - start_ns + agent->step_ns - 1) / agent->step_ns * agent->step_ns;
}

/* Deliver the fresh ones among messages from `*i` on that take effect at a time; whether there are any. */
static bool deliver_at(Agent *agent, int64_t start_ns, int64_t period_ns, const Mail *mail, int64_t *i, int64_t last,
                       int64_t time_ns) {
    bool any = false;
    for (; *i < last && effect_of(agent, start_ns, mail->arrival_ns[*i]) == time_ns; ++*i) {
        if (!is_fresh(agent, mail, *i)) continue;
        deliver(agent, mail, *i, period_ns);
        any = true;
    }
    return any;
}

/* From one tick to the next with messages `first` up to `last`, breaking at each arrival that changes the mailbox;
 * afterwards the signals hold the sample of `end_ns`. */
static bool advance(Agent *agent, int64_t start_ns, int64_t period_ns, const Mail *mail, int64_t first, int64_t last) {
    int64_t time_ns = start_ns, end_ns = start_ns + period_ns, i = first;
    while (i < last) {
        int64_t effect_ns = effect_of(agent, start_ns, mail->arrival_ns[i]);
        if (effect_ns >= end_ns) break;
        if (!is_fresh(agent, mail, i)) {
            i++;
            continue;
        }
        if (!integrate(agent, time_ns, effect_ns)) return false;
        deliver_at(agent, start_ns, period_ns, mail, &i, last, effect_ns);
        if (!handle_event(agent, effect_ns, true)) return false;
        time_ns = effect_ns;
    }
    if (!integrate(agent, time_ns, end_ns) || !handle_event(agent, end_ns, false) ||
        !carry_out(agent, agent->sample, agent->signals))
        return false;
    /* What waits for the end of the last micro step comes after the sample of the tick. */
    return !deliver_at(agent, start_ns, period_ns, mail, &i, last, end_ns) || handle_event(agent, end_ns, true);
}

/* Advance members from `tick` to the next one, in their order. Which one failed, n_members for none; its kind says
 * why. */
static int64_t advance_members(const Block *block, int64_t tick, const Mail *mail, const int64_t *ends) {
    for (int64_t i = 0; i < block->n_members; i++) {
        const Member *member = &block->members[i];
        Agent *agent = member->agent;
        block->attended[2] = -1;
        block->attended[1] = member->place;
        agent->called = &block->attended[2];
        agent->components = member->components;
        agent->signals = member->signals;
        agent->previous = member->previous;
        agent->steps = member->steps;
        agent->next_event = member->next_event;
        agent->time = member->time;
        int64_t first = ends[member->place], last = ends[member->place + 1];
        if (!advance(agent, tick * block->period_ns, block->period_ns, mail, first, last)) return i;
    }
    return block->n_members;
}

static double *gather(const double *signals, const Selection *selection, double *values) {
    for (int64_t i = 0; i < selection->n; i++) values[i] = signals[selection->places[i]];
    return values + selection->n;
}

/* Advance members from `tick` over `n_ticks` periods. After each, a row of `samples` and one of `rows` are filled,
 * unless those are null. How many periods all members have advanced: if not all, then `block->failed` has failed. */
EXPORT int64_t cosim_kernel_advance(Block *block, int64_t tick, int64_t n_ticks, const Mail *mail, double *samples,
                                    double *rows) {
    for (int64_t i = 0; i < n_ticks; i++) {
        block->attended[0] = tick + i;
        block->failed = advance_members(block, tick + i, mail, mail->ends + i * block->n_receivers);
        if (block->failed < block->n_members) return i;
        if (samples) samples = gather(block->signals, &block->samples, samples);
        if (rows) rows = gather(block->signals, &block->row, rows);
    }
    return n_ticks;
}

/* Sizes of the structs that the caller fills, so that it can notice another version of the library. */
EXPORT uint64_t cosim_kernel_sizes(void) {
    return (uint64_t)sizeof(Agent) << 48 | (uint64_t)sizeof(Component) << 32 | (uint64_t)sizeof(Transfer) << 16 |
           (uint64_t)(sizeof(Failure) + sizeof(Mail) + sizeof(Member) + sizeof(Block));
}
