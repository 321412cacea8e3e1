/* An FMU for tests: echoes inputs of every type, has one state with time and state events, and fails on request.
 *
 * One binary serves FMI 2.0 and 3.0. Functions that are not here come from generated stubs that return Error. Every value
 * is kept as a double in a slot: inputs have slots 10 to 21 and their echoes are read 20 higher.
 */
#define _POSIX_C_SOURCE 200809L /* setenv */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifndef _WIN32
#include <sys/wait.h>
#include <unistd.h>
#endif

#include "fmi2Functions.h"
#include "fmi3Functions.h"

enum { OK, DISCARD = 2, ERROR = 3, FATAL = 4, PENDING = 5 };
enum { TIME = 0, FAILS = 1, N = 3, VECTOR = 10, STATE = 50, RATE = 51, EVENTS = 52, INSTANCES = 53, COUNT = 55, N_SLOTS = 64 };
enum { INT32_IN = 16 };

/* Values of the parameter `fails`. */
enum {
    STEP_DISCARDS = 1,
    STEP_ERROR,
    STEP_FATAL,
    STEP_STOPS,
    STEP_EARLY,
    NEVER_SETTLES,
    OUTPUT_NAN,
    STATE_GROWS,
    UPDATE_STOPS,
    COMPLETED_STOPS,
    DERIVATIVE_ERROR,
    COMPLETED_ERROR,
    UPDATE_ERROR,
    NEVER_CONVERGES,
    DERIVATIVE_NAN,
    DERIVATIVE_JUMPS,
    DERIVATIVE_HANGS,
    DERIVATIVE_CRASHES,
    INDICATOR_NAN,
    CHATTERS,
    STEP_FIXED,
    EARLY_FOREVER,
    STEP_DISCARDS_LONG,
    STEP_PENDING,
    STEP_PENDING_ERROR,
    STEP_PENDING_FOREVER,
    STEP_PRINTS,
    STEP_FLOODS,
    STEP_HANGS,
    STEP_CRASHES,
    STEP_WANDERS,
    STEP_SCRIBBLES,
    NARROW,
    TICKS,
    ARMS,
    RELAYS,
    STEP_EXITS,
};

typedef struct {
    double slots[N_SLOTS];
    double vector[8];
    char label[64];
    bool structural_mode, fmi3, falling;
    bool has_event_mode, in_event_mode; /* Co-Simulation of FMI 3.0 */
    bool in_continuous_time_mode;
    double next_event;
    int questions;
    void *environment;
    fmi3LogMessageCallback log3;
    const fmi2CallbackFunctions *callbacks2;
} Probe;

static int instances = 0; /* shared by all instances of one loaded library */

static int failed(Probe *p, int status) {
    char text[128];
    snprintf(text, sizeof text, "%s gives up at t = %g", p->label, p->slots[TIME]);
    if (p->fmi3 && p->log3) p->log3(p->environment, (fmi3Status)status, "logStatusError", text);
    if (!p->fmi3)
        p->callbacks2->logger(p->callbacks2->componentEnvironment, "probe", (fmi2Status)status, "logStatusError",
                              "%s gives up at t = %g", p->label, p->slots[TIME]);
    return status;
}

static void say(Probe *p, int status, const char *text) {
    if (p->fmi3 && p->log3) p->log3(p->environment, (fmi3Status)status, "logStatusWarning", text);
    if (!p->fmi3)
        p->callbacks2->logger(p->callbacks2->componentEnvironment, "probe", (fmi2Status)status, "logStatusWarning", "%s",
                              text);
}

static void set_up(Probe *p, bool defined, double tolerance, double start) {
    char text[64];
    snprintf(text, sizeof text, "told the tolerance %g", tolerance);
    if (defined) say(p, 1, text);
    p->slots[TIME] = start;
}

/* By its label: it prints, and prints and refuses. */
static int initialised(Probe *p) {
    bool refuses = p && strcmp(p->label, "refuses") == 0;
    if (refuses || (p && strcmp(p->label, "talks") == 0)) puts("the probe talks");
    return p && !refuses ? 0 : 3;
}

/* A gigabyte to the log, and a quarter of one to standard output. */
static void flood(Probe *p) {
    enum { SIZE = 1 << 18 };
    char *text = malloc(SIZE + 1);
    memset(text, '#', SIZE);
    text[SIZE] = 0;
    for (int i = 0; i < (1 << 30) / SIZE; i++) {
        snprintf(text, 32, "line %d", i);
        text[strlen(text)] = ' ';
        say(p, 1, text);
        if (i % 4 == 0) puts(text);
    }
    say(p, 1, "the last line");
    puts("the last line");
    free(text);
}

