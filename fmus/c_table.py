"""The C side of a model's description: the structs that its code uses, and the table that the adapter uses."""

from __future__ import annotations

from fmus.description import Model, Variable

_MODES = {
    "parameter": "INSTANTIATED | INITIALIZATION",
    "input": "INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS | STEP",
    "discrete input": "INSTANTIATED | INITIALIZATION | EVENT | STEP",
}


def variables_header(model: Model, token: str) -> str:
    """`variables.h`: the structs Values, Extents and Arrays, sizes, and the instantiation token."""
    fixed = [variable for variable in _stored(model) if not variable.dynamic]
    dynamic = [variable for variable in _stored(model) if variable.dynamic]
    lines = [
        f"/* Generated from {model.name}/model.toml. */",
        "#ifndef VARIABLES_H",
        "#define VARIABLES_H",
        "#include <stddef.h>",
        "#include <stdint.h>",
        f'#define INSTANTIATION_TOKEN "{token}"',
        f"#define DYNAMIC_STATES {int(any(state.dynamic for state in model.states))}",
        f"#define N_STATES {sum(state.columns for state in model.states)} /* if they are not dynamic */",
        f"#define N_CHECKED {sum(v.columns for v in fixed if _checked(v))} /* at the start of Values */",
        f"#define N_VARIABLES {len(model.variables)}",
        f"#define N_EXTENTS {len(model.structural)}",
        f"#define SOLVER_STEP(values) {'((values)->solver_step)' if model.states else '1e300'}",
        "typedef struct {",
        *(f"    {_c_type(v)} {v.c_name}{f'[{v.columns}]' if v.shape else ''};{_comment(v)}" for v in fixed),
        "} Values;",
        "typedef struct {",
        *(f"    size_t {v.name};" for v in model.structural),
        *(["    size_t none;"] if not model.structural else []),
        "} Extents;",
        "typedef struct {",
        *(f"    {_c_type(v)} *{v.c_name}; /* {' x '.join(map(str, v.shape))} */" for v in dynamic),
        *(["    char none;"] if not dynamic else []),
        "} Arrays;",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def table_header(model: Model) -> str:
    """`table.h`: the table of variables by value reference, and how the dynamic arrays lie one behind the other."""
    dynamic = [variable for variable in _stored(model) if variable.dynamic]
    starts = [
        f"static const double start_{v.c_name}[] = {{{', '.join(_number(x) for x in v.start)}}};"
        for v in model.variables
        if v.start
    ]
    sizing = [variable.name for variable in model.structural]
    lines = [
        f"/* Generated from {model.name}/model.toml. */",
        *starts,
        "static const Variable variables[N_VARIABLES] = {",
        *(_row(variable, sizing) for variable in model.variables),
        "};",
        "static const size_t maximal[N_EXTENTS + 1] = {",
        f"    {', '.join([*(str(v.maximum or 0) for v in model.structural), '0'])}",
        "};",
        "static void read_extents(const Values *values, Extents *extents) {",
        "    (void)values, (void)extents;",
        *(f"    extents->{name} = (size_t)values->{name};" for name in sizing),
        "}",
        "/* Numbers in all dynamic arrays, in the states among them, and in those among them that must stay finite. */",
        *_count("total_count", dynamic),
        *_count("state_count", [v for v in dynamic if v.is_state]),
        *_count("checked_count", [v for v in dynamic if _checked(v)]),
        "static void bind_arrays(Arrays *arrays, char *data, const Extents *extents) {",
        "    (void)arrays, (void)data, (void)extents;",
    ]
    for variable in dynamic:
        lines.append(f"    arrays->{variable.c_name} = ({_c_type(variable)} *)data;")
        lines.append(f"    data += 8 * {_product(variable, 'extents->')};")
    return "\n".join([*lines, "}"]) + "\n"


def _count(name: str, variables: list[Variable]) -> list[str]:
    """A function that adds up the variables' sizes, in floating point: the product of two sizes may be too large."""
    terms = [_product(variable, "(double)extents->") for variable in variables]
    return [
        f"static double {name}(const Extents *extents) {{",
        "    (void)extents;",
        f"    return {' + '.join([*terms, '0.0'])};",
        "}",
    ]


def _product(variable: Variable, prefix: str) -> str:
    return " * ".join([str(variable.columns), *(f"{prefix}{extent}" for extent in variable.extents)])


def _checked(variable: Variable) -> bool:
    """Whether the adapter looks for values in it that are not finite."""
    return variable.is_state or variable.evaluated


def _stored(model: Model) -> list[Variable]:
    """Every variable in the order of storage: states, derivatives and other computed variables come first."""
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


def _row(variable: Variable, sizing: list[str]) -> str:
    settable = _MODES["parameter"] if variable.initial == "exact" else "0"
    if variable.causality == "input":
        settable = _MODES["input" if variable.variability == "continuous" else "discrete input"]
    computed = "STORED"
    if variable.initial == "calculated":
        computed = "EVALUATED" if variable.evaluated else "INITIALIZED"
    struct = "Arrays" if variable.dynamic else "Values"
    extents = [sizing.index(extent) for extent in variable.extents]
    minimum = "INT64_MIN" if variable.minimum is None else str(variable.minimum)
    maximum = "INT64_MAX" if variable.maximum is None else str(variable.maximum)
    if variable.kind == "Boolean":
        minimum, maximum = "0", "1"
    fields = [
        f'"{variable.name}"',
        variable.kind.upper(),
        settable,
        computed,
        str(len(extents)),
        f"{{{', '.join(map(str, (*extents, 0, 0)[:2]))}}}",
        str(variable.columns),
        f"offsetof({struct}, {variable.c_name})",
        f"start_{variable.c_name}" if variable.start else "NULL",
        minimum,
        maximum,
    ]
    return f"    {{{', '.join(fields)}}},"
