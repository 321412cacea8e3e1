/* Planar two-link arm: M(p) v' = u - C(p, v) v - G(p). Equations: README.md beside this file. */
#include "model.h"
#include "no_events.h"

#include <math.h>

bool model_initialize(Model *model) {
    Values *x = model->values;
    if (!(x->m1 > 0.0 && x->m2 > 0.0)) return fail(model, "the masses m1 and m2 must be more than 0 kg");
    if (!(x->I1 >= 0.0 && x->I2 >= 0.0)) return fail(model, "the inertias I1 and I2 must not be negative");
    x->theta[0] = x->m1 * x->lc1 * x->lc1 + x->m2 * (x->l1 * x->l1 + x->lc2 * x->lc2) + x->I1 + x->I2;
    x->theta[1] = x->m2 * x->l1 * x->lc2;
    x->theta[2] = x->m2 * x->lc2 * x->lc2 + x->I2;
    x->theta[3] = x->m2 * x->lc2;
    x->theta[4] = x->m1 * x->lc1 + x->m2 * x->l1;
    /* det M = theta_1 theta_3 - theta_3^2 - theta_2^2 cos^2 p_2 must be positive at every p_2 */
    if (!((x->theta[0] - x->theta[2]) * x->theta[2] > x->theta[1] * x->theta[1]))
        return fail(model, "the inertia matrix of these parameters is not positive definite");
    return true;
}

bool model_evaluate(Model *model) {
    Values *x = model->values;
    const double *theta = x->theta, *v = x->v;
    double c2 = cos(x->p[1]), s2 = sin(x->p[1]), c12 = cos(x->p[0] + x->p[1]);
    double m11 = theta[0] + 2.0 * theta[1] * c2, m12 = theta[2] + theta[1] * c2, m22 = theta[2];
    double gravity2 = x->g * theta[3] * c12, gravity1 = x->g * theta[4] * cos(x->p[0]) + gravity2;
    double torque1 = x->u[0] + theta[1] * s2 * (v[1] * v[0] + (v[0] + v[1]) * v[1]) - gravity1;
    double torque2 = x->u[1] - theta[1] * s2 * v[0] * v[0] - gravity2;
    double determinant = m11 * m22 - m12 * m12;
    x->der_p[0] = v[0];
    x->der_p[1] = v[1];
    x->der_v[0] = (m22 * torque1 - m12 * torque2) / determinant;
    x->der_v[1] = (m11 * torque2 - m12 * torque1) / determinant;
    return true;
}