static void misbehave(Probe *p) {
    switch ((int)p->slots[FAILS]) {
        case STEP_PRINTS:
            printf("%s printed at t = %g\n", p->label, p->slots[TIME]);
            fprintf(stderr, "%s complained\n", p->label);
            break;
        case STEP_FLOODS: flood(p); break;
        case STEP_HANGS:
            puts("going round in circles");
            for (volatile int forever = 1; forever;) {}
            break;
        case STEP_EXITS:
            puts("about to leave");
            if (fork() == 0) exit(0); /* which is no concern of the run */
            wait(NULL);
            exit(0);
        case STEP_CRASHES:
            puts("about to crash");
            *(volatile int *)NULL = 1;
            break;
        case STEP_WANDERS:
#ifndef _WIN32
            if (chdir("/") == 0) setenv("LC_ALL", "xx_XX", 1);
#endif
            break;
        case STEP_SCRIBBLES:
#ifndef _WIN32
            for (int descriptor = 3; descriptor < 64; descriptor++)
                if (write(descriptor, "this is none of my business", 27) < 0) continue;
#endif
            break;
    }
}

static int mode(const Probe *p) { return (int)p->slots[FAILS]; }

static Probe *create(bool fmi3) {
    Probe *p = calloc(1, sizeof *p);
    strcpy(p->label, "probe");
    p->fmi3 = fmi3;
    p->slots[N] = 2;
    p->slots[STATE] = 1.0;
    p->slots[21] = 1.0;
    p->next_event = 0.03;
    p->slots[INSTANCES] = ++instances;
    return p;
}

static double *slot(Probe *p, unsigned reference, size_t element) {
    if (reference == VECTOR || reference == VECTOR + 20) return &p->vector[element];
    if (reference >= 100 && reference < 104) return &p->vector[(reference - 100) % 2]; /* FMI 2.0: one by one */
    if (reference >= 30 && reference < 42) return &p->slots[reference - 20];
    return &p->slots[reference];
}

static size_t size_of(const Probe *p, unsigned reference) {
    return reference == VECTOR || reference == VECTOR + 20 ? (size_t)p->slots[N] : 1;
}

static double rate(const Probe *p) {
    if (mode(p) == STATE_GROWS) return p->slots[STATE] * p->slots[STATE] * p->slots[STATE];
    if (mode(p) == DERIVATIVE_NAN) return p->slots[TIME] > 0.05 ? NAN : 0.0;
    if (mode(p) == DERIVATIVE_JUMPS) return p->slots[TIME] > 0.05 ? 1e30 : 0.0;
    if (mode(p) == TICKS) return p->slots[INT32_IN] + p->vector[0] * p->slots[COUNT];
    if (mode(p) == ARMS) return p->slots[COUNT] == 2.0 ? 0.0 : 10.0;
    if (mode(p) == RELAYS) return p->slots[COUNT];
    if (mode(p) == CHATTERS) return p->falling ? -10.0 : 10.0;
    return 10.0 + p->vector[0];
}

static double value_of(Probe *p, unsigned reference, size_t element) {
    if (reference == RATE) return rate(p);
    if (mode(p) == OUTPUT_NAN && reference == 31 && p->slots[TIME] > 0.01) return NAN;
    if (mode(p) == NEVER_CONVERGES && reference == 31) return p->slots[EVENTS];
    return *slot(p, reference, element);
}

/* Its time has come, to the last bit. */
static bool due(const Probe *p) { return p->slots[TIME] >= p->next_event; }

/* Models with events that an exact solution follows from: `count` counts the multiples of vector[1]; once x has reached
 * 1.25 at the end of a step, it begins at 1 again and stands still vector[1] later; `count` is whether vector[0] > 0.5. */
static void update_exactly(Probe *p) {
    double *count = &p->slots[COUNT];
    switch (mode(p)) {
        case TICKS:
            p->next_event = (*count + 1.0) * p->vector[1];
            if (due(p)) p->next_event = (++*count + 1.0) * p->vector[1];
            break;
        case ARMS:
            if (*count == 1.0 && due(p)) *count = 2.0;
            if (*count != 1.0) p->next_event = 1e9;
            if (*count != 0.0 || p->slots[STATE] < 1.25) break;
            *count = p->slots[STATE] = 1.0;
            p->next_event = p->slots[TIME] + p->vector[1];
            break;
        case RELAYS:
            *count = p->vector[0] > 0.5;
            p->next_event = 1e9;
            break;
    }
}

