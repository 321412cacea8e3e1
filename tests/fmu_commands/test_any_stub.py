"""Whatever an FMU's variables are called and are, `cosim check` accepts what `cosim fmu wire` writes around it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.components.component import Variable
from cosim.components.fmu import describe
from cosim.components.presented import elements_of
from cosim.fmu_commands.stub import scenario
from cosim.planning import load
from cosim.planning.starts import NUMERIC
from tests.components.probe import write_fmu

NAMES = (
    *("u", "p", "v", "x", "q1", "q2", "h", "w", "tau", "own_u", "own_v", "own_p", "force", "position", "velocity"),
    *("z[1]", "z[2]", "y[1]", "y[3]", "arm.phi", "arm.w", "a: b", "# c", "'quoted'", "true", "12", "time, s", "größe"),
)
TYPES = ("Float64", "Float64", "Float64", "Float32", "Int32", "Boolean", "String", "Binary", "Enumeration")
UNITS = (None, None, "m", "m/s", "rad", "rad/s", "N", "N.m", "mm", "ft", "furlong")
CAUSALITIES = ("input", "output", "local", "parameter")
STARTS = {
    "Float64": st.sampled_from(["0", "-1.5e-3", "1e300", "INF"]),
    "Float32": st.sampled_from(["0", "0.1"]),
    "Int32": st.sampled_from(["0", "-7"]),
    "Boolean": st.sampled_from(["true", "false"]),
    "String": st.sampled_from(["", "a: b", "two\nlines\n", "# no remark", "12", "null"]),
    "Binary": st.sampled_from(["", "00ff"]),
    "Enumeration": st.sampled_from(["1", "2"]),
}
FMI2 = {"Float64": "Real", "Float32": "Real", "Int32": "Integer", "Binary": "String"}


@dataclass(frozen=True)
class Row:
    name: str
    kind: str
    causality: str
    unit: str | None
    start: str | None
    size: int
    state: bool


@dataclass(frozen=True)
class Model:
    """What is declared: variables, interface, the FMU's own step."""

    fmi: int
    rows: tuple[Row, ...]
    exchange: bool
    variable_step: bool
    usual_step: str

    def xml(self) -> str:
        text = self._fmi2() if self.fmi == 2 else self._fmi3()
        interface = '<ModelExchange modelIdentifier="probe"/>' if self.exchange else ""
        step = str(self.variable_step).lower()
        interface += f'<CoSimulation modelIdentifier="probe" canHandleVariableCommunicationStepSize="{step}"/>'
        return text.replace("<Interfaces/>", interface)

    def _fmi2(self) -> str:
        scalars, derivatives = [], []
        for row in self.rows:
            kind = FMI2.get(row.kind, row.kind)
            own = ' declaredType="Choice"' if kind == "Enumeration" else ""
            unit = f" unit={quoteattr(row.unit)}" if row.unit and kind == "Real" else ""
            start = f" start={quoteattr(row.start)}" if row.start is not None else ""
            varies = "fixed" if row.causality == "parameter" else "continuous" if kind == "Real" else "discrete"
            exact = ' initial="exact"' if start and row.causality in ("output", "local") else ""
            scalars.append(
                f'<ScalarVariable name={quoteattr(row.name)} valueReference="{len(scalars)}" '
                f'causality="{row.causality}" variability="{varies}"{exact}>'
                f"<{kind}{own}{unit}{start}/></ScalarVariable>"
            )
            if row.state and kind == "Real" and row.causality in ("output", "local"):
                derivatives.append((f"der({row.name})", len(scalars)))
        for name, index in derivatives:
            scalars.append(
                f'<ScalarVariable name={quoteattr(name)} valueReference="{len(scalars)}" causality="local">'
                f'<Real derivative="{index}"/></ScalarVariable>'
            )
        outputs = "".join(f'<Unknown index="{i}"/>' for i, row in enumerate(self.rows, 1) if row.causality == "output")
        return (
            '<fmiModelDescription fmiVersion="2.0" modelName="M" guid="probe"><Interfaces/><TypeDefinitions>'
            '<SimpleType name="Choice"><Enumeration><Item name="one, 1" value="1"/><Item name="2" value="2"/>'
            f'</Enumeration></SimpleType></TypeDefinitions><DefaultExperiment stepSize="{self.usual_step}"/>'
            f"<ModelVariables>{''.join(scalars)}</ModelVariables>"
            f"<ModelStructure>{f'<Outputs>{outputs}</Outputs>' if outputs else ''}</ModelStructure>"
            "</fmiModelDescription>"
        )

    def _fmi3(self) -> str:
        variables, derivatives = [], []
        for number, row in enumerate(self.rows):
            own = ' declaredType="Choice"' if row.kind == "Enumeration" else ""
            unit = f" unit={quoteattr(row.unit)}" if row.unit and row.kind.startswith("Float") else ""
            size = row.size if row.kind.startswith("Float") else 1
            inside = f'<Dimension start="{size}"/>' if size > 1 else ""
            start = ""
            if row.start is not None and row.kind in ("String", "Binary"):
                inside += f"<Start value={quoteattr(row.start)}/>"
            elif row.start is not None:
                start = f' start="{" ".join([row.start] * size)}"'
            exact = ' initial="exact"' if row.start is not None and row.causality in ("output", "local") else ""
            fixed = ' variability="fixed"' if row.causality == "parameter" else ""
            variables.append(
                f'<{row.kind} name={quoteattr(row.name)} valueReference="{number}" causality="{row.causality}"'
                f"{fixed}{exact}{own}{unit}{start}>{inside}</{row.kind}>"
            )
            if row.state and row.kind == "Float64" and row.causality in ("output", "local"):
                derivatives.append((f"der({row.name})", number, f'<Dimension start="{size}"/>' if size > 1 else ""))
        for name, reference, inside in derivatives:
            variables.append(
                f'<Float64 name={quoteattr(name)} valueReference="{len(variables)}" causality="local" '
                f'derivative="{reference}">{inside}</Float64>'
            )
        outputs = "".join(
            f'<Output valueReference="{i}"/>' for i, row in enumerate(self.rows) if row.causality == "output"
        )
        return (
            '<fmiModelDescription fmiVersion="3.0" modelName="M" instantiationToken="probe"><Interfaces/>'
            '<TypeDefinitions><EnumerationType name="Choice"><Item name="one, 1" value="1"/><Item name="2" value="2"/>'
            f'</EnumerationType></TypeDefinitions><DefaultExperiment stepSize="{self.usual_step}"/>'
            f"<ModelVariables>{''.join(variables)}</ModelVariables>"
            f"<ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
        )


