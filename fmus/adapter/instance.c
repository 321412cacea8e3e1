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

static const size_t *extents_of(const Instance *instance) { return (const size_t *)&instance->model.extents; }

/* Writes "name", "name[2]" or, for a variable of two dimensions, "name[3,1]". */
static const char *element_name(char *buffer, const Instance *instance, const Variable *variable, size_t element) {
    size_t columns = variable->size;
    if (variable->n_extents == 2) columns *= extents_of(instance)[variable->extents[1]];
    if (variable->n_extents == 2 || (variable->n_extents == 1 && variable->size > 1))
        snprintf(buffer, LOG_LENGTH / 2, "%s[%zu,%zu]", variable->name, element / columns + 1, element % columns + 1);
    else if (variable->n_extents == 1 || variable->size > 1)
        snprintf(buffer, LOG_LENGTH / 2, "%s[%zu]", variable->name, element + 1);
    else
        snprintf(buffer, LOG_LENGTH / 2, "%s", variable->name);
    return buffer;
}

size_t instance_size(const Instance *instance, const Variable *variable) {
    size_t size = variable->size;
    for (int i = 0; i < variable->n_extents; i++) size *= extents_of(instance)[variable->extents[i]];
    return size;
}

static void *data_of(const Model *model, const Variable *variable) {
    if (variable->n_extents == 0) return (char *)model->values + variable->offset;
    return *(void **)((char *)&model->arrays + variable->offset);
}

void *instance_data(const Instance *instance, const Variable *variable) { return data_of(&instance->model, variable); }

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

static bool fail_for_memory(Model *model, const Extents *extents) {
    char sizes[LOG_LENGTH / 2] = "";
    const size_t *number = (const size_t *)extents;
    for (size_t i = 0, used = 0; i < N_VARIABLES && used + 1 < sizeof sizes; i++)
        if (variables[i].type == SIZE) {
            snprintf(sizes + used, sizeof sizes - used, "%s%s = %zu", used ? " and " : "", variables[i].name, *number++);
            used = strlen(sizes);
        }
    return fail(model, "%s: more than there is memory for", sizes);
}

static bool same_size(const Variable *variable, const Extents *one, const Extents *other) {
    for (int i = 0; i < variable->n_extents; i++)
        if (((const size_t *)one)[variable->extents[i]] != ((const size_t *)other)[variable->extents[i]]) return false;
    return true;
}

/* Room for dynamic arrays of this size. Those whose size changes get their start values, all others are kept. */
static bool resize(Instance *instance, const Extents *extents) {
    Model *model = &instance->model;
    double count = total_count(extents);
    if (count > 1e15) return fail_for_memory(model, extents);
    size_t size = sizeof(Values) + (size_t)count * 8;
    Values *values = calloc(1, size);
    if (!values) return fail_for_memory(model, extents);
    Model before = *model;
    model->values = values;
    model->extents = *extents;
    bind_arrays(&model->arrays, (char *)values + sizeof(Values), extents);
    if (before.values) memcpy(values, before.values, sizeof(Values));
    for (size_t i = 0; i < N_VARIABLES; i++) {
        const Variable *variable = &variables[i];
        if (variable->n_extents == 0) continue;
        if (before.values && same_size(variable, &before.extents, extents))
            memcpy(data_of(model, variable), data_of(&before, variable), 8 * instance_size(instance, variable));
        else
            set_start(instance, variable);
    }
    free(before.values);
    free(instance->scratch);
    instance->scratch = NULL;
    instance->size = size;
    return true;
}

static Extents wanted_extents(const Instance *instance) {
    Extents extents = {0};
    if (instance->flattened)
        memcpy(&extents, maximal, N_EXTENTS * sizeof(size_t));
    else
        read_extents(instance->model.values, &extents);
    return extents;
}