static int update(Probe *p, bool *again, bool *stop, double *next_event) {
    if (mode(p) >= TICKS) {
        update_exactly(p);
        *again = *stop = false, *next_event = p->next_event;
        return OK;
    }
    while (p->next_event <= p->slots[TIME] + 1e-12) p->next_event += 0.03;
    if (p->slots[STATE] >= 2.0) p->slots[STATE] -= 1.0;
    p->slots[EVENTS] += 1.0;
    p->falling = p->slots[STATE] > 1.5;
    *again = mode(p) == NEVER_SETTLES && p->slots[TIME] > 0.0;
    *stop = mode(p) == UPDATE_STOPS && p->slots[TIME] > 0.0;
    *next_event = p->next_event;
    return mode(p) == UPDATE_ERROR && p->slots[TIME] > 0.0 ? failed(p, ERROR) : OK;
}

/* Where the description has an event indicator, `x` loses 1 as soon as it is 2; it may cross zero twice after that. */
static int indicate(Probe *p, double z[], size_t n) {
    if (n != 1) return failed(p, ERROR);
    z[0] = mode(p) == CHATTERS ? 1.5 - p->slots[STATE] : 2.0 - p->slots[STATE];
    if (mode(p) == RELAYS) z[0] = p->vector[0] - 0.5;
    if (mode(p) == NARROW) z[0] *= (p->slots[STATE] - 1.0005) * (p->slots[STATE] - 1.002);
    if (mode(p) == INDICATOR_NAN && p->slots[TIME] > 0.05) z[0] = NAN;
    return OK;
}

static int completed(Probe *p, bool *event, bool *stop) {
    *event = mode(p) == ARMS ? p->slots[STATE] >= 1.25 : mode(p) < TICKS && p->slots[STATE] > 2.0;
    *stop = mode(p) == COMPLETED_STOPS;
    return mode(p) == COMPLETED_ERROR ? failed(p, ERROR) : OK;
}

static int step(Probe *p, double time, double length) {
    p->slots[TIME] = time;
    if (time > 0.35) misbehave(p);
    if (mode(p) == STEP_DISCARDS) return failed(p, DISCARD);
    if (mode(p) == STEP_STOPS && !p->fmi3) return DISCARD;
    if (mode(p) == STEP_ERROR) return failed(p, ERROR);
    if (mode(p) == STEP_FATAL) return failed(p, FATAL);
    if (mode(p) == STEP_FIXED && (length != 0.01 || fabs(remainder(time, 0.01)) > 1e-12)) return failed(p, ERROR);
    p->slots[TIME] = time + length;
    p->slots[STATE] += length * rate(p);
    if (mode(p) == STEP_DISCARDS_LONG && length > 0.003) return failed(p, DISCARD);
    if (mode(p) >= STEP_PENDING && mode(p) <= STEP_PENDING_FOREVER) return p->questions = 3, PENDING;
    return OK;
}

/* What became of a step that was pending. */
static int pending(Probe *p) {
    if (mode(p) == STEP_PENDING_FOREVER || --p->questions > 0) return PENDING;
    return mode(p) == STEP_PENDING_ERROR ? failed(p, ERROR) : OK;
}

static int save(Probe *p, void **state) {
    if (*state == NULL) *state = malloc(sizeof *p);
    memcpy(*state, p, sizeof *p);
    return OK;
}

static int restore(Probe *p, void *state) {
    memcpy(p, state, sizeof *p);
    return OK;
}

static int forget(void **state) {
    free(*state);
    *state = NULL;
    return OK;
}

/* --- FMI 3.0 ---------------------------------------------------------------------------------------------------- */
#define PROBE(instance) ((Probe *)(instance))

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
    (void)name, (void)resources, (void)visible, (void)logging;
    if (strcmp(token, "probe") != 0) {
        log(environment, fmi3Error, "logStatusError", "wrong token");
        return NULL;
    }
    Probe *p = create(true);
    p->environment = environment;
    p->log3 = log;
    return p;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback intermediate) {
    (void)required, (void)n, (void)intermediate;
    Probe *p = fmi3InstantiateModelExchange(name, token, resources, visible, logging, environment, log);
    if (p) p->has_event_mode = p->in_event_mode = event_mode && early;
    return p;
}

void fmi3FreeInstance(fmi3Instance i) { free(i); }

