/* f1 = k_c (p2 - p1) + d_c (v2 - v1) = -f2. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    (void)model;
    return true;
}

bool model_evaluate(Model *model) {
    Values *x = model->values;
    x->f1 = x->k_c * (x->p2 - x->p1) + x->d_c * (x->v2 - x->v1);
    x->f2 = -x->f1;
    return true;
}
