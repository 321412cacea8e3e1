/* m p'' = -d p' - k p - f with the force f = k_c (p - p_c) + d_c (p' - p_c') on what moves. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    (void)model;
    return true;
}

bool model_evaluate(Model *model) {
    Values *x = model->values;
    x->f = x->k_c * (x->p - x->p_c) + x->d_c * (x->v - x->v_c);
    x->der_p = x->v;
    x->der_v = (-x->d * x->v - x->k * x->p - x->f) / x->m;
    return true;
}
