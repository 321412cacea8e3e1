#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "table.h" /* generated: the table of variables */

/* Two communication points are the same if they differ by less (relative to their size, if that is above 1 s). */
#define POINT_TOLERANCE 1e-9
/* A part of an internal step shorter than this fraction is rounding, not a step of its own. */
#define STEP_TOLERANCE 1e-6

bool fail(Model *model, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(model->message, LOG_LENGTH, format, arguments);
    va_end(arguments);
    return false;
}

bool history_append(Model *model, const double *items, size_t count) {
    History *history = &model->history;
    if (history->length + count > history->capacity) {
        size_t capacity = 2 * history->capacity + count;
        double *data = realloc(history->data, capacity * sizeof(double));
        if (!data) return fail(model, "out of memory for a history of %zu numbers", capacity);
        history->data = data;
        history->capacity = capacity;
    }
    memcpy(history->data + history->length, items, count * sizeof(double));
    history->length += count;
    return true;
}

void history_drop(Model *model, size_t count) {
    History *history = &model->history;
    if (count == 0) return;
    history->length -= count;
    memmove(history->data, history->data + count, history->length * sizeof(double));
}

/* --- storage ---------------------------------------------------------------------------------------------------- */

/* Writes "name", "name[2]" or, for a dynamic variable of more than one column, "name[3,1]". */
static const char *element_name(char *buffer, const Variable *variable, size_t element) {
    if (variable->dynamic && variable->size > 1)
        snprintf(buffer, LOG_LENGTH / 2, "%s[%zu,%zu]", variable->name, element / variable->size + 1,
                 element % variable->size + 1);
    else if (variable->dynamic || variable->size > 1)
        snprintf(buffer, LOG_LENGTH / 2, "%s[%zu]", variable->name, element + 1);
    else
        snprintf(buffer, LOG_LENGTH / 2, "%s", variable->name);
    return buffer;
}

size_t instance_size(const Instance *instance, const Variable *variable) {
    return variable->dynamic ? instance->rows * variable->size : variable->size;
}

void *instance_data(const Instance *instance, const Variable *variable) {
    char *values = (char *)instance->model.values;
    return variable->dynamic ? values + sizeof(Values) + instance->rows * variable->offset : values + variable->offset;
}

static void set_start(const Instance *instance, const Variable *variable) {
    if (!variable->start) return;
    void *data = instance_data(instance, variable);
    size_t size = instance_size(instance, variable);
    for (size_t i = 0; i < size; i++) {
        double start = variable->start[i % variable->size];
        if (variable->type == REAL)
            ((double *)data)[i] = start;
        else
            ((int64_t *)data)[i] = (int64_t)start;
    }
}

/* Room for `rows` rows of the dynamic arrays, which get their start values; the other values are kept. */
static bool resize(Instance *instance, size_t rows) {
    if (ROW_BYTES > 0 && rows > (SIZE_MAX / 2 - sizeof(Values)) / (ROW_BYTES + 1))
        return fail(&instance->model, "%zu rows are more than there is memory for", rows);
    size_t size = sizeof(Values) + rows * ROW_BYTES;
    Values *values = realloc(instance->model.values, size);
    if (!values) return fail(&instance->model, "%zu rows are more than there is memory for", rows);
    memset((char *)values + sizeof(Values), 0, rows * ROW_BYTES);
    instance->model.values = values;
    instance->rows = rows;
    instance->size = size;
    bind_arrays(&instance->model.arrays, (char *)values + sizeof(Values), rows);
    for (size_t i = 0; i < N_VARIABLES; i++)
        if (variables[i].dynamic) set_start(instance, &variables[i]);
    return true;
}

