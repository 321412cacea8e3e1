/* Synchronization of decoupled axes over an intermittent, delayed network. Equations and their source: README.md. */
#include "model.h"

#define AXES(model) ((model)->values->n_axes)
#define ROW(model) ((int64_t)(model)->extents.n_axes)
#define AXIS(model, name) ((model)->arrays.name)
#include "sync.h"

enum { N_PARAMETERS = 5 };

bool model_initialize(Model *model) {
    const Arrays *a = &model->arrays;
    size_t numbers = (size_t)(N_PARAMETERS * model->values->n_axes);
    memcpy(a->theta_hat, a->theta_hat_start, numbers * sizeof(double));
    return sync_initialize(model);
}

bool model_update(Model *model) { return sync_update(model); }

double model_next_event(const Model *model) { return sync_next_event(model); }

/* --- control law: control_EL, adapt_EL, with the regressor of one axis ------------------------------------------ */

bool model_evaluate(Model *model) {
    const Values *x = model->values;
    const Arrays *a = &model->arrays;
    sync_evaluate(model);
    for (int64_t i = 0; i < x->n_axes; i++) {
        double Y[N_PARAMETERS] = {sync_reference_rate(model, i), a->v_r[i], a->p[i], 1.0, sin(a->p[i])};
        a->u[i] = -x->k_e * a->e[i];
        for (int k = 0; k < N_PARAMETERS; k++) {
            a->u[i] += Y[k] * a->theta_hat[N_PARAMETERS * i + k];
            a->der_theta_hat[N_PARAMETERS * i + k] = x->adaptation_sign * x->Pi[k] * Y[k] * a->e[i];
        }
    }
    return true;
}
