/* Proportional and derivative control: u = u_ref + k_p (p_ref - p) + k_d (v_ref - v) on every axis. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    (void)model;
    return true;
}

bool model_evaluate(Model *model) {
    const Arrays *a = &model->arrays;
    for (int64_t i = 0; i < model->values->n_axes; i++)
        a->u[i] = a->u_ref[i] + a->k_p[i] * (a->p_ref[i] - a->p[i]) + a->k_d[i] * (a->v_ref[i] - a->v[i]);
    return true;
}
