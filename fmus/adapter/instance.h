/* One FMU instance: life cycle, variables, integration and state, the same for FMI 2.0 and 3.0.
 *
 * Functions that return bool have noted why in `instance->model.message` when they return false.
 */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "model.h"

/* The states of the FMI state machines (FMI 2.0.5, sections 3.2.3 and 4.2.4; FMI 3.0.2, section 2.3). */
typedef enum {
    INSTANTIATED = 1,
    CONFIGURATION = 2,
    INITIALIZATION = 4,
    EVENT = 8,
    CONTINUOUS = 16,
    STEP = 32,
    TERMINATED = 64,
} Mode;

#define ANY_MODE (INSTANTIATED | CONFIGURATION | INITIALIZATION | EVENT | CONTINUOUS | STEP | TERMINATED)
#define RUNNING (EVENT | CONTINUOUS | STEP)

typedef enum { REAL = 1, INTEGER = 2, SIZE = 4, BOOLEAN = 8, ENUMERATION = 16 } Type;

/* Who sets a variable: the environment or the solver (STORED), model_initialize and then the solver or model_update
 * (INITIALIZED), or model_evaluate (EVALUATED). The last two are brought up to date before they are read. */
typedef enum { STORED, INITIALIZED, EVALUATED } Computed;

typedef struct {
    const char *name;
    Type type;
    int settable;       /* the modes in which it can be set, as a mask */
    Computed computed;
    int n_extents;      /* how many of its dimensions are structural parameters; the first ones */
    int extents[2];     /* which of the structural parameters those are */
    size_t size;        /* number of elements, but for the extents */
    size_t offset;      /* bytes from the start of Values; with extents, of the pointer from the start of Arrays */
    const double *start; /* `size` start values, or NULL */
    int64_t min, max;   /* of an integer, size or enumeration */
} Variable;

typedef struct Instance Instance;

struct Instance {
    Model model;
    Mode mode;
    bool model_exchange;
    bool flattened;  /* FMI 2.0: dynamic arrays have room for the declared maximum */
    bool stale;      /* something changed since the computed variables were last evaluated */
    size_t size;     /* bytes behind model.values */
    double *scratch; /* five vectors of the states' length for the solver, from the first step on */
    double start_time;
    double stop_time; /* INFINITY if not defined */
    void (*log)(const Instance *instance); /* passes model.message to the environment as an error */
    void *environment;
    void (*callback)(void); /* the environment's logger, of a type that depends on the FMI version */
    char *name;
};

Instance *instance_create(const char *name, bool model_exchange, bool flattened);
void instance_free(Instance *instance);
bool instance_reset(Instance *instance);

/* False, with a message that names the function, if the instance is not in one of the modes. */
bool instance_expect(Instance *instance, int modes, const char *function);

bool instance_enter_initialization(Instance *instance, double start_time, double stop_time);
bool instance_exit_initialization(Instance *instance);
bool instance_exit_configuration(Instance *instance);

/* --- variables ------------------------------------------------------------------------------------------------- */

/* The variable of that reference, if it has one of the types (a mask). NULL, with a message, if not. */
const Variable *instance_variable(Instance *instance, unsigned int reference, int types);
size_t instance_states(const Instance *instance);
size_t instance_size(const Instance *instance, const Variable *variable);
void *instance_data(const Instance *instance, const Variable *variable);
bool instance_can_get(Instance *instance, const Variable *variable);
bool instance_can_set(Instance *instance, const Variable *variable);
bool instance_set_real(Instance *instance, const Variable *variable, size_t element, double value);
bool instance_set_integer(Instance *instance, const Variable *variable, size_t element, int64_t value);

/* --- Model Exchange -------------------------------------------------------------------------------------------- */
bool instance_set_time(Instance *instance, double time);
bool instance_set_states(Instance *instance, const double *states, size_t count);
bool instance_get_states(Instance *instance, double *states, size_t count);
bool instance_get_derivatives(Instance *instance, double *derivatives, size_t count);
bool instance_get_nominals(Instance *instance, double *nominals, size_t count);
bool instance_expect_none(Instance *instance, size_t count, const char *what);
bool instance_refresh(Instance *instance);
bool instance_update(Instance *instance);

/* --- Co-Simulation --------------------------------------------------------------------------------------------- */
bool instance_step(Instance *instance, double time, double step);

/* --- state ----------------------------------------------------------------------------------------------------- */
typedef struct Snapshot Snapshot;
Snapshot *instance_save(Instance *instance);
bool instance_restore(Instance *instance, const Snapshot *snapshot);
void free_snapshot(Snapshot *snapshot);
size_t snapshot_size(const Snapshot *snapshot);
bool instance_serialize(Instance *instance, const Snapshot *snapshot, void *bytes, size_t size);

/* A snapshot from bytes; NULL, with a message, if they are not a snapshot of this model. */
Snapshot *instance_deserialize(Instance *instance, const void *bytes, size_t size);

#endif
