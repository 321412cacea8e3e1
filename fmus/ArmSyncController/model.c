/* Synchronization of a two-link arm over an intermittent, delayed network. Equations and their source: README.md. */
#include "model.h"

#include <math.h>
#include <string.h>

enum { FOLLOWER = 1, LEADER, KNOWN_VELOCITY };
enum { RECEIVED_ESTIMATE = 1, OWN_ESTIMATE, OWN_FILTERED, OWN_FILTERED_AT_STAMP };

/* What the extrapolations that look back need of a tick: a record of the history. */
typedef struct {
    double v_hat_integral[2];
    double v_bar_integral[2];
    double v_bar[2];
} Record;

#define RECORD_LENGTH (sizeof(Record) / sizeof(double))

static bool keeps_history(const Values *x) {
    return x->extrapolation != RECEIVED_ESTIMATE && x->role != KNOWN_VELOCITY;
}

static double sum_of_weights(const Model *model) {
    double sum = 0.0;
    for (int64_t j = 0; j < model->values->n_neighbours; j++) sum += model->arrays.weight[j];
    return sum;
}

/* --- initialization --------------------------------------------------------------------------------------------- */

static bool check_parameters(Model *model) {
    const Values *x = model->values;
    if (!(x->T > 0.0)) return fail(model, "T must be more than 0 s, not %.9g s", x->T);
    if (!(x->solver_step > 0.0)) return fail(model, "solver_step must be more than 0 s, not %.9g s", x->solver_step);
    if (x->adaptation_sign != 1.0 && x->adaptation_sign != -1.0)
        return fail(model, "adaptation_sign must be -1 or +1, not %.9g", x->adaptation_sign);
    return true;
}

/* Integral of the own estimate from the start to now. */
static double v_hat_integral_now(const Values *x, int i) {
    return x->v_hat_integral[i] + x->v_hat[i] * (x->time - x->tick_time);
}

static Record record_now(const Values *x) {
    Record record = {.v_hat_integral = {v_hat_integral_now(x, 0), v_hat_integral_now(x, 1)}};
    memcpy(record.v_bar_integral, x->v_bar_integral, sizeof record.v_bar_integral);
    memcpy(record.v_bar, x->v_bar, sizeof record.v_bar);
    return record;
}

bool model_initialize(Model *model) {
    Values *x = model->values;
    if (!check_parameters(model)) return false;
    x->coupled = sum_of_weights(model) != 0.0;
    x->k = (int64_t)floor((x->time + EVENT_TOLERANCE) / x->T);
    x->tick_time = x->time;
    for (int i = 0; i < 2; i++) {
        bool follower = x->role == FOLLOWER;
        x->v_hat[i] = follower ? x->v_hat_start[i] : x->v_d[i];
        x->v_hat_next[i] = x->v_hat[i];
        x->v_bar[i] = follower && !x->v_bar_from_estimate ? x->v_bar_start[i] : x->v_hat[i];
        x->v_bar_dot[i] = 0.0;
        x->v_bar_integral[i] = 0.0;
        x->v_hat_integral[i] = 0.0;
        x->eta[i] = x->coupled ? x->eta_start[i] : 0.0;
        x->psi[i] = x->psi_from_position ? x->p[i] : x->psi_start[i];
        x->p_initial[i] = x->p[i];
    }
    memcpy(x->theta_hat, x->theta_hat_start, sizeof x->theta_hat);
    for (int64_t j = 0; j < x->n_neighbours; j++) model->arrays.stamp_seen[j] = model->arrays.stamp_previous[j] = -1;
    model->history.length = 0;
    x->history_tick = x->k;
    Record record = record_now(x);
    return !keeps_history(x) || history_append(model, (const double *)&record, RECORD_LENGTH);
}

/* --- observer: updatevk_leader, updatevk_follower, updatevk_f2 -------------------------------------------------- */

/* Removes the records older than every sample that any extrapolation can still start from. */
static void drop_old_records(Model *model) {
    Values *x = model->values;
    int64_t oldest = x->k;
    for (int64_t j = 0; j < x->n_neighbours; j++)
        if (model->arrays.neighbour_stamp[j] < oldest) oldest = model->arrays.neighbour_stamp[j];
    int64_t surplus = oldest - x->history_tick;
    /* In blocks, so that a run of n ticks costs n moves of a record and not n times the length of the history. */
    if (surplus < 64 || (size_t)surplus * RECORD_LENGTH * 2 < model->history.length) return;
    history_drop(model, (size_t)surplus * RECORD_LENGTH);
    x->history_tick += surplus;
}

