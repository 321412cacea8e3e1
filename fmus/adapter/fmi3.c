/* FMI 3.0 for Model Exchange and Co-Simulation. An array has one value reference. */
#include <math.h>
#include <string.h>

#include "fmi3Functions.h"
#include "instance.h"

static fmi3Status status_of(const Instance *instance, bool ok) {
    if (ok) return fmi3OK;
    instance->log(instance);
    return fmi3Error;
}

static void send_log(const Instance *instance) {
    fmi3LogMessageCallback logger = (fmi3LogMessageCallback)instance->callback;
    if (logger) logger(instance->environment, fmi3Error, "logStatusError", instance->model.message);
}

/* Fails, with one line in the log, if the instance is not in one of the modes. */
#define EXPECT(modes)                                                                         \
    do {                                                                                      \
        if (!instance_expect(instance, (modes), __func__)) return status_of(instance, false); \
    } while (0)

static fmi3Status not_offered(Instance *instance, const char *function) {
    return status_of(instance, fail(&instance->model, "%s is not offered by this FMU", function));
}

/* --- creation --------------------------------------------------------------------------------------------------- */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    return fmi3OK; /* only errors are logged, and those always */
}

static Instance *instantiate(const char *name, const char *token, bool model_exchange, const char *problem,
                             void *environment, fmi3LogMessageCallback logMessage) {
    Instance *instance = NULL;
    if (!name || name[0] == '\0')
        problem = "the instance name is missing";
    else if (!token || strcmp(token, INSTANTIATION_TOKEN) != 0)
        problem = "the instantiation token is not that of this binary: modelDescription.xml belongs to another build";
    else if (!problem && !(instance = instance_create(name, model_exchange, false)))
        problem = "out of memory";
    if (problem) {
        if (logMessage) logMessage(environment, fmi3Error, "logStatusError", problem);
        return NULL;
    }
    instance->log = send_log;
    instance->callback = (void (*)(void))logMessage;
    instance->environment = environment;
    return instance;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    return instantiate(instanceName, instantiationToken, true, NULL, instanceEnvironment, logMessage);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
    const char *problem = eventModeUsed ? "this FMU has no Event Mode in Co-Simulation (hasEventMode = false)" : NULL;
    return instantiate(instanceName, instantiationToken, false, problem, instanceEnvironment, logMessage);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken,
                                               fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment,
                                               fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
    return instantiate(instanceName, instantiationToken, false, "this FMU does not offer Scheduled Execution",
                       instanceEnvironment, logMessage);
}

void fmi3FreeInstance(fmi3Instance instance) { instance_free(instance); }

/* --- life cycle ------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) {
    EXPECT(INSTANTIATED);
    ((Instance *)instance)->mode = CONFIGURATION;
    return fmi3OK;
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) {
    EXPECT(CONFIGURATION);
    return status_of(instance, instance_exit_configuration(instance));
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    EXPECT(INSTANTIATED);
    return status_of(instance,
                     instance_enter_initialization(instance, startTime, stopTimeDefined ? stopTime : INFINITY));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    EXPECT(INITIALIZATION);
    return status_of(instance, instance_exit_initialization(instance));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    EXPECT(RUNNING);
    ((Instance *)instance)->mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) { return status_of(instance, instance_reset(instance)); }

/* --- variables -------------------------------------------------------------------------------------------------- */

/* Checks that the variables exist, have one of the types and hold nValues numbers in all. */
static bool check_sizes(Instance *instance, const fmi3ValueReference references[], size_t count, int types,
                        size_t nValues) {
    size_t total = 0;
    for (size_t i = 0; i < count; i++) {
        const Variable *variable = instance_variable(instance, references[i], types);
        if (!variable) return false;
        total += instance_size(instance, variable);
    }
    if (total == nValues) return true;
    const Variable *first = instance_variable(instance, references[0], types);
    return fail(&instance->model, "%s%s: %zu values expected, but nValues is %zu", first ? first->name : "no variable",
                count > 1 ? " and others" : "", total, nValues);
}