bool instance_reset(Instance *instance) {
    if (!resize(instance, 0)) return false;
    memset(instance->model.values, 0, sizeof(Values));
    for (size_t i = 0; i < N_VARIABLES; i++)
        if (!variables[i].dynamic) set_start(instance, &variables[i]);
    if (!resize(instance, instance->flattened ? MAX_ROWS : start_rows(instance->model.values))) return false;
    instance->model.history.length = 0;
    instance->model.message[0] = '\0';
    instance->mode = INSTANTIATED;
    instance->stale = true;
    instance->start_time = 0.0;
    instance->stop_time = INFINITY;
    return true;
}

Instance *instance_create(const char *name, bool model_exchange, bool flattened) {
    Instance *instance = calloc(1, sizeof(Instance));
    if (!instance) return NULL;
    instance->model_exchange = model_exchange;
    instance->flattened = flattened;
    size_t length = strlen(name) + 1;
    instance->name = malloc(length);
    if (!instance->name || !instance_reset(instance)) {
        instance_free(instance);
        return NULL;
    }
    memcpy(instance->name, name, length);
    return instance;
}

void instance_free(Instance *instance) {
    if (!instance) return;
    free(instance->model.values);
    free(instance->model.history.data);
    free(instance->name);
    free(instance);
}

/* --- life cycle ------------------------------------------------------------------------------------------------- */

static const char *mode_name(Mode mode) {
    switch (mode) {
        case INSTANTIATED: return "Instantiated";
        case CONFIGURATION: return "Configuration Mode";
        case INITIALIZATION: return "Initialization Mode";
        case EVENT: return "Event Mode";
        case CONTINUOUS: return "Continuous-Time Mode";
        case STEP: return "Step Mode";
        case TERMINATED: return "Terminated";
    }
    return "an unknown mode";
}

bool instance_expect(Instance *instance, int modes, const char *function) {
    if (instance->mode & modes) return true;
    return fail(&instance->model, "%s must not be called in the state '%s'", function, mode_name(instance->mode));
}

bool instance_exit_configuration(Instance *instance) {
    if (!instance->flattened && !resize(instance, start_rows(instance->model.values))) return false;
    instance->mode = INSTANTIATED;
    return true;
}

bool instance_enter_initialization(Instance *instance, double start_time, double stop_time) {
    if (!isfinite(start_time)) return fail(&instance->model, "the start time is not finite");
    if (!(stop_time > start_time))
        return fail(&instance->model, "the stop time %.9g s is not after the start time %.9g s", stop_time, start_time);
    instance->start_time = start_time;
    instance->stop_time = stop_time;
    instance->model.values->time = start_time;
    instance->mode = INITIALIZATION;
    instance->stale = true;
    return true;
}

bool instance_exit_initialization(Instance *instance) {
    instance->stale = true;
    if (!instance_refresh(instance)) return false;
    instance->mode = instance->model_exchange ? EVENT : STEP;
    return true;
}

/* --- variables -------------------------------------------------------------------------------------------------- */

const Variable *instance_variable(Instance *instance, unsigned int reference, int types) {
    const Variable *variable = reference < N_VARIABLES ? &variables[reference] : NULL;
    if (!variable) {
        fail(&instance->model, "there is no variable with value reference %u", reference);
        return NULL;
    }
    if (!(variable->type & types)) {
        fail(&instance->model, "the variable %s is of another type", variable->name);
        return NULL;
    }
    return variable;
}

bool instance_can_get(Instance *instance, const Variable *variable) {
    if (variable->computed == STORED) return true;
    if (instance->mode & (INSTANTIATED | CONFIGURATION))
        return fail(&instance->model, "%s is computed: it can be read from Initialization Mode on", variable->name);
    bool current = !instance->stale || (variable->computed == INITIALIZED && instance->mode != INITIALIZATION);
    return current || instance->mode == TERMINATED || instance_refresh(instance);
}

bool instance_can_set(Instance *instance, const Variable *variable) {
    int modes = variable->settable;
    if (variable->type == SIZE) modes = instance->flattened ? INSTANTIATED | INITIALIZATION : CONFIGURATION;
    if (instance->mode & modes) return true;
    return fail(&instance->model, "%s must not be set in the state '%s'", variable->name, mode_name(instance->mode));
}

