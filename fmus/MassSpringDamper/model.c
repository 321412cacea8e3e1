/* Masses with spring and damper: m p'' = u - d p' - k p - b on every axis. */
#include "model.h"
#include "no_events.h"

bool model_initialize(Model *model) {
    const Values *x = model->values;
    for (int64_t i = 0; i < x->n_axes; i++)
        if (!(model->arrays.m[i] > 0.0))
            return fail(model, "m[%lld] must be more than 0 kg, not %.9g kg", (long long)i + 1, model->arrays.m[i]);
    return true;
}

bool model_evaluate(Model *model) {
    const Arrays *a = &model->arrays;
    for (int64_t i = 0; i < model->values->n_axes; i++) {
        a->der_p[i] = a->v[i];
        a->der_v[i] = (a->u[i] - a->d[i] * a->v[i] - a->k[i] * a->p[i] - a->b[i]) / a->m[i];
    }
    return true;
}
