/* Moving values between the signals, which are doubles, and the components' variables of any numeric type.
 *
 * Conversions are those of cosim/components/fmu/values.py: integers to the nearest within the range of the type, Booleans by being
 * non-zero.
 */
#include "fmi_calls.h"

static double to_integer(double value, double smallest, double largest) {
    double nearest = rint(value);
    return nearest > smallest ? (nearest < largest ? nearest : largest) : smallest;
}

static inline double scaled(const Transfer *transfer, int32_t i, double value) {
    return transfer->gains ? transfer->gains[i] * value + transfer->offsets[i] : value;
}

/* What an FMI function for values takes after the instance. */
#define ARGUMENTS2 transfer->references, (size_t)transfer->n_references, buffer
#define ARGUMENTS3 ARGUMENTS2, (size_t)transfer->n_values

/* Defines get_fmi<version>_<Name> and set_fmi<version>_<Name>; CONVERT turns the double `value` into the FMI type. */
#define DEFINE_ACCESS(version, Name, CONVERT)                                                                  \
    static bool get_fmi##version##_##Name(Agent *agent, const Transfer *transfer) {                            \
        const Component *component = called(agent, transfer->component);                                       \
        fmi##version##Name *buffer = transfer->buffer;                                                         \
        int call = GET_VALUES + transfer->type;                                                                \
        int status = (int)((fmi##version##Get##Name##TYPE *)component->functions[call])(component->instance,   \
                                                                                        ARGUMENTS##version);   \
        if (!check(agent, transfer->component, call, status)) return false;                                    \
        for (int32_t i = 0; i < transfer->n_values; i++)                                                       \
            agent->signals[transfer->positions[i]] = scaled(transfer, i, (double)buffer[i]);                   \
        return true;                                                                                           \
    }                                                                                                          \
    static bool set_fmi##version##_##Name(Agent *agent, const Transfer *transfer, const double *source) {      \
        const Component *component = called(agent, transfer->component);                                       \
        fmi##version##Name *buffer = transfer->buffer;                                                         \
        for (int32_t i = 0; i < transfer->n_values; i++) {                                                     \
            double value = scaled(transfer, i, source[transfer->positions[i]]);                                \
            buffer[i] = (fmi##version##Name)(CONVERT);                                                         \
        }                                                                                                      \
        int call = SET_VALUES + transfer->type;                                                                \
        int status = (int)((fmi##version##Set##Name##TYPE *)component->functions[call])(component->instance,   \
                                                                                        ARGUMENTS##version);   \
        return check(agent, transfer->component, call, status);                                                \
    }

DEFINE_ACCESS(2, Real, value)
DEFINE_ACCESS(2, Integer, to_integer(value, INT32_MIN, INT32_MAX))
DEFINE_ACCESS(2, Boolean, value != 0.0)
DEFINE_ACCESS(3, Float64, value)
DEFINE_ACCESS(3, Float32, value)
DEFINE_ACCESS(3, Int8, to_integer(value, INT8_MIN, INT8_MAX))
DEFINE_ACCESS(3, UInt8, to_integer(value, 0.0, UINT8_MAX))
DEFINE_ACCESS(3, Int16, to_integer(value, INT16_MIN, INT16_MAX))
DEFINE_ACCESS(3, UInt16, to_integer(value, 0.0, UINT16_MAX))
DEFINE_ACCESS(3, Int32, to_integer(value, INT32_MIN, INT32_MAX))
DEFINE_ACCESS(3, UInt32, to_integer(value, 0.0, UINT32_MAX))
DEFINE_ACCESS(3, Int64, to_integer(value, -0x1p63, 0x1.fffffffffffffp62))
DEFINE_ACCESS(3, UInt64, to_integer(value, 0.0, 0x1.fffffffffffffp63))
DEFINE_ACCESS(3, Boolean, value != 0.0)

static bool get_by_type(Agent *agent, const Transfer *transfer) {
    bool fmi3 = agent->components[transfer->component].fmi == 3;
    switch ((Type)transfer->type) {
        case FLOAT64: return fmi3 ? get_fmi3_Float64(agent, transfer) : get_fmi2_Real(agent, transfer);
        case INT32: return fmi3 ? get_fmi3_Int32(agent, transfer) : get_fmi2_Integer(agent, transfer);
        case FMI2_BOOLEAN: return get_fmi2_Boolean(agent, transfer);
        case FLOAT32: return get_fmi3_Float32(agent, transfer);
        case INT8: return get_fmi3_Int8(agent, transfer);
        case UINT8: return get_fmi3_UInt8(agent, transfer);
        case INT16: return get_fmi3_Int16(agent, transfer);
        case UINT16: return get_fmi3_UInt16(agent, transfer);
        case UINT32: return get_fmi3_UInt32(agent, transfer);
        case INT64: return get_fmi3_Int64(agent, transfer);
        case UINT64: return get_fmi3_UInt64(agent, transfer);
        case BOOLEAN: return get_fmi3_Boolean(agent, transfer);
        case N_TYPES: break;
    }
    return false;
}

static bool set_by_type(Agent *agent, const Transfer *transfer, const double *source) {
    bool fmi3 = agent->components[transfer->component].fmi == 3;
    switch ((Type)transfer->type) {
        case FLOAT64:
            return fmi3 ? set_fmi3_Float64(agent, transfer, source) : set_fmi2_Real(agent, transfer, source);
        case INT32: return fmi3 ? set_fmi3_Int32(agent, transfer, source) : set_fmi2_Integer(agent, transfer, source);
        case FMI2_BOOLEAN: return set_fmi2_Boolean(agent, transfer, source);
        case FLOAT32: return set_fmi3_Float32(agent, transfer, source);
        case INT8: return set_fmi3_Int8(agent, transfer, source);
        case UINT8: return set_fmi3_UInt8(agent, transfer, source);
        case INT16: return set_fmi3_Int16(agent, transfer, source);
        case UINT16: return set_fmi3_UInt16(agent, transfer, source);
        case UINT32: return set_fmi3_UInt32(agent, transfer, source);
        case INT64: return set_fmi3_Int64(agent, transfer, source);
        case UINT64: return set_fmi3_UInt64(agent, transfer, source);
        case BOOLEAN: return set_fmi3_Boolean(agent, transfer, source);
        case N_TYPES: break;
    }
    return false;
}

static bool not_finite(Agent *agent, int32_t index, int32_t i) {
    return fail(agent, (Failure){.reason = OUTPUT_NOT_FINITE,
                                 .component = agent->transfers[index].component,
                                 .transfer = index,
                                 .index = i});
}

static bool get(Agent *agent, int32_t index) {
    const Transfer *transfer = &agent->transfers[index];
    if (!get_by_type(agent, transfer)) return false;
    for (int32_t i = 0; i < transfer->n_values; i++)
        if (!isfinite(agent->signals[transfer->positions[i]])) return not_finite(agent, index, i);
    return true;
}

/* Doubles that lie one by one among the signals, as most do: the component reads and writes them in their place. */
static bool get_in_place(Agent *agent, int32_t index) {
    const Transfer *transfer = &agent->transfers[index];
    const Component *component = called(agent, transfer->component);
    Function f = component->functions[GET_VALUES + FLOAT64];
    size_t n = (size_t)transfer->n_references, n_values = (size_t)transfer->n_values;
    double *values = agent->signals + transfer->begin;
    int status = component->fmi == 3
                     ? (int)((fmi3GetFloat64TYPE *)f)(component->instance, transfer->references, n, values, n_values)
                     : (int)((fmi2GetRealTYPE *)f)(component->instance, transfer->references, n, values);
    if (!check(agent, transfer->component, GET_VALUES + FLOAT64, status)) return false;
    for (int32_t i = 0; i < transfer->n_values; i++)
        if (!isfinite(values[i])) return not_finite(agent, index, i);
    return true;
}

static bool set_in_place(Agent *agent, const Transfer *transfer, const double *source) {
    const Component *component = called(agent, transfer->component);
    Function f = component->functions[SET_VALUES + FLOAT64];
    size_t n = (size_t)transfer->n_references, n_values = (size_t)transfer->n_values;
    const double *values = source + transfer->begin;
    int status = component->fmi == 3
                     ? (int)((fmi3SetFloat64TYPE *)f)(component->instance, transfer->references, n, values, n_values)
                     : (int)((fmi2SetRealTYPE *)f)(component->instance, transfer->references, n, values);
    return check(agent, transfer->component, SET_VALUES + FLOAT64, status);
}

bool carry_out(Agent *agent, Transfers transfers, const double *source) {
    for (int32_t i = transfers.first; i < transfers.last; i++) {
        const Transfer *transfer = &agent->transfers[i];
        bool in_place = transfer->type == FLOAT64 && transfer->begin >= 0;
        if (transfer->to_component) {
            if (!(in_place ? set_in_place(agent, transfer, source) : set_by_type(agent, transfer, source))) return false;
        } else {
            if (!(in_place ? get_in_place(agent, i) : get(agent, i))) return false;
        }
    }
    return true;
}