bool instance_set_real(Instance *instance, const Variable *variable, size_t element, double value) {
    char name[LOG_LENGTH / 2];
    if (!isfinite(value))
        return fail(&instance->model, "%s was set to a value that is not finite at t = %.9g s",
                    element_name(name, variable, element), instance->model.values->time);
    ((double *)instance_data(instance, variable))[element] = value;
    instance->stale = true;
    return true;
}

bool instance_set_integer(Instance *instance, const Variable *variable, size_t element, int64_t value) {
    char name[LOG_LENGTH / 2];
    int64_t max = variable->type == SIZE && !instance->flattened ? INT64_MAX : variable->max;
    if (value < variable->min || value > max)
        return fail(&instance->model, "%s was set to %lld, which is not from %lld to %lld",
                    element_name(name, variable, element), (long long)value, (long long)variable->min, (long long)max);
    ((int64_t *)instance_data(instance, variable))[element] = value;
    instance->stale = true;
    return true;
}

/* --- evaluation ------------------------------------------------------------------------------------------------- */

/* The generated struct Values starts with the states; their derivatives follow in the same order. */
static double *states_of(const Instance *instance) { return (double *)instance->model.values; }

static double *derivatives_of(const Instance *instance) { return states_of(instance) + N_STATES; }

/* Says which of the first N_CHECKED numbers is not finite: states, then derivatives, then computed variables. */
static bool fail_not_finite(Instance *instance, size_t index) {
    char name[LOG_LENGTH / 2] = "?";
    size_t offset = index * sizeof(double);
    for (size_t i = 0; i < N_VARIABLES; i++) {
        const Variable *variable = &variables[i];
        if (!variable->dynamic && offset >= variable->offset && offset < variable->offset + variable->size * 8)
            element_name(name, variable, (offset - variable->offset) / sizeof(double));
    }
    const char *kind = index < N_STATES ? "state" : index < 2 * N_STATES ? "derivative" : "variable";
    return fail(&instance->model, "%s %s is not finite at t = %.9g s", kind, name, instance->model.values->time);
}

bool instance_refresh(Instance *instance) {
    if (!instance->stale) return true;
    Model *model = &instance->model;
    if (instance->mode == INITIALIZATION && !model_initialize(model)) return false;
    if (!model_evaluate(model)) return false;
    const double *checked = states_of(instance);
    for (size_t i = 0; i < N_CHECKED; i++)
        if (!isfinite(checked[i])) return fail_not_finite(instance, i);
    instance->stale = false;
    return true;
}

bool instance_update(Instance *instance) {
    instance->stale = true;
    return model_update(&instance->model);
}

/* --- Model Exchange --------------------------------------------------------------------------------------------- */

bool instance_set_time(Instance *instance, double time) {
    /* A solver may well look beyond the stop time and interpolate back, so that is not checked here. */
    if (!isfinite(time)) return fail(&instance->model, "the time is not finite");
    instance->model.values->time = time;
    instance->stale = true;
    return true;
}

static bool check_count(Instance *instance, size_t count) {
    if (count == N_STATES) return true;
    return fail(&instance->model, "there are %d continuous states, not %zu", (int)N_STATES, count);
}

bool instance_expect_none(Instance *instance, size_t count, const char *what) {
    return count == 0 || fail(&instance->model, "this FMU has no %s, but %zu were asked for", what, count);
}

bool instance_get_states(Instance *instance, double *states, size_t count) {
    if (!check_count(instance, count)) return false;
    if (instance->mode == INITIALIZATION && !instance_refresh(instance)) return false;
    memcpy(states, states_of(instance), N_STATES * sizeof(double));
    return true;
}

