/* What a model supplies to the FMI adapter, and what the adapter gives it.
 *
 * A model is a table of variables (`model.toml`, from which the build generates `variables.h`) and the four functions
 * at the end of this file. It knows nothing of FMI versions, value references, modes or solvers.
 */
#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "variables.h" /* generated: the structs Values, Extents and Arrays */

#define LOG_LENGTH 256

/* Two times closer than this (s) are the same instant; far below any period, far above the rounding of a time. */
#define EVENT_TOLERANCE 1e-10

/* A list of doubles that a model may let grow, such as a record of its own past. Part of the FMU's state. */
typedef struct {
    double *data;
    size_t length;
    size_t capacity;
} History;

/* One instance, as its model sees it. */
typedef struct {
    Values *values;  /* every variable of fixed size; `values->time` is the independent variable */
    Arrays arrays;   /* every variable sized by structural parameters, row-major */
    Extents extents; /* what there is room for in them: the structural parameters; in FMI 2.0 their maximum */
    History history;
    char message[LOG_LENGTH]; /* why the last call failed */
} Model;

/* Notes why a model's function fails; returns false, so that one can write `return fail(model, ...)`. */
bool fail(Model *model, const char *format, ...)
#if defined(__GNUC__)
    __attribute__((format(printf, 2, 3)))
#endif
    ;

/* Appends `count` doubles to the history; false (with a message) if there is no memory. */
bool history_append(Model *model, const double *items, size_t count);

/* Removes the oldest `count` doubles of the history. */
void history_drop(Model *model, size_t count);

/* --- supplied by the model -------------------------------------------------------------------------------------- */

/* Checks the parameters and sets everything that has a calculated start value, from parameters, inputs and
 * `values->time`. Called whenever a value is asked for in Initialization Mode, and at its end: must be idempotent. */
bool model_initialize(Model *model);

/* Sets the computed outputs and locals, and the derivatives of the states, from time, states, inputs and memory. */
bool model_evaluate(Model *model);

/* Event update at `values->time`. Called in every Event Mode of Model Exchange; in Co-Simulation at the start and at the
 * end of a step and at each time event inside it. Must be idempotent: it may be called again at the same time. */
bool model_update(Model *model);

/* Time of the next time event in seconds, INFINITY if there is none. */
double model_next_event(const Model *model);

#endif