#define DEFINE_GET(Name, CType, types, Stored)                                                                   \
    fmi3Status fmi3Get##Name(fmi3Instance instance, const fmi3ValueReference valueReferences[],                  \
                             size_t nValueReferences, CType values[], size_t nValues) {                          \
        if (!check_sizes(instance, valueReferences, nValueReferences, (types), nValues))                         \
            return status_of(instance, false);                                                                   \
        for (size_t i = 0; i < nValueReferences; i++) {                                                          \
            const Variable *variable = instance_variable(instance, valueReferences[i], (types));                 \
            if (!instance_can_get(instance, variable)) return status_of(instance, false);                        \
            const Stored *data = instance_data(instance, variable);                                              \
            for (size_t size = instance_size(instance, variable); size > 0; size--) *values++ = (CType)*data++;  \
        }                                                                                                        \
        return fmi3OK;                                                                                           \
    }

#define DEFINE_SET(Name, CType, types, set)                                                                      \
    fmi3Status fmi3Set##Name(fmi3Instance instance, const fmi3ValueReference valueReferences[],                  \
                             size_t nValueReferences, const CType values[], size_t nValues) {                    \
        if (!check_sizes(instance, valueReferences, nValueReferences, (types), nValues))                         \
            return status_of(instance, false);                                                                   \
        for (size_t i = 0; i < nValueReferences; i++) {                                                          \
            const Variable *variable = instance_variable(instance, valueReferences[i], (types));                 \
            if (!instance_can_set(instance, variable)) return status_of(instance, false);                        \
            for (size_t element = 0; element < instance_size(instance, variable); element++)                     \
                if (!set(instance, variable, element, *values++)) return status_of(instance, false);             \
        }                                                                                                        \
        return fmi3OK;                                                                                           \
    }

static bool set_size(Instance *instance, const Variable *variable, size_t element, fmi3UInt64 value) {
    return instance_set_integer(instance, variable, element, value > INT64_MAX ? INT64_MAX : (int64_t)value);
}

DEFINE_GET(Float64, fmi3Float64, REAL, double)
DEFINE_GET(Int64, fmi3Int64, INTEGER | ENUMERATION, int64_t)
DEFINE_GET(UInt64, fmi3UInt64, SIZE, int64_t)
DEFINE_GET(Boolean, fmi3Boolean, BOOLEAN, int64_t)
DEFINE_SET(Float64, fmi3Float64, REAL, instance_set_real)
DEFINE_SET(Int64, fmi3Int64, INTEGER | ENUMERATION, instance_set_integer)
DEFINE_SET(UInt64, fmi3UInt64, SIZE, set_size)
DEFINE_SET(Boolean, fmi3Boolean, BOOLEAN, instance_set_integer)

static fmi3Status no_such_type(Instance *instance, size_t count, const char *type) {
    if (count == 0) return fmi3OK;
    return status_of(instance, fail(&instance->model, "this FMU has no variable of type %s", type));
}

#define DEFINE_ABSENT(Name)                                                                                     \
    fmi3Status fmi3Get##Name(fmi3Instance instance, const fmi3ValueReference valueReferences[],                 \
                             size_t nValueReferences, fmi3##Name values[], size_t nValues) {                    \
        return no_such_type(instance, nValueReferences, #Name);                                                 \
    }                                                                                                           \
    fmi3Status fmi3Set##Name(fmi3Instance instance, const fmi3ValueReference valueReferences[],                 \
                             size_t nValueReferences, const fmi3##Name values[], size_t nValues) {              \
        return no_such_type(instance, nValueReferences, #Name);                                                 \
    }

DEFINE_ABSENT(Float32)
DEFINE_ABSENT(Int8)
DEFINE_ABSENT(UInt8)
DEFINE_ABSENT(Int16)
DEFINE_ABSENT(UInt16)
DEFINE_ABSENT(Int32)
DEFINE_ABSENT(UInt32)
DEFINE_ABSENT(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                         size_t valueSizes[], fmi3Binary values[], size_t nValues) {
    return no_such_type(instance, nValueReferences, "Binary");
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                         const size_t valueSizes[], const fmi3Binary values[], size_t nValues) {
    return no_such_type(instance, nValueReferences, "Binary");
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        fmi3Clock values[]) {
    return no_such_type(instance, nValueReferences, "Clock");
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Clock values[]) {
    return no_such_type(instance, nValueReferences, "Clock");
}