bool instance_get_derivatives(Instance *instance, double *derivatives, size_t count) {
    if (!check_count(instance, count) || !instance_refresh(instance)) return false;
    memcpy(derivatives, derivatives_of(instance), N_STATES * sizeof(double));
    return true;
}

bool instance_get_nominals(Instance *instance, double *nominals, size_t count) {
    if (!check_count(instance, count)) return false;
    for (size_t i = 0; i < N_STATES; i++) nominals[i] = 1.0; /* as modelDescription.xml says by saying nothing */
    return true;
}

bool instance_set_states(Instance *instance, const double *states, size_t count) {
    if (!check_count(instance, count)) return false;
    for (size_t i = 0; i < N_STATES; i++)
        if (!isfinite(states[i])) return fail_not_finite(instance, i);
    memcpy(states_of(instance), states, N_STATES * sizeof(double));
    instance->stale = true;
    return true;
}

/* --- Co-Simulation ---------------------------------------------------------------------------------------------- */

/* Derivatives at `time` and at `start` + `factor` * `slope`. */
static bool stage(Instance *instance, double time, const double *start, double factor, const double *slope,
                  double *derivatives) {
    double *states = states_of(instance);
    for (size_t i = 0; i < N_STATES; i++) states[i] = start[i] + factor * slope[i];
    instance->model.values->time = time;
    instance->stale = true;
    if (!instance_refresh(instance)) return false;
    memcpy(derivatives, derivatives_of(instance), N_STATES * sizeof(double));
    return true;
}

