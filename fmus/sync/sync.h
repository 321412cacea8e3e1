/* The synchronization scheme without the plant: observer, filters, extrapolation, synchronization term. Equations and
 * their source: ArmSyncController/README.md.
 *
 * It works on the variables of the model that includes it, under the names of ArmSyncController/model.toml. The model
 * says before, by three macros, how many axes there are and where the arrays with a number per axis are:
 *
 *   AXES(model)        how many axes there are
 *   ROW(model)         how many numbers a row of neighbour_p and neighbour_v_hat holds: at least as many
 *   AXIS(model, name)  the array `name`: `(model)->values->name`, or `(model)->arrays.name`
 *
 * So the compiler sees a constant where a model has a fixed number of axes.
 */
#ifndef SYNC_H
#define SYNC_H

#include <math.h>
#include <string.h>

#include "model.h"

enum { FOLLOWER = 1, LEADER, KNOWN_VELOCITY };
enum { RECEIVED_ESTIMATE = 1, OWN_ESTIMATE, OWN_FILTERED, OWN_FILTERED_AT_STAMP };

/* What the extrapolations that look back need of a tick. A record of the history has one after the other, by axis. */
enum { V_HAT_INTEGRAL, V_BAR_INTEGRAL, V_BAR, N_RECORDED };

static bool sync_keeps_history(const Model *model) {
    return model->values->extrapolation != RECEIVED_ESTIMATE && model->values->role != KNOWN_VELOCITY;
}

static double sync_sum_of_weights(const Model *model) {
    double sum = 0.0;
    for (int64_t j = 0; j < model->values->n_neighbours; j++) sum += model->arrays.weight[j];
    return sum;
}

static size_t sync_record_length(const Model *model) { return N_RECORDED * (size_t)AXES(model); }

static double sync_recorded_now(const Model *model, int what, int64_t i) {
    const Values *x = model->values;
    if (what == V_BAR_INTEGRAL) return AXIS(model, v_bar_integral)[i];
    if (what == V_BAR) return AXIS(model, v_bar)[i];
    return AXIS(model, v_hat_integral)[i] + AXIS(model, v_hat)[i] * (x->time - x->tick_time);
}

/* From the record of a tick; of now, if that tick's event update is still to come; of the start, if it was before. */
static double sync_recorded(const Model *model, int64_t tick, int what, int64_t i) {
    int64_t start = model->values->history_tick;
    size_t index = tick > start ? (size_t)(tick - start) : 0;
    if (index >= model->history.length / sync_record_length(model)) return sync_recorded_now(model, what, i);
    return model->history.data[index * sync_record_length(model) + (size_t)(what * AXES(model) + i)];
}

/* The integral of the estimate is that of the tick, of which `time` may be off by rounding. */
static bool sync_append_record(Model *model) {
    for (int what = 0; what < N_RECORDED; what++)
        for (int64_t i = 0; i < AXES(model); i++) {
            double number = sync_recorded_now(model, what, i);
            if (what == V_HAT_INTEGRAL) number = AXIS(model, v_hat_integral)[i];
            if (!history_append(model, &number, 1)) return false;
        }
    return true;
}

/* --- initialization --------------------------------------------------------------------------------------------- */

static bool sync_check_parameters(Model *model) {
    const Values *x = model->values;
    if (!(x->T > 0.0)) return fail(model, "T must be more than 0 s, not %.9g s", x->T);
    if (x->adaptation_sign != 1.0 && x->adaptation_sign != -1.0)
        return fail(model, "adaptation_sign must be -1 or +1, not %.9g", x->adaptation_sign);
    return true;
}

