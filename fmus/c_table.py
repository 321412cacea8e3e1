"""The C side of a model's description: the structs that its code uses, and the table that the adapter uses."""

from __future__ import annotations

from fmus.description import Model, Variable

_MODES = {
    "parameter": "INSTANTIATED | INITIALIZATION",
    "input": "INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS | STEP",
    "discrete input": "INSTANTIATED | INITIALIZATION | EVENT | STEP",
}


def variables_header(model: Model, token: str) -> str:
    """`variables.h`: the structs Values and Arrays, sizes, and the instantiation token."""
    fixed = [variable for variable in _stored(model) if not variable.dynamic]
    dynamic = [variable for variable in _stored(model) if variable.dynamic]
    checked = sum(v.columns for v in fixed if v.is_state or v.evaluated)
    lines = [
        f"/* Generated from {model.name}/model.toml. */",
        "#ifndef VARIABLES_H",
        "#define VARIABLES_H",
        "#include <stdint.h>",
        f'#define INSTANTIATION_TOKEN "{token}"',
        f"#define N_STATES {sum(state.columns for state in model.states)}",
        f"#define N_CHECKED {checked} /* states, derivatives and computed variables, at the start of Values */",
        f"#define N_VARIABLES {len(model.variables)}",
        f"#define MAX_ROWS {model.structural.maximum if model.structural else 0}",
        f"#define ROW_BYTES {8 * sum(variable.columns for variable in dynamic)}",
        "typedef struct {",
        *(f"    {_c_type(v)} {v.c_name}{f'[{v.columns}]' if v.shape else ''};{_comment(v)}" for v in fixed),
        "} Values;",
        "typedef struct {",
        *(f"    {_c_type(v)} *{v.c_name}; /* {v.columns} per row */" for v in dynamic),
        *(["    char none;"] if not dynamic else []),
        "} Arrays;",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def table_header(model: Model) -> str:
    """`table.h`: the table of variables by value reference, and where the dynamic arrays lie."""
    dynamic = [variable for variable in _stored(model) if variable.dynamic]
    offsets = {}
    row_bytes = 0
    for variable in dynamic:
        offsets[variable.name] = row_bytes
        row_bytes += 8 * variable.columns
    starts = [
        f"static const double start_{v.c_name}[] = {{{', '.join(_number(x) for x in v.start)}}};"
        for v in model.variables
        if v.start
    ]
    rows = f"(size_t)values->{model.structural.name}" if model.structural else "0"
    lines = [
        f"/* Generated from {model.name}/model.toml. */",
        *starts,
        "static const Variable variables[N_VARIABLES] = {",
        *(_row(variable, offsets) for variable in model.variables),
        "};",
        "static size_t start_rows(const Values *values) {",
        "    (void)values;",
        f"    return {rows};",
        "}",
        "static void bind_arrays(Arrays *arrays, char *data, size_t rows) {",
        "    (void)arrays, (void)data, (void)rows;",
        *(f"    arrays->{v.c_name} = ({_c_type(v)} *)(data + rows * {offsets[v.name]});" for v in dynamic),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _stored(model: Model) -> list[Variable]:
    """Every variable in the order of storage: the first N_CHECKED numbers are those that must stay finite."""
    states, derivatives = model.states, model.derivatives
    computed = [v for v in model.variables if v.evaluated and not v.state]
    first = [*states, *derivatives, *computed]
    return [*first, *(v for v in model.variables if v not in first), *model.memory]


def _c_type(variable: Variable) -> str:
    return "double" if variable.kind == "Real" else "int64_t"


def _comment(variable: Variable) -> str:
    return f" /* {variable.unit} */" if variable.unit else ""


def _number(value: float) -> str:
    return repr(float(value))


def _row(variable: Variable, offsets: dict[str, int]) -> str:
    settable = _MODES["parameter"] if variable.initial == "exact" else "0"
    if variable.causality == "input":
        settable = _MODES["input" if variable.variability == "continuous" else "discrete input"]
    computed = "STORED"
    if variable.initial == "calculated":
        computed = "EVALUATED" if variable.evaluated else "INITIALIZED"
    offset = str(offsets[variable.name]) if variable.dynamic else f"offsetof(Values, {variable.c_name})"
    minimum = "INT64_MIN" if variable.minimum is None else str(variable.minimum)
    maximum = "INT64_MAX" if variable.maximum is None else str(variable.maximum)
    if variable.kind == "Boolean":
        minimum, maximum = "0", "1"
    fields = [
        f'"{variable.name}"',
        variable.kind.upper(),
        settable,
        computed,
        "true" if variable.dynamic else "false",
        str(variable.columns),
        offset,
        f"start_{variable.c_name}" if variable.start else "NULL",
        minimum,
        maximum,
    ]
    return f"    {{{', '.join(fields)}}},"
