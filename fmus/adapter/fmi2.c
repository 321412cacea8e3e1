/* FMI 2.0 for Model Exchange and Co-Simulation. An array is flattened: the value reference of an element is that of
 * the array times ELEMENTS plus the element's row-major index, as the build writes it to modelDescription.xml. */
#include <math.h>
#include <string.h>

#include "fmi2Functions.h"
#include "instance.h"

#define ELEMENTS 256

static fmi2Status status_of(const Instance *instance, bool ok) {
    if (ok) return fmi2OK;
    instance->log(instance);
    return fmi2Error;
}

/* The message is complete, without a '%': environments that don't format it show it all the same. */
static void send_log(const Instance *instance) {
    fmi2CallbackLogger logger = (fmi2CallbackLogger)instance->callback;
    if (logger)
        logger(instance->environment, instance->name, fmi2Error, "logStatusError", instance->model.message);
}

/* Fails, with one line in the log, if the instance is not in one of the modes. */
#define EXPECT(modes)                                                             \
    do {                                                                          \
        if (!instance_expect(c, (modes), __func__)) return status_of(c, false);   \
    } while (0)

/* --- creation --------------------------------------------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    return fmi2OK; /* only errors are logged, and those always */
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn) {
    const char *name = instanceName ? instanceName : "";
    const char *problem = NULL;
    Instance *instance = NULL;
    if (name[0] == '\0')
        problem = "the instance name is missing";
    else if (!fmuGUID || strcmp(fmuGUID, INSTANTIATION_TOKEN) != 0)
        problem = "the GUID is not that of this binary: modelDescription.xml belongs to another build";
    else if (!(instance = instance_create(name, fmuType == fmi2ModelExchange, true)))
        problem = "out of memory";
    if (problem) {
        if (functions && functions->logger)
            functions->logger(functions->componentEnvironment, name, fmi2Error, "logStatusError", problem);
        return NULL;
    }
    instance->log = send_log;
    instance->callback = functions ? (void (*)(void))functions->logger : NULL;
    instance->environment = functions ? functions->componentEnvironment : NULL;
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { instance_free(c); }

/* --- life cycle ------------------------------------------------------------------------------------------------- */

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    Instance *instance = c;
    EXPECT(INSTANTIATED);
    instance->start_time = startTime;
    instance->stop_time = stopTimeDefined ? stopTime : INFINITY;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    Instance *instance = c;
    EXPECT(INSTANTIATED);
    return status_of(c, instance_enter_initialization(c, instance->start_time, instance->stop_time));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    EXPECT(INITIALIZATION);
    return status_of(c, instance_exit_initialization(c));
}

fmi2Status fmi2Terminate(fmi2Component c) {
    EXPECT(RUNNING);
    ((Instance *)c)->mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) { return status_of(c, instance_reset(c)); }

/* --- variables -------------------------------------------------------------------------------------------------- */

/* The variable and its element that a value reference stands for; NULL, with a message, if there is none. */
static const Variable *find(Instance *instance, fmi2ValueReference reference, int types, size_t *element) {
    *element = reference % ELEMENTS;
    if (reference / ELEMENTS < N_VARIABLES) {
        const Variable *variable = instance_variable(instance, reference / ELEMENTS, types);
        if (!variable || *element < instance_size(instance, variable)) return variable;
    }
    fail(&instance->model, "there is no variable with value reference %u", reference);
    return NULL;
}

#define DEFINE_GET(Name, CType, types, Stored)                                                            \
    fmi2Status fmi2Get##Name(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, CType value[]) { \
        for (size_t i = 0; i < nvr; i++) {                                                                \
            size_t element;                                                                               \
            const Variable *variable = find(c, vr[i], (types), &element);                                 \
            if (!variable || !instance_can_get(c, variable)) return status_of(c, false);                  \
            value[i] = (CType)((const Stored *)instance_data(c, variable))[element];                      \
        }                                                                                                 \
        return fmi2OK;                                                                                    \
    }