static bool sync_initialize(Model *model) {
    Values *x = model->values;
    if (!sync_check_parameters(model)) return false;
    x->coupled = sync_sum_of_weights(model) != 0.0;
    x->k = (int64_t)floor((x->time + EVENT_TOLERANCE) / x->T);
    x->tick_time = x->time;
    bool follower = x->role == FOLLOWER;
    for (int64_t i = 0; i < AXES(model); i++) {
        double v_hat = follower ? AXIS(model, v_hat_start)[i] : AXIS(model, v_d)[i];
        AXIS(model, v_hat)[i] = AXIS(model, v_hat_next)[i] = v_hat;
        AXIS(model, v_bar)[i] = follower && !x->v_bar_from_estimate ? AXIS(model, v_bar_start)[i] : v_hat;
        AXIS(model, v_bar_dot)[i] = 0.0;
        AXIS(model, v_bar_integral)[i] = 0.0;
        AXIS(model, v_hat_integral)[i] = 0.0;
        AXIS(model, eta)[i] = x->coupled ? AXIS(model, eta_start)[i] : 0.0;
        AXIS(model, psi)[i] = x->psi_from_position ? AXIS(model, p)[i] : AXIS(model, psi_start)[i];
        AXIS(model, p_initial)[i] = AXIS(model, p)[i];
    }
    for (int64_t j = 0; j < x->n_neighbours; j++) model->arrays.stamp_seen[j] = model->arrays.stamp_previous[j] = -1;
    model->history.length = 0;
    x->history_tick = x->k;
    return !sync_keeps_history(model) || sync_append_record(model);
}

/* --- observer: updatevk_leader, updatevk_follower, updatevk_f2 -------------------------------------------------- */

/* Removes the records older than every sample that any extrapolation can still start from. */
static void sync_drop_old_records(Model *model) {
    Values *x = model->values;
    int64_t oldest = x->k;
    for (int64_t j = 0; j < x->n_neighbours; j++)
        if (model->arrays.neighbour_stamp[j] < oldest) oldest = model->arrays.neighbour_stamp[j];
    int64_t surplus = oldest - x->history_tick;
    /* In blocks, so that a run of n ticks costs n moves of a record and not n times the length of the history. */
    if (surplus < 64 || (size_t)surplus * sync_record_length(model) * 2 < model->history.length) return;
    history_drop(model, (size_t)surplus * sync_record_length(model));
    x->history_tick += surplus;
}

/* Begins tick k + 1, at (k + 1) T. */
static bool sync_next_tick(Model *model) {
    Values *x = model->values;
    size_t stamps = (size_t)x->n_neighbours * sizeof(int64_t);
    double tick_time = (double)(x->k + 1) * x->T;
    for (int64_t i = 0; i < AXES(model); i++) {
        AXIS(model, v_hat_integral)[i] += AXIS(model, v_hat)[i] * (tick_time - x->tick_time);
        AXIS(model, v_hat)[i] = AXIS(model, v_hat_next)[i];
    }
    x->tick_time = tick_time;
    x->k += 1;
    if (stamps > 0) memcpy(model->arrays.stamp_previous, model->arrays.stamp_seen, stamps);
    if (!sync_keeps_history(model)) return true;
    if (!sync_append_record(model)) return false;
    sync_drop_old_records(model);
    return true;
}

/* The estimate for the next tick, from the messages that have come since the last one. */
static void sync_estimate(Model *model) {
    Values *x = model->values;
    const Arrays *a = &model->arrays;
    double count = 1.0;
    for (int64_t j = 0; j < x->n_neighbours; j++) {
        a->stamp_seen[j] = a->neighbour_stamp[j];
        if (a->neighbour_stamp[j] > a->stamp_previous[j]) count += 1.0;
    }
    if (x->role != FOLLOWER) return;
    for (int64_t i = 0; i < AXES(model); i++) {
        double sum = AXIS(model, v_hat)[i];
        for (int64_t j = 0; j < x->n_neighbours; j++)
            if (a->neighbour_stamp[j] > a->stamp_previous[j]) sum += a->neighbour_v_hat[ROW(model) * j + i];
        AXIS(model, v_hat_next)[i] = sum / count;
    }
}

/* The extrapolations that look back find a sample's time by its stamp. */
static bool sync_check_sample_times(Model *model) {
    const Values *x = model->values;
    for (int64_t j = 0; j < x->n_neighbours && sync_keeps_history(model); j++) {
        int64_t stamp = model->arrays.neighbour_stamp[j];
        double time = model->arrays.neighbour_time[j], expected = (double)stamp * x->T;
        if (stamp >= 0 && fabs(time - expected) > 1e-9 * fmax(1.0, expected))
            return fail(model, "neighbour_time[%lld] is %.9g s, but a sample of tick %lld was taken at %.9g s: T must be "
                        "the period of the messages", (long long)j + 1, time, (long long)stamp, expected);
    }
    return true;
}

