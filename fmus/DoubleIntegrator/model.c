/* Double integrators: p'' = u on every axis. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    (void)model;
    return true;
}

bool model_evaluate(Model *model) {
    const Arrays *a = &model->arrays;
    for (int64_t i = 0; i < model->values->n_axes; i++) {
        a->der_p[i] = a->v[i];
        a->der_v[i] = a->u[i];
    }
    return true;
}