fmi3Status fmi3EnterConfigurationMode(fmi3Instance i) {
    PROBE(i)->structural_mode = true;
    return fmi3OK;
}
fmi3Status fmi3ExitConfigurationMode(fmi3Instance i) {
    PROBE(i)->structural_mode = false;
    return fmi3OK;
}
fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean defined, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stop_defined, fmi3Float64 stop) {
    (void)stop_defined, (void)stop;
    set_up(PROBE(i), defined, tolerance, start);
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance i) { return (fmi3Status)initialised(i); }
fmi3Status fmi3EnterEventMode(fmi3Instance i) {
    PROBE(i)->in_event_mode = true;
    PROBE(i)->in_continuous_time_mode = false;
    return fmi3OK;
}
fmi3Status fmi3EnterStepMode(fmi3Instance i) {
    PROBE(i)->in_event_mode = false;
    return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i) {
    PROBE(i)->in_continuous_time_mode = true;
    return fmi3OK;
}
fmi3Status fmi3Terminate(fmi3Instance i) { return i ? fmi3OK : fmi3Error; }

/* Where discrete inputs must not be set. */
static bool outside_of_event_mode(const Probe *p) {
    return p->in_continuous_time_mode || (p->has_event_mode && !p->in_event_mode);
}

#define ACCESS3(Name, discrete)                                                                                    \
    fmi3Status fmi3Get##Name(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3##Name values[],         \
                             size_t n_values) {                                                                    \
        (void)n_values;                                                                                            \
        for (size_t j = 0; j < n; j++)                                                                             \
            for (size_t e = 0; e < size_of(i, vr[j]); e++) *values++ = (fmi3##Name)value_of(i, vr[j], e);              \
        return fmi3OK;                                                                                             \
    }                                                                                                              \
    fmi3Status fmi3Set##Name(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3##Name values[],   \
                             size_t n_values) {                                                                    \
        (void)n_values;                                                                                            \
        if (discrete && outside_of_event_mode(i)) return (fmi3Status)failed(i, ERROR);                             \
        for (size_t j = 0; j < n; j++) {                                                                           \
            if (vr[j] == N && !PROBE(i)->structural_mode) return (fmi3Status)failed(i, ERROR);                     \
            for (size_t e = 0; e < size_of(i, vr[j]); e++) *slot(i, vr[j], e) = (double)*values++;                 \
        }                                                                                                          \
        return fmi3OK;                                                                                             \
    }

ACCESS3(Float64, false)
ACCESS3(Float32, false)
ACCESS3(Int8, true)
ACCESS3(UInt8, true)
ACCESS3(Int16, true)
ACCESS3(UInt16, true)
ACCESS3(Int32, true)
ACCESS3(UInt32, true)
ACCESS3(Int64, true)
ACCESS3(UInt64, true)
ACCESS3(Boolean, true)

fmi3Status fmi3SetString(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3String values[],
                         size_t n_values) {
    (void)vr, (void)n, (void)n_values;
    snprintf(PROBE(i)->label, sizeof PROBE(i)->label, "%s", values[0]);
    return fmi3OK;
}

/* Its bytes, as characters, become the label. */
fmi3Status fmi3SetBinary(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary values[], size_t n_values) {
    if (n != 1 || vr[0] != 60 || n_values != 1) return (fmi3Status)failed(i, ERROR);
    snprintf(PROBE(i)->label, sizeof PROBE(i)->label, "%.*s", (int)sizes[0], (const char *)values[0]);
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 time) {
    PROBE(i)->slots[TIME] = time;
    return fmi3OK;
}
fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 x[], size_t n) {
    if (n) PROBE(i)->slots[STATE] = x[0];
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
    if (n) x[0] = PROBE(i)->slots[STATE];
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 dx[], size_t n) {
    if (mode(i) == DERIVATIVE_ERROR) return (fmi3Status)failed(i, ERROR);
    if (mode(i) == DERIVATIVE_HANGS && ((Probe *)i)->slots[TIME] > 0.35)
        for (volatile int forever = 1; forever;) {}
    if (mode(i) == DERIVATIVE_CRASHES && ((Probe *)i)->slots[TIME] > 0.35) *(volatile int *)NULL = 1;
    if (n) dx[0] = rate(i);
    return fmi3OK;
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t n) {
    if (i && n) x[0] = 1.0;
    return fmi3OK;
}
fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 z[], size_t n) { return (fmi3Status)indicate(i, z, n); }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance i, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *stop) {
    (void)final;
    return (fmi3Status)completed(i, event, stop);
}
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance i, fmi3Boolean *again, fmi3Boolean *stop, fmi3Boolean *nominals,
                                    fmi3Boolean *states, fmi3Boolean *defined, fmi3Float64 *next_event) {
    *nominals = false, *states = true, *defined = true;
    return (fmi3Status)update(i, again, stop, next_event);
}
fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 time, fmi3Float64 length, fmi3Boolean final, fmi3Boolean *event,
                      fmi3Boolean *stop, fmi3Boolean *early, fmi3Float64 *reached) {
    (void)final;
    Probe *p = i;
    *event = false, *stop = mode(p) == STEP_STOPS, *early = mode(p) == STEP_EARLY, *reached = time + 0.25 * length;
    if (p->has_event_mode && p->in_event_mode) return (fmi3Status)failed(p, ERROR);
    if (p->has_event_mode && mode(p) == EARLY_FOREVER) length *= 0.001, *early = true, *reached = time + length;
    if (p->has_event_mode && p->next_event <= time + length) { /* it returns early, at the time event */
        length = p->next_event - time;
        *event = *early = true, *reached = time + length;
    }
    return (fmi3Status)step(p, time, length);
}

fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) { return (fmi3Status)save(i, state); }
fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) { return (fmi3Status)restore(i, state); }
fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) { return i ? (fmi3Status)forget(state) : fmi3Error; }

/* --- FMI 2.0 ---------------------------------------------------------------------------------------------------- */
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    (void)name, (void)type, (void)resources, (void)visible, (void)logging;
    if (strcmp(token, "probe") != 0) {
        callbacks->logger(callbacks->componentEnvironment, name, fmi2Error, "logStatusError", "wrong %s", "token");
        return NULL;
    }
    Probe *p = create(false);
    p->callbacks2 = callbacks;
    return p;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean stop_defined, fmi2Real stop) {
    (void)stop_defined, (void)stop;
    set_up(PROBE(c), defined, tolerance, start);
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return (fmi2Status)initialised(c); }
fmi2Status fmi2EnterEventMode(fmi2Component c) { return (fmi2Status)fmi3EnterEventMode(c); }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return (fmi2Status)fmi3EnterContinuousTimeMode(c); }
fmi2Status fmi2Terminate(fmi2Component c) { return c ? fmi2OK : fmi2Error; }

#define ACCESS2(Name, discrete)                                                                                      \
    fmi2Status fmi2Get##Name(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##Name values[]) {   \
        for (size_t j = 0; j < n; j++) values[j] = (fmi2##Name)value_of(c, vr[j], 0);                               \
        return fmi2OK;                                                                                          \
    }                                                                                                           \
    fmi2Status fmi2Set##Name(fmi2Component c, const fmi2ValueReference vr[], size_t n,                          \
                             const fmi2##Name values[]) {                                                       \
        if (discrete && outside_of_event_mode(c)) return (fmi2Status)failed(c, ERROR);                          \
        for (size_t j = 0; j < n; j++) *slot(c, vr[j], 0) = (double)values[j];                                  \
        return fmi2OK;                                                                                          \
    }

ACCESS2(Real, false)
ACCESS2(Integer, true)
ACCESS2(Boolean, true)

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String values[]) {
    (void)vr, (void)n;
    snprintf(PROBE(c)->label, sizeof PROBE(c)->label, "%s", values[0]);
    return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    PROBE(c)->slots[TIME] = time;
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    return (fmi2Status)fmi3SetContinuousStates(c, x, n);
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    return (fmi2Status)fmi3GetContinuousStates(c, x, n);
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    return (fmi2Status)fmi3GetContinuousStateDerivatives(c, dx, n);
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    return (fmi2Status)fmi3GetNominalsOfContinuousStates(c, x, n);
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { return (fmi2Status)indicate(c, z, n); }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean final, fmi2Boolean *event, fmi2Boolean *stop) {
    bool wants_event, wants_stop;
    (void)final;
    int status = completed(c, &wants_event, &wants_stop);
    *event = wants_event, *stop = wants_stop;
    return (fmi2Status)status;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    bool again, stop;
    int status = update(c, &again, &stop, &info->nextEventTime);
    info->newDiscreteStatesNeeded = again, info->terminateSimulation = stop, info->nextEventTimeDefined = fmi2True;
    return (fmi2Status)status;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real length, fmi2Boolean final) {
    (void)final;
    return (fmi2Status)step(c, time, length);
}
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    (void)kind;
    *value = PROBE(c)->slots[TIME];
    return fmi2OK;
}
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) { return (fmi2Status)save(c, state); }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { return (fmi2Status)restore(c, state); }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) { return c ? (fmi2Status)forget(state) : fmi2Error; }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    if (kind != fmi2DoStepStatus) return fmi2Error;
    *value = (fmi2Status)pending(c);
    return fmi2OK;
}
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    if (kind != fmi2Terminated) return fmi2Error;
    *value = mode(c) == STEP_STOPS;
    return fmi2OK;
}