static double sync_next_event(const Model *model) { return (double)(model->values->k + 1) * model->values->T; }

static bool sync_update(Model *model) {
    Values *x = model->values;
    if (!sync_check_sample_times(model)) return false;
    x->coupled = sync_sum_of_weights(model) != 0.0;
    while (x->time >= sync_next_event(model) - EVENT_TOLERANCE)
        if (!sync_next_tick(model)) return false;
    if (fabs(x->time - (double)x->k * x->T) <= EVENT_TOLERANCE) sync_estimate(model);
    return true;
}

/* --- synchronization term: filter, qijversion2_1, epsilon, epsilonA to epsilonC --------------------------------- */

/* How far neighbour j has moved, by extrapolation, since its sample was taken: epsilon_ij(t). */
static double sync_displacement(const Model *model, int64_t j, int64_t i) {
    const Values *x = model->values;
    double age = x->time - model->arrays.neighbour_time[j];
    int64_t stamp = model->arrays.neighbour_stamp[j];
    if (x->role == KNOWN_VELOCITY) return AXIS(model, v_d)[i] * age;
    switch (x->extrapolation) {
        case RECEIVED_ESTIMATE: return model->arrays.neighbour_v_hat[ROW(model) * j + i] * age;
        case OWN_ESTIMATE:
            return sync_recorded_now(model, V_HAT_INTEGRAL, i) - sync_recorded(model, stamp, V_HAT_INTEGRAL, i);
        case OWN_FILTERED:
            return sync_recorded_now(model, V_BAR_INTEGRAL, i) - sync_recorded(model, stamp, V_BAR_INTEGRAL, i);
        default: return sync_recorded(model, stamp, V_BAR, i) * age;
    }
}

/* Weighted mean of the neighbours' extrapolated positions on axis i; `kappa`: the sum of the weights. */
static double sync_mean_position(const Model *model, int64_t i, double kappa) {
    const Arrays *a = &model->arrays;
    double sum = 0.0;
    for (int64_t j = 0; j < model->values->n_neighbours; j++) {
        double position = AXIS(model, p_initial)[i];
        if (a->neighbour_stamp[j] >= 0)
            position = sync_displacement(model, j, i) + a->neighbour_p[ROW(model) * j + i];
        sum += a->weight[j] * position;
    }
    return sum / kappa;
}

/* --- reference velocity: v_reference, hat_v_filter -------------------------------------------------------------- */

/* All derivatives but those of the parameters' estimates; reference velocity and error. */
static void sync_evaluate(Model *model) {
    Values *x = model->values;
    double kappa = sync_sum_of_weights(model);
    bool heard = x->coupled && kappa != 0.0, follower = x->role == FOLLOWER;
    for (int64_t i = 0; i < AXES(model); i++) {
        double v_bar = AXIS(model, v_bar)[i], v_bar_dot = AXIS(model, v_bar_dot)[i];
        double eta = AXIS(model, eta)[i], psi = AXIS(model, psi)[i];
        double pull = x->k_p * (v_bar - AXIS(model, v_hat)[i]);
        AXIS(model, der_v_bar)[i] = follower ? v_bar_dot : 0.0;
        AXIS(model, der_v_bar_dot)[i] = follower ? -x->k_d * v_bar_dot - pull : 0.0;
        AXIS(model, der_v_bar_integral)[i] = v_bar;
        AXIS(model, der_eta)[i] = x->coupled ? -x->k_eta * eta - x->lambda * (AXIS(model, p)[i] - psi) : 0.0;
        AXIS(model, der_psi)[i] = heard ? -psi + v_bar + sync_mean_position(model, i, kappa) : 0.0;
        AXIS(model, v_r)[i] = eta + v_bar;
        AXIS(model, e)[i] = AXIS(model, v)[i] - AXIS(model, v_r)[i];
    }
}

/* v_r', after sync_evaluate. */
static double sync_reference_rate(const Model *model, int64_t i) {
    return AXIS(model, der_eta)[i] + AXIS(model, v_bar_dot)[i];
}

#endif