/* Begins tick k + 1, at (k + 1) T. */
static bool next_tick(Model *model) {
    Values *x = model->values;
    size_t stamps = (size_t)x->n_neighbours * sizeof(int64_t);
    double tick_time = (double)(x->k + 1) * x->T;
    for (int i = 0; i < 2; i++) {
        x->v_hat_integral[i] += x->v_hat[i] * (tick_time - x->tick_time);
        x->v_hat[i] = x->v_hat_next[i];
    }
    x->tick_time = tick_time;
    x->k += 1;
    if (stamps > 0) memcpy(model->arrays.stamp_previous, model->arrays.stamp_seen, stamps);
    if (!keeps_history(x)) return true;
    Record record = record_now(x);
    memcpy(record.v_hat_integral, x->v_hat_integral, sizeof record.v_hat_integral);
    if (!history_append(model, (const double *)&record, RECORD_LENGTH)) return false;
    drop_old_records(model);
    return true;
}

/* The estimate for the next tick, from the messages that have come since the last one. */
static void estimate(Model *model) {
    Values *x = model->values;
    const Arrays *a = &model->arrays;
    double sum[2] = {x->v_hat[0], x->v_hat[1]};
    double count = 1.0;
    for (int64_t j = 0; j < x->n_neighbours; j++) {
        a->stamp_seen[j] = a->neighbour_stamp[j];
        if (a->neighbour_stamp[j] <= a->stamp_previous[j]) continue;
        sum[0] += a->neighbour_v_hat[2 * j];
        sum[1] += a->neighbour_v_hat[2 * j + 1];
        count += 1.0;
    }
    if (x->role != FOLLOWER) return;
    x->v_hat_next[0] = sum[0] / count;
    x->v_hat_next[1] = sum[1] / count;
}

/* The extrapolations that look back find a sample's time by its stamp. */
static bool check_sample_times(Model *model) {
    const Values *x = model->values;
    for (int64_t j = 0; j < x->n_neighbours && keeps_history(x); j++) {
        int64_t stamp = model->arrays.neighbour_stamp[j];
        double time = model->arrays.neighbour_time[j], expected = (double)stamp * x->T;
        if (stamp >= 0 && fabs(time - expected) > 1e-9 * fmax(1.0, expected))
            return fail(model, "neighbour_time[%lld] is %.9g s, but a sample of tick %lld was taken at %.9g s: T must be "
                        "the period of the messages", (long long)j + 1, time, (long long)stamp, expected);
    }
    return true;
}

bool model_update(Model *model) {
    Values *x = model->values;
    if (!check_sample_times(model)) return false;
    x->coupled = sum_of_weights(model) != 0.0;
    while (x->time >= model_next_event(model) - EVENT_TOLERANCE)
        if (!next_tick(model)) return false;
    if (fabs(x->time - (double)x->k * x->T) <= EVENT_TOLERANCE) estimate(model);
    return true;
}

double model_next_event(const Model *model) { return (double)(model->values->k + 1) * model->values->T; }

/* --- synchronization term: filter, qijversion2_1, epsilon, epsilonA to epsilonC --------------------------------- */

/* The record of a tick; of now, if that tick's event update is still to come; of the start, if it was before. */
static Record record_at(const Model *model, int64_t tick) {
    int64_t start = model->values->history_tick;
    size_t index = tick > start ? (size_t)(tick - start) : 0;
    Record record = record_now(model->values);
    if (index < model->history.length / RECORD_LENGTH)
        memcpy(&record, model->history.data + index * RECORD_LENGTH, sizeof record);
    return record;
}