@st.composite
def models(draw: st.DrawFn) -> Model:
    rows = []
    for name in draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=10, unique=True)):
        kind, causality = draw(st.sampled_from(TYPES)), draw(st.sampled_from(CAUSALITIES))
        start = draw(STARTS[kind]) if causality in ("input", "parameter") or draw(st.booleans()) else None
        unit, size = draw(st.sampled_from(UNITS)), draw(st.integers(1, 3))
        rows.append(Row(name, kind, causality, unit, start, size, draw(st.booleans())))
    return Model(
        draw(st.sampled_from([2, 3])),
        tuple(rows),
        draw(st.booleans()),
        draw(st.booleans()),
        draw(st.sampled_from(["0.01", "0.03", "0.333", "2.5", "3600"])),
    )


@settings(max_examples=80, deadline=None)
@given(models())
def test_check_accepts_every_stub(tmp_path_factory: pytest.TempPathFactory, probe_library: Path, model: Model) -> None:
    folder = tmp_path_factory.mktemp("stub")
    path = write_fmu(folder / "any.fmu", probe_library, model.xml())
    own = describe(path).variables.values()
    (folder / "any.yaml").write_text(scenario(str(path), "plant", folder), "utf-8")
    planned = load(str(folder / "any.yaml"))
    assert [str(warning) for warning in planned.warnings] == []
    (agent,) = planned.plan.agents
    recorded = behind(port.variable for _, port in agent.record)
    assert recorded >= {plain(v.name) for v in own if v.causality == "output" and v.dtype in NUMERIC}
    assert recorded or not any(v.dtype in NUMERIC and v.causality == "local" for v in own)
    named = behind(agent.components[0].description.variables.values())
    assert named >= {plain(v.name) for v in own if v.causality in ("input", "output", "parameter")}


def behind(variables: Iterable[Variable]) -> set[str]:
    """The FMU's own variables that these stand for."""
    return {plain(element.variable.name) for variable in variables for element in elements_of(variable)}


def plain(name: str) -> str:
    """Of an element of an array, the array."""
    return re.sub(r"(.)\[[\d,]+\]$", r"\1", name)