/* One step of the classical Runge-Kutta method. */
static bool runge_kutta(Instance *instance, double begin, double end) {
    double y[N_STATES + 1], k1[N_STATES + 1], k2[N_STATES + 1], k3[N_STATES + 1], k4[N_STATES + 1];
    double *states = states_of(instance);
    double h = end - begin, middle = begin + 0.5 * h;
    memcpy(y, states, N_STATES * sizeof(double));
    memset(k4, 0, sizeof k4); /* the slope of the first stage, whose factor is 0 */
    if (!stage(instance, begin, y, 0.0, k4, k1) || !stage(instance, middle, y, 0.5 * h, k1, k2) ||
        !stage(instance, middle, y, 0.5 * h, k2, k3) || !stage(instance, end, y, h, k3, k4))
        return false;
    for (size_t i = 0; i < N_STATES; i++) states[i] = y[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    instance->model.values->time = end;
    instance->stale = true;
    return true;
}

/* Integrates to `end` in equal steps of at most `solver_step`, with the inputs held. */
static bool integrate(Instance *instance, double end) {
    double begin = instance->model.values->time;
    double length = end - begin;
    if (length <= 0.0) return true;
    double count = fmax(1.0, ceil(length / instance->model.values->solver_step - STEP_TOLERANCE));
    for (double i = 0.0; i < count; i += 1.0) {
        double from = begin + length * (i / count);
        double to = i + 1.0 < count ? begin + length * ((i + 1.0) / count) : end;
        if (!runge_kutta(instance, from, to)) return false;
    }
    return true;
}

bool instance_step(Instance *instance, double time, double step) {
    Model *model = &instance->model;
    double end = time + step;
    double tolerance = POINT_TOLERANCE * fmax(1.0, fabs(time));
    if (!isfinite(end)) return fail(model, "the communication point or step size is not finite");
    if (step < 0.0) return fail(model, "the communication step size %.9g s is negative", step);
    if (end > instance->stop_time + tolerance)
        return fail(model, "a step to t = %.9g s would pass the stop time %.9g s", end, instance->stop_time);
    if (fabs(time - model->values->time) > tolerance)
        return fail(model, "a step from t = %.9g s was asked for, but this instance is at t = %.9g s", time,
                    model->values->time);
    model->values->time = time;
    if (!instance_update(instance)) return false;
    for (double event = model_next_event(model); event < end - EVENT_TOLERANCE; event = model_next_event(model)) {
        if (!(event > model->values->time)) return fail(model, "the next event, at t = %.9g s, is past", event);
        if (!integrate(instance, event) || !instance_update(instance)) return false;
    }
    return integrate(instance, end) && instance_update(instance) && instance_refresh(instance);
}

/* --- state ------------------------------------------------------------------------------------------------------ */

struct Snapshot {
    char token[32]; /* of the sources that wrote it, cut off */
    uint64_t bytes; /* of the whole snapshot */
    uint64_t mode;
    uint64_t rows;
    uint64_t size;    /* bytes of values and arrays, which follow */
    uint64_t history; /* number of doubles, which follow those */
    double start_time;
    double stop_time;
};

static Snapshot snapshot_header(const Instance *instance) {
    Snapshot header = {
        .mode = instance->mode,
        .rows = instance->rows,
        .size = instance->size,
        .history = instance->model.history.length,
        .start_time = instance->start_time,
        .stop_time = instance->stop_time,
    };
    memcpy(header.token, INSTANTIATION_TOKEN, sizeof header.token);
    header.bytes = sizeof header + header.size + header.history * sizeof(double);
    return header;
}

size_t snapshot_size(const Snapshot *snapshot) { return snapshot ? (size_t)snapshot->bytes : 0; }

Snapshot *instance_save(Instance *instance) {
    Snapshot header = snapshot_header(instance);
    Snapshot *snapshot = malloc(header.bytes);
    if (!snapshot) {
        fail(&instance->model, "out of memory for the state of the FMU");
        return NULL;
    }
    *snapshot = header;
    char *bytes = (char *)(snapshot + 1);
    memcpy(bytes, instance->model.values, instance->size);
    if (header.history > 0)
        memcpy(bytes + instance->size, instance->model.history.data, header.history * sizeof(double));
    return snapshot;
}

bool instance_restore(Instance *instance, const Snapshot *snapshot) {
    if (!snapshot) return fail(&instance->model, "there is no FMU state to set");
    const char *bytes = (const char *)(snapshot + 1);
    if (!resize(instance, (size_t)snapshot->rows)) return false;
    memcpy(instance->model.values, bytes, instance->size);
    instance->model.history.length = 0;
    if (snapshot->history > 0 &&
        !history_append(&instance->model, (const double *)(bytes + snapshot->size), (size_t)snapshot->history))
        return false;
    instance->mode = (Mode)snapshot->mode;
    instance->start_time = snapshot->start_time;
    instance->stop_time = snapshot->stop_time;
    instance->stale = true;
    return true;
}

void free_snapshot(Snapshot *snapshot) { free(snapshot); }

bool instance_serialize(Instance *instance, const Snapshot *snapshot, void *bytes, size_t size) {
    size_t needed = snapshot_size(snapshot);
    if (needed == 0) return fail(&instance->model, "there is no FMU state to serialize");
    if (size < needed) return fail(&instance->model, "%zu bytes are too few for a serialized state of %zu", size, needed);
    memcpy(bytes, snapshot, needed);
    return true;
}

Snapshot *instance_deserialize(Instance *instance, const void *bytes, size_t size) {
    Snapshot header, own = snapshot_header(instance);
    if (size >= sizeof header) memcpy(&header, bytes, sizeof header);
    if (size < sizeof header || memcmp(header.token, own.token, sizeof own.token) != 0 || header.bytes != size ||
        header.size > size || header.history > size || header.rows > size ||
        header.size != sizeof(Values) + header.rows * ROW_BYTES ||
        header.bytes != sizeof header + header.size + header.history * sizeof(double) ||
        (instance->flattened && header.rows != MAX_ROWS)) {
        fail(&instance->model, "these %zu bytes are not a serialized state of this FMU", size);
        return NULL;
    }
    Snapshot *snapshot = malloc(size);
    if (snapshot)
        memcpy(snapshot, bytes, size);
    else
        fail(&instance->model, "out of memory for the state of the FMU");
    return snapshot;
}