bool instance_reset(Instance *instance) {
    Extents extents = {0};
    if (!resize(instance, &extents)) return false;
    memset(instance->model.values, 0, sizeof(Values));
    for (size_t i = 0; i < N_VARIABLES; i++)
        if (variables[i].n_extents == 0) set_start(instance, &variables[i]);
    extents = wanted_extents(instance);
    if (!resize(instance, &extents)) return false;
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
    free(instance->scratch);
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
    Extents extents = wanted_extents(instance);
    if (!resize(instance, &extents)) return false;
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
                    element_name(name, instance, variable, element), instance->model.values->time);
    ((double *)instance_data(instance, variable))[element] = value;
    instance->stale = true;
    return true;
}

bool instance_set_integer(Instance *instance, const Variable *variable, size_t element, int64_t value) {
    char name[LOG_LENGTH / 2];
    int64_t max = variable->type == SIZE && !instance->flattened ? INT64_MAX : variable->max;
    if (value < variable->min || value > max)
        return fail(&instance->model, "%s was set to %lld, which is not from %lld to %lld",
                    element_name(name, instance, variable, element), (long long)value, (long long)variable->min, (long long)max);
    ((int64_t *)instance_data(instance, variable))[element] = value;
    instance->stale = true;
    return true;
}

/* --- evaluation ------------------------------------------------------------------------------------------------- */

/* The states, of fixed size at the start of the generated struct Values, else at the start of the arrays behind it;
 * their derivatives follow in the same order, and then the other computed variables. */
static double *states_of(const Instance *instance) {
    return (double *)(instance->model.values + (DYNAMIC_STATES ? 1 : 0));
}

size_t instance_states(const Instance *instance) {
    return DYNAMIC_STATES ? (size_t)state_count(&instance->model.extents) : N_STATES;
}

static double *derivatives_of(const Instance *instance) { return states_of(instance) + instance_states(instance); }

/* Says which variable a number that is not finite belongs to. */
static bool fail_not_finite(Instance *instance, const double *number) {
    char name[LOG_LENGTH / 2] = "?";
    for (size_t i = 0; i < N_VARIABLES; i++) {
        const double *data = instance_data(instance, &variables[i]);
        if (number >= data && number < data + instance_size(instance, &variables[i]))
            element_name(name, instance, &variables[i], (size_t)(number - data));
    }
    const double *states = states_of(instance), *derivatives = derivatives_of(instance);
    const double *rest = derivatives + instance_states(instance);
    const char *kind = number >= states && number < derivatives ? "state" :
                       number >= derivatives && number < rest ? "derivative" : "variable";
    return fail(&instance->model, "%s %s is not finite at t = %.9g s", kind, name, instance->model.values->time);
}

static bool check_finite(Instance *instance, const double *numbers, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (!isfinite(numbers[i])) return fail_not_finite(instance, numbers + i);
    return true;
}

bool instance_refresh(Instance *instance) {
    if (!instance->stale) return true;
    Model *model = &instance->model;
    if (instance->mode == INITIALIZATION) {
        double step = SOLVER_STEP(model->values);
        if (!(step > 0.0)) return fail(model, "solver_step must be more than 0 s, not %.9g s", step);
        if (!model_initialize(model)) return false;
    }
    if (!model_evaluate(model)) return false;
    if (!check_finite(instance, (const double *)model->values, N_CHECKED)) return false;
    if (N_EXTENTS && !check_finite(instance, (const double *)(model->values + 1), (size_t)checked_count(&model->extents)))
        return false;
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
    size_t states = instance_states(instance);
    return count == states || fail(&instance->model, "there are %zu continuous states, not %zu", states, count);
}

bool instance_expect_none(Instance *instance, size_t count, const char *what) {
    return count == 0 || fail(&instance->model, "this FMU has no %s, but %zu were asked for", what, count);
}

bool instance_get_states(Instance *instance, double *states, size_t count) {
    if (!check_count(instance, count)) return false;
    if (instance->mode == INITIALIZATION && !instance_refresh(instance)) return false;
    memcpy(states, states_of(instance), count * sizeof(double));
    return true;
}