/* How far neighbour j has moved, by extrapolation, since its sample was taken: epsilon_ij(t). */
static void displacement(const Model *model, int64_t j, double result[2]) {
    const Values *x = model->values;
    double age = x->time - model->arrays.neighbour_time[j];
    Record then = keeps_history(x) ? record_at(model, model->arrays.neighbour_stamp[j]) : (Record){0};
    for (int i = 0; i < 2; i++) {
        if (x->role == KNOWN_VELOCITY)
            result[i] = x->v_d[i] * age;
        else if (x->extrapolation == RECEIVED_ESTIMATE)
            result[i] = model->arrays.neighbour_v_hat[2 * j + i] * age;
        else if (x->extrapolation == OWN_ESTIMATE)
            result[i] = v_hat_integral_now(x, i) - then.v_hat_integral[i];
        else if (x->extrapolation == OWN_FILTERED)
            result[i] = x->v_bar_integral[i] - then.v_bar_integral[i];
        else
            result[i] = then.v_bar[i] * age;
    }
}

/* Weighted mean of the neighbours' extrapolated positions; false if the weights sum to 0. */
static bool mean_position(const Model *model, double mean[2]) {
    const Values *x = model->values;
    const Arrays *a = &model->arrays;
    double sum[2] = {0.0, 0.0}, kappa = sum_of_weights(model);
    if (kappa == 0.0) return false;
    for (int64_t j = 0; j < x->n_neighbours; j++) {
        double position[2] = {x->p_initial[0], x->p_initial[1]};
        if (a->neighbour_stamp[j] >= 0) {
            displacement(model, j, position);
            position[0] += a->neighbour_p[2 * j];
            position[1] += a->neighbour_p[2 * j + 1];
        }
        sum[0] += a->weight[j] * position[0];
        sum[1] += a->weight[j] * position[1];
    }
    mean[0] = sum[0] / kappa;
    mean[1] = sum[1] / kappa;
    return true;
}

/* --- control law: v_reference, hat_v_filter, control_EL, adapt_EL ----------------------------------------------- */

static void filter_derivatives(Model *model) {
    Values *x = model->values;
    double mean[2];
    bool heard = x->coupled && mean_position(model, mean);
    for (int i = 0; i < 2; i++) {
        bool follower = x->role == FOLLOWER;
        x->der_v_bar[i] = follower ? x->v_bar_dot[i] : 0.0;
        x->der_v_bar_dot[i] = follower ? -x->k_d * x->v_bar_dot[i] - x->k_p * (x->v_bar[i] - x->v_hat[i]) : 0.0;
        x->der_v_bar_integral[i] = x->v_bar[i];
        x->der_eta[i] = x->coupled ? -x->k_eta * x->eta[i] - x->lambda * (x->p[i] - x->psi[i]) : 0.0;
        x->der_psi[i] = heard ? -x->psi[i] + x->v_bar[i] + mean[i] : 0.0;
        x->v_r[i] = x->eta[i] + x->v_bar[i];
        x->e[i] = x->v[i] - x->v_r[i];
    }
}

/* Y(p, v, x, x') of property P.3, with theta in the paper's order. */
static void regressor(const Values *values, const double x[2], const double x_dot[2], double Y[2][5]) {
    const double *p = values->p, *v = values->v;
    double c2 = cos(p[1]), s2 = sin(p[1]), c12 = values->g * cos(p[0] + p[1]);
    Y[0][0] = x_dot[0];
    Y[0][1] = c2 * (2.0 * x_dot[0] + x_dot[1]) - s2 * (x[0] * v[1] + x[1] * (v[0] + v[1]));
    Y[0][2] = x_dot[1];
    Y[0][3] = c12;
    Y[0][4] = values->g * cos(p[0]);
    Y[1][0] = 0.0;
    Y[1][1] = x_dot[0] * c2 + x[0] * v[0] * s2;
    Y[1][2] = x_dot[0] + x_dot[1];
    Y[1][3] = c12;
    Y[1][4] = 0.0;
}

bool model_evaluate(Model *model) {
    Values *x = model->values;
    filter_derivatives(model);
    double v_r_dot[2] = {x->der_eta[0] + x->v_bar_dot[0], x->der_eta[1] + x->v_bar_dot[1]};
    double Y[2][5];
    regressor(x, x->v_r, v_r_dot, Y);
    for (int i = 0; i < 2; i++) {
        x->u[i] = -x->k_e * x->e[i];
        for (int k = 0; k < 5; k++) x->u[i] += Y[i][k] * x->theta_hat[k];
    }
    for (int k = 0; k < 5; k++)
        x->der_theta_hat[k] = x->adaptation_sign * x->Pi[k] * (Y[0][k] * x->e[0] + Y[1][k] * x->e[1]);
    return true;
}