#define DEFINE_SET(Name, CType, types, set)                                                                     \
    fmi2Status fmi2Set##Name(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const CType value[]) { \
        for (size_t i = 0; i < nvr; i++) {                                                                      \
            size_t element;                                                                                     \
            const Variable *variable = find(c, vr[i], (types), &element);                                       \
            if (!variable || !instance_can_set(c, variable) || !set(c, variable, element, value[i]))            \
                return status_of(c, false);                                                                     \
        }                                                                                                       \
        return fmi2OK;                                                                                          \
    }

DEFINE_GET(Real, fmi2Real, REAL, double)
DEFINE_GET(Integer, fmi2Integer, INTEGER | SIZE | ENUMERATION, int64_t)
DEFINE_GET(Boolean, fmi2Boolean, BOOLEAN, int64_t)
DEFINE_SET(Real, fmi2Real, REAL, instance_set_real)
DEFINE_SET(Integer, fmi2Integer, INTEGER | SIZE | ENUMERATION, instance_set_integer)
DEFINE_SET(Boolean, fmi2Boolean, BOOLEAN, instance_set_integer)

static fmi2Status no_such_type(Instance *instance, size_t nvr, const char *type) {
    if (nvr == 0) return fmi2OK;
    return status_of(instance, fail(&instance->model, "this FMU has no variable of type %s", type));
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[]) {
    return no_such_type(c, nvr, "String");
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[]) {
    return no_such_type(c, nvr, "String");
}

/* --- state ------------------------------------------------------------------------------------------------------ */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    Snapshot *snapshot = instance_save(c);
    if (snapshot) {
        free_snapshot(*FMUstate);
        *FMUstate = snapshot;
    }
    return status_of(c, snapshot != NULL);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    return status_of(c, instance_restore(c, FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    free_snapshot(*FMUstate);
    *FMUstate = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    *size = snapshot_size(FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
    return status_of(c, instance_serialize(c, FMUstate, serializedState, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    *FMUstate = instance_deserialize(c, serializedState, size);
    return status_of(c, *FMUstate != NULL);
}

/* --- Model Exchange --------------------------------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    EXPECT(CONTINUOUS | EVENT);
    ((Instance *)c)->mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *fmi2eventInfo) {
    EXPECT(EVENT);
    if (!instance_update(c)) return status_of(c, false);
    double next = model_next_event(&((Instance *)c)->model);
    *fmi2eventInfo = (fmi2EventInfo){
        .nextEventTimeDefined = next < INFINITY,
        .nextEventTime = next < INFINITY ? next : 0.0,
    };
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    EXPECT(EVENT);
    ((Instance *)c)->mode = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation) {
    EXPECT(CONTINUOUS);
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    EXPECT(EVENT | CONTINUOUS);
    return status_of(c, instance_set_time(c, time));
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    EXPECT(CONTINUOUS);
    return status_of(c, instance_set_states(c, x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    EXPECT(INITIALIZATION | EVENT | CONTINUOUS);
    return status_of(c, instance_get_derivatives(c, derivatives, nx));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    EXPECT(INITIALIZATION | EVENT | CONTINUOUS);
    return status_of(c, instance_get_states(c, x, nx));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    return status_of(c, instance_get_nominals(c, x_nominal, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    return status_of(c, instance_expect_none(c, ni, "event indicator"));
}

/* --- Co-Simulation ---------------------------------------------------------------------------------------------- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    EXPECT(STEP);
    return status_of(c, instance_step(c, currentCommunicationPoint, communicationStepSize));
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) { return fmi2Discard; }

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    if (s != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = ((Instance *)c)->model.values->time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) { return fmi2Discard; }

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (s != fmi2Terminated) return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) { return fmi2Discard; }

/* --- not offered ------------------------------------------------------------------------------------------------ */

static fmi2Status not_offered(Instance *instance, const char *function) {
    return status_of(instance, fail(&instance->model, "%s is not offered by this FMU", function));
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
    return not_offered(c, __func__);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    return not_offered(c, __func__);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    return not_offered(c, __func__);
}

fmi2Status fmi2CancelStep(fmi2Component c) { return not_offered(c, __func__); }