bool instance_get_derivatives(Instance *instance, double *derivatives, size_t count) {
    if (!check_count(instance, count) || !instance_refresh(instance)) return false;
    memcpy(derivatives, derivatives_of(instance), count * sizeof(double));
    return true;
}

bool instance_get_nominals(Instance *instance, double *nominals, size_t count) {
    if (!check_count(instance, count)) return false;
    for (size_t i = 0; i < count; i++) nominals[i] = 1.0; /* as modelDescription.xml says by saying nothing */
    return true;
}

bool instance_set_states(Instance *instance, const double *states, size_t count) {
    if (!check_count(instance, count)) return false;
    for (size_t i = 0; i < count; i++)
        if (!isfinite(states[i])) return fail_not_finite(instance, states_of(instance) + i);
    memcpy(states_of(instance), states, count * sizeof(double));
    instance->stale = true;
    return true;
}

/* --- Co-Simulation ---------------------------------------------------------------------------------------------- */

/* Derivatives at `time` and at `start` + `factor` * `slope`. */
static bool stage(Instance *instance, double time, const double *start, double factor, const double *slope,
                  double *derivatives) {
    double *states = states_of(instance);
    size_t count = instance_states(instance);
    for (size_t i = 0; i < count; i++) states[i] = start[i] + factor * slope[i];
    instance->model.values->time = time;
    instance->stale = true;
    if (!instance_refresh(instance)) return false;
    memcpy(derivatives, derivatives_of(instance), count * sizeof(double));
    return true;
}

/* One step of the classical Runge-Kutta method. */
static bool runge_kutta(Instance *instance, double begin, double end) {
    double *states = states_of(instance);
    size_t count = instance_states(instance);
    if (!instance->scratch) instance->scratch = malloc(5 * (count + 1) * sizeof(double));
    if (!instance->scratch) return fail(&instance->model, "out of memory for a step of the solver");
    double *y = instance->scratch, *k1 = y + count, *k2 = k1 + count, *k3 = k2 + count, *k4 = k3 + count;
    double h = end - begin, middle = begin + 0.5 * h;
    memcpy(y, states, count * sizeof(double));
    memset(k4, 0, count * sizeof(double)); /* the slope of the first stage, whose factor is 0 */
    if (!stage(instance, begin, y, 0.0, k4, k1) || !stage(instance, middle, y, 0.5 * h, k1, k2) ||
        !stage(instance, middle, y, 0.5 * h, k2, k3) || !stage(instance, end, y, h, k3, k4))
        return false;
    for (size_t i = 0; i < count; i++) states[i] = y[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    instance->model.values->time = end;
    instance->stale = true;
    return true;
}

/* Integrates to `end` in equal steps of at most `solver_step`, with the inputs held. */
static bool integrate(Instance *instance, double end) {
    double begin = instance->model.values->time;
    double length = end - begin;
    if (length <= 0.0) return true;
    double count = fmax(1.0, ceil(length / SOLVER_STEP(instance->model.values) - STEP_TOLERANCE));
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
    Extents extents;
    uint64_t size;    /* bytes of values and arrays, which follow */
    uint64_t history; /* number of doubles, which follow those */
    double start_time;
    double stop_time;
};

static Snapshot snapshot_header(const Instance *instance) {
    Snapshot header = {
        .mode = instance->mode,
        .extents = instance->model.extents,
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
    if (!resize(instance, &snapshot->extents)) return false;
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
        header.size > size || header.history > size ||
        (double)header.size != (double)sizeof(Values) + 8.0 * total_count(&header.extents) ||
        header.bytes != sizeof header + header.size + header.history * sizeof(double) ||
        (instance->flattened && memcmp(&header.extents, maximal, N_EXTENTS * sizeof(size_t)) != 0)) {
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
