/* State events: where an event indicator changes its sign, found to the nanosecond as cosim/agents/crossings.py does. */
#include <math.h>
#include <stddef.h>

#include "kernel.h"

int64_t cautious_step(int64_t step_ns) { return step_ns / FIRST_PART > 1 ? step_ns / FIRST_PART : 1; }

int64_t less_cautious(int64_t cautious_ns, int64_t step_ns) {
    return cautious_ns * GROWTH < step_ns ? cautious_ns * GROWTH : 0;
}

bool has_crossed(double before, double after) { return (before > 0.0) != (after > 0.0); }

bool any_crossed(const Agent *agent, const double *before, const double *after) {
    for (int32_t i = 0; i < agent->n_indicators; i++)
        if (has_crossed(before[i], after[i])) return true;
    return false;
}

Bracket bracket(double start, double reached, int64_t start_ns, int64_t end_ns, bool final) {
    int64_t low = (int64_t)floor(start * NANOSECONDS_PER_SECOND);
    if (low < start_ns) low = start_ns;
    if (low > end_ns - 1) low = end_ns - 1;
    int64_t high = end_ns;
    if (!final) {
        high = (int64_t)floor(reached * NANOSECONDS_PER_SECOND) + 1;
        if (high > end_ns) high = end_ns;
    }
    return (Bracket){low, high > low + 1 ? high : low + 1};
}

/* The first whole nanosecond after the earliest zero of the secants, strictly between both ends. */
static int64_t secant(const Agent *agent, Bracket ends, double weight_low, double weight_high, const double *before,
                      const double *after) {
    double share = 1.0;
    for (int32_t i = 0; i < agent->n_indicators; i++) {
        if (!has_crossed(before[i], after[i])) continue;
        double left = fabs(weight_low * before[i]), right = fabs(weight_high * after[i]);
        double part = left + right > 0.0 ? left / (left + right) : 0.0;
        if (part < share) share = part; /* false for what is no number */
    }
    int64_t length = ends.high - ends.low;
    int64_t offset = (int64_t)ceil(share * (double)length);
    if (offset < 1) offset = 1;
    if (offset > length - 1) offset = length - 1;
    return ends.low + offset;
}

/* The first two rows of `indicators` are those of both ends of the bracket; the first is left as it is. */
bool first_crossing(Agent *agent, Bracket ends, Evaluate evaluate, const void *step, int64_t *found_ns) {
    double *row[4];
    for (int i = 0; i < 4; i++) row[i] = agent->indicators + (size_t)i * (size_t)agent->n_indicators;
    double *before = row[0], *after = row[1], *found = row[2];
    double weight_low = 1.0, weight_high = 1.0;
    bool raised = false, lowered = false;
    for (int rounds = 1; ends.high - ends.low > 1; rounds++) {
        int64_t guess = rounds % 3 == 0 ? ends.low + (ends.high - ends.low) / 2
                                        : secant(agent, ends, weight_low, weight_high, before, after);
        if (!evaluate(agent, step, guess, found)) return false;
        if (any_crossed(agent, before, found)) {
            ends.high = guess, weight_high = 1.0;
            double *free = after;
            after = found, found = free;
            weight_low = lowered ? 0.5 * weight_low : 1.0;
            raised = false, lowered = true;
        } else {
            ends.low = guess, weight_low = 1.0;
            double *free = before == row[0] ? row[3] : before;
            before = found, found = free;
            weight_high = raised ? 0.5 * weight_high : 1.0;
            raised = true, lowered = false;
        }
    }
    *found_ns = ends.high;
    return true;
}
