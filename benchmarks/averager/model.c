/* x' = rate (mean of what is heard - x), number by number; without in-neighbours x stays. */
#include "model.h"

#include <math.h>

bool model_initialize(Model *model) {
    if (!(model->values->solver_step > 0.0)) return fail(model, "solver_step must be more than 0 s");
    return true;
}

bool model_evaluate(Model *model) {
    Values *x = model->values;
    for (int i = 0; i < 8; i++) {
        double sum = 0.0;
        for (int64_t j = 0; j < x->n_neighbours; j++) sum += model->arrays.heard[8 * j + i] - x->x[i];
        x->der_x[i] = x->n_neighbours > 0 ? x->rate * sum / (double)x->n_neighbours : 0.0;
    }
    return true;
}

bool model_update(Model *model) {
    (void)model;
    return true;
}

double model_next_event(const Model *model) {
    (void)model;
    return INFINITY;
}
