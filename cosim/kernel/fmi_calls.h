/* One call for both versions of FMI: each returns false, with the failure noted, unless the status is OK or Warning.
 *
 * The types of the functions are those of the official headers.
 */
#ifndef NETCOSIM_FMI_CALLS_H
#define NETCOSIM_FMI_CALLS_H

#include <math.h>
#include <stddef.h>

#include "kernel.h"

/* The official headers write () for (void) in places. */
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wstrict-prototypes"
#endif
#include "fmi2FunctionTypes.h"
#include "fmi3FunctionTypes.h"
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif

static inline bool check(Agent *agent, int component, int call, int status) {
    if (status <= fmi3Warning) return true;
    return fail(agent, (Failure){.reason = CALL_FAILED, .component = component, .call = call, .status = status});
}

/* The component, about to be called. */
static inline const Component *called(Agent *agent, int component) {
    *agent->called = component;
    return &agent->components[component];
}

static inline bool stop_requested(Agent *agent, int component) {
    return fail(agent, (Failure){.reason = STOP_REQUESTED, .component = component});
}

static inline bool set_time(Agent *agent, int index, double time) {
    const Component *c = called(agent, index);
    Function f = c->functions[SET_TIME];
    int status = c->fmi == 3 ? (int)((fmi3SetTimeTYPE *)f)(c->instance, time)
                             : (int)((fmi2SetTimeTYPE *)f)(c->instance, time);
    return check(agent, index, SET_TIME, status);
}

static inline bool set_states(Agent *agent, int index, const double *states) {
    const Component *c = called(agent, index);
    Function f = c->functions[SET_STATES];
    size_t n = (size_t)c->n_states;
    if (n == 0) return true;
    int status = c->fmi == 3 ? (int)((fmi3SetContinuousStatesTYPE *)f)(c->instance, states, n)
                             : (int)((fmi2SetContinuousStatesTYPE *)f)(c->instance, states, n);
    return check(agent, index, SET_STATES, status);
}

static inline bool get_states(Agent *agent, int index, double *states) {
    const Component *c = called(agent, index);
    Function f = c->functions[GET_STATES];
    size_t n = (size_t)c->n_states;
    if (n == 0) return true;
    int status = c->fmi == 3 ? (int)((fmi3GetContinuousStatesTYPE *)f)(c->instance, states, n)
                             : (int)((fmi2GetContinuousStatesTYPE *)f)(c->instance, states, n);
    return check(agent, index, GET_STATES, status);
}

static inline bool get_derivatives(Agent *agent, int index, double *derivatives) {
    const Component *c = called(agent, index);
    Function f = c->functions[GET_DERIVATIVES];
    size_t n = (size_t)c->n_states;
    if (n == 0) return true;
    int status = c->fmi == 3 ? (int)((fmi3GetContinuousStateDerivativesTYPE *)f)(c->instance, derivatives, n)
                             : (int)((fmi2GetDerivativesTYPE *)f)(c->instance, derivatives, n);
    return check(agent, index, GET_DERIVATIVES, status);
}

static inline bool get_indicators(Agent *agent, int index, double *indicators) {
    const Component *c = called(agent, index);
    Function f = c->functions[GET_INDICATORS];
    size_t n = (size_t)c->n_indicators;
    if (n == 0) return true;
    int status = c->fmi == 3 ? (int)((fmi3GetEventIndicatorsTYPE *)f)(c->instance, indicators, n)
                             : (int)((fmi2GetEventIndicatorsTYPE *)f)(c->instance, indicators, n);
    return check(agent, index, GET_INDICATORS, status);
}

/* Sets `wants_event` if the component asks for Event Mode, and leaves it alone otherwise. */
static inline bool completed_step(Agent *agent, int index, bool *wants_event) {
    const Component *c = called(agent, index);
    Function f = c->functions[COMPLETED_STEP];
    int status;
    bool stop, event;
    if (c->fmi == 3) {
        fmi3Boolean event3 = false, stop3 = false;
        status = (int)((fmi3CompletedIntegratorStepTYPE *)f)(c->instance, true, &event3, &stop3);
        event = event3, stop = stop3;
    } else {
        fmi2Boolean event2 = fmi2False, stop2 = fmi2False;
        status = (int)((fmi2CompletedIntegratorStepTYPE *)f)(c->instance, fmi2True, &event2, &stop2);
        event = event2 != fmi2False, stop = stop2 != fmi2False;
    }
    if (!check(agent, index, COMPLETED_STEP, status)) return false;
    if (stop) return stop_requested(agent, index);
    if (event) *wants_event = true;
    return true;
}

/* A function of FMI 2.0 and 3.0 that takes the instance alone. */
static inline bool change_mode(Agent *agent, int index, Call call) {
    const Component *c = called(agent, index);
    Function f = c->functions[call];
    int status = c->fmi == 3 ? (int)((fmi3EnterEventModeTYPE *)f)(c->instance)
                             : (int)((fmi2EnterEventModeTYPE *)f)(c->instance);
    return check(agent, index, (int)call, status);
}

/* One update; `again` says whether another is needed, `next_event` is the next time event in seconds or INFINITY. */
static inline bool update_once(Agent *agent, int index, bool *again, double *next_event) {
    const Component *c = called(agent, index);
    Function f = c->functions[UPDATE_DISCRETE_STATES];
    int status;
    bool stop, defined;
    double time;
    if (c->fmi == 3) {
        fmi3Boolean again3 = false, stop3 = false, nominals = false, states = false, defined3 = false;
        fmi3Float64 time3 = 0.0;
        status = (int)((fmi3UpdateDiscreteStatesTYPE *)f)(c->instance, &again3, &stop3, &nominals, &states, &defined3,
                                                          &time3);
        *again = again3, stop = stop3, defined = defined3, time = time3;
    } else {
        fmi2EventInfo info = {0};
        status = (int)((fmi2NewDiscreteStatesTYPE *)f)(c->instance, &info);
        *again = info.newDiscreteStatesNeeded != fmi2False;
        stop = info.terminateSimulation != fmi2False;
        defined = info.nextEventTimeDefined != fmi2False;
        time = info.nextEventTime;
    }
    if (!check(agent, index, UPDATE_DISCRETE_STATES, status)) return false;
    if (stop) return stop_requested(agent, index);
    *next_event = defined ? time : INFINITY;
    return true;
}

/* One call; `needed` says whether events are to be handled, `early` whether it only got to `reached`. */
static inline bool step_once(Agent *agent, int index, double time, double step, bool *needed, bool *early,
                             double *reached) {
    const Component *c = called(agent, index);
    Function f = c->functions[DO_STEP];
    *needed = *early = false;
    if (c->fmi == 2)
        return check(agent, index, DO_STEP, (int)((fmi2DoStepTYPE *)f)(c->instance, time, step, fmi2True));
    fmi3Boolean event = false, stop = false, short_of = false;
    *reached = 0.0;
    int status = (int)((fmi3DoStepTYPE *)f)(c->instance, time, step, true, &event, &stop, &short_of, reached);
    if (!check(agent, index, DO_STEP, status)) return false;
    if (stop) return stop_requested(agent, index);
    *needed = event, *early = short_of;
    return true;
}

#endif