/* --- state ------------------------------------------------------------------------------------------------------ */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    Snapshot *snapshot = instance_save(instance);
    if (snapshot) {
        free_snapshot(*FMUState);
        *FMUState = snapshot;
    }
    return status_of(instance, snapshot != NULL);
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    return status_of(instance, instance_restore(instance, FMUState));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    free_snapshot(*FMUState);
    *FMUState = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    *size = snapshot_size(FMUState);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[],
                                 size_t size) {
    return status_of(instance, instance_serialize(instance, FMUState, serializedState, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size,
                                   fmi3FMUState *FMUState) {
    *FMUState = instance_deserialize(instance, serializedState, size);
    return status_of(instance, *FMUState != NULL);
}

/* --- Model Exchange --------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    EXPECT(CONTINUOUS | EVENT);
    ((Instance *)instance)->mode = EVENT;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
                                    fmi3Float64 *nextEventTime) {
    EXPECT(EVENT);
    if (!instance_update(instance)) return status_of(instance, false);
    double next = model_next_event(&((Instance *)instance)->model);
    *discreteStatesNeedUpdate = false;
    *terminateSimulation = false;
    *nominalsOfContinuousStatesChanged = false;
    *valuesOfContinuousStatesChanged = false;
    *nextEventTimeDefined = next < INFINITY;
    *nextEventTime = next < INFINITY ? next : 0.0;
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    EXPECT(EVENT);
    ((Instance *)instance)->mode = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    EXPECT(CONTINUOUS);
    *enterEventMode = false;
    *terminateSimulation = false;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    EXPECT(EVENT | CONTINUOUS);
    return status_of(instance, instance_set_time(instance, time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    EXPECT(CONTINUOUS);
    return status_of(instance, instance_set_states(instance, continuousStates, nContinuousStates));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t nContinuousStates) {
    EXPECT(INITIALIZATION | EVENT | CONTINUOUS);
    return status_of(instance, instance_get_derivatives(instance, derivatives, nContinuousStates));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[], size_t nContinuousStates) {
    EXPECT(INITIALIZATION | EVENT | CONTINUOUS);
    return status_of(instance, instance_get_states(instance, continuousStates, nContinuousStates));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t nContinuousStates) {
    return status_of(instance, instance_get_nominals(instance, nominals, nContinuousStates));
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[], size_t nEventIndicators) {
    return status_of(instance, instance_expect_none(instance, nEventIndicators, "event indicator"));
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    *nEventIndicators = 0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    *nContinuousStates = instance_states(instance);
    return fmi3OK;
}

/* --- Co-Simulation ---------------------------------------------------------------------------------------------- */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    EXPECT(STEP);
    bool ok = instance_step(instance, currentCommunicationPoint, communicationStepSize);
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = ((Instance *)instance)->model.values->time;
    return status_of(instance, ok);
}

/* --- not offered ------------------------------------------------------------------------------------------------ */

fmi3Status fmi3EnterStepMode(fmi3Instance instance) { return not_offered(instance, __func__); }

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                    size_t nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[],
                                    size_t nValues) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clockReference,
                                      fmi3Float64 activationTime) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) { return not_offered(instance, __func__); }

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference valueReference,
                                               size_t *nDependencies) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
                                       size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
                                       size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
                                       size_t nDependencies) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                        size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
                                    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[],
                                    size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, fmi3Float64 shifts[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, const fmi3Float64 intervals[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, const fmi3Float64 shifts[]) {
    return not_offered(instance, __func__);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, const fmi3UInt64 counters[],
                                const fmi3UInt64 resolutions[]) {
    return not_offered(instance, __func__);
}
