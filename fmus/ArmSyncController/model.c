/* Synchronization of a two-link arm over an intermittent, delayed network. Equations and their source: README.md. */
#include "model.h"

#define AXES(model) 2
#define ROW(model) 2
#define AXIS(model, name) ((model)->values->name)
#include "sync.h"

bool model_initialize(Model *model) {
    Values *x = model->values;
    memcpy(x->theta_hat, x->theta_hat_start, sizeof x->theta_hat);
    return sync_initialize(model);
}

bool model_update(Model *model) { return sync_update(model); }

double model_next_event(const Model *model) { return sync_next_event(model); }

/* --- control law: control_EL, adapt_EL -------------------------------------------------------------------------- */

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
    sync_evaluate(model);
    double v_r_dot[2] = {sync_reference_rate(model, 0), sync_reference_rate(model, 1)};
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
