/* Consensus of second-order agents: u_i = -k_d v_i + sum_j a_ij (k_p (p_j - p_i) + k_v (v_j - v_i)) on every axis, over
 * the in-neighbours j that have been heard. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    (void)model;
    return true;
}

bool model_evaluate(Model *model) {
    const Values *x = model->values;
    const Arrays *a = &model->arrays;
    int64_t row = (int64_t)model->extents.n_axes;
    for (int64_t i = 0; i < x->n_axes; i++) {
        a->u[i] = -x->k_d * a->v[i];
        for (int64_t j = 0; j < x->n_neighbours; j++) {
            if (a->neighbour_stamp[j] < 0) continue;
            double apart = a->neighbour_p[row * j + i] - a->p[i], faster = a->neighbour_v[row * j + i] - a->v[i];
            a->u[i] += a->weight[j] * (x->k_p * apart + x->k_v * faster);
        }
    }
    return true;
}
