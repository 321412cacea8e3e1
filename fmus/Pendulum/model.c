/* Pendulums with friction and torque: m l^2 p'' = u - d p' - m g l sin p on every axis. */
#include "model.h"
#include "no_events.h"

#include <math.h>

bool model_initialize(Model *model) {
    const Values *x = model->values;
    const Arrays *a = &model->arrays;
    for (int64_t i = 0; i < x->n_axes; i++) {
        if (!(a->m[i] > 0.0))
            return fail(model, "m[%lld] must be more than 0 kg, not %.9g kg", (long long)i + 1, a->m[i]);
        if (!(a->l[i] > 0.0)) return fail(model, "l[%lld] must be more than 0 m, not %.9g m", (long long)i + 1, a->l[i]);
    }
    return true;
}

bool model_evaluate(Model *model) {
    const Arrays *a = &model->arrays;
    double g = model->values->g;
    for (int64_t i = 0; i < model->values->n_axes; i++) {
        double torque = a->u[i] - a->d[i] * a->v[i] - a->m[i] * g * a->l[i] * sin(a->p[i]);
        a->der_p[i] = a->v[i];
        a->der_v[i] = torque / (a->m[i] * a->l[i] * a->l[i]);
    }
    return true;
}
