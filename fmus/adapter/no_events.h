/* For a model without events: include it in place of model_update and model_next_event. */
#ifndef NO_EVENTS_H
#define NO_EVENTS_H

#include <math.h>

#include "model.h"

bool model_update(Model *model) {
    (void)model;
    return true;
}

double model_next_event(const Model *model) {
    (void)model;
    return INFINITY;
}

#endif
