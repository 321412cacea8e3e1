"""Builds the FMUs of `probe.c` with any model description, so that tests can meet what the shipped FMUs never do."""

from __future__ import annotations

import re
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from fmus import build

HERE = Path(__file__).parent

TYPES = ("Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean", "Enumeration")
"""Of the scalars that the FMI 3.0 probe echoes, from value reference 11 on; it echoes the array `vector` too."""

FAILS = (
    *("nothing", "step_discards", "step_error", "step_fatal", "step_stops", "step_early", "never_settles"),
    *("output_nan", "state_grows", "update_stops", "completed_stops", "derivative_error", "completed_error"),
    *("update_error", "never_converges", "derivative_nan", "derivative_jumps"),
    *("derivative_hangs", "derivative_crashes", "indicator_nan", "chatters", "step_fixed", "early_forever"),
    *("step_discards_long", "step_pending", "step_pending_error", "step_pending_forever"),
    *("step_prints", "step_floods", "step_hangs", "step_crashes", "step_wanders", "step_scribbles", "narrow"),
    *("ticks", "arms", "relays"),
    "step_exits",
)


def compile_probe(folder: Path, more: str = "") -> Path:
    """The library; functions that the probe leaves out are stubs, `more` is C beside them."""
    source = (HERE / "probe.c").read_text(encoding="utf-8")
    defined = set(re.findall(r"\b(fmi[23]\w+)\(", source)) | {
        f"fmi3{verb}{t}" for verb in ("Get", "Set") for t in TYPES
    }
    defined |= {f"fmi3{verb}Float64" for verb in ("Get", "Set")}
    defined |= {f"fmi2{verb}{t}" for verb in ("Get", "Set") for t in ("Real", "Integer", "Boolean")}
    missing = [name for fmi in (2, 3) for name in build.required_functions(fmi) if name not in defined]
    stubs = folder / "stubs.c"
    export = "__declspec(dllexport)" if sys.platform == "win32" else '__attribute__((visibility("default")))'
    text = "".join(f"{export} int {name}(void) {{ return 3; }}\n" for name in missing)
    stubs.write_text(text + more, encoding="utf-8")
    library = folder / f"probe{build.library_suffix()}"
    build.compile_shared([HERE / "probe.c", stubs], library, includes=[build.ROOT / "include"])
    return library


@pytest.fixture(scope="session")
def probe_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled probe."""
    return compile_probe(tmp_path_factory.mktemp("probe"))


@pytest.fixture(scope="session")
def probes(probe_library: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The probe's FMU files by FMI version."""
    folder = tmp_path_factory.mktemp("probes")
    return {
        2: write_fmu(folder / "probe2.fmu", probe_library, description2()),
        3: write_fmu(folder / "probe3.fmu", probe_library, description3()),
    }


def items() -> str:
    return "".join(f'<Item name="{name}" value="{value}"/>' for value, name in enumerate(FAILS))


def description3() -> str:
    inputs = "".join(
        f'<{t} name="{t}_in" valueReference="{11 + i}" causality="input" '
        f"{'declaredType=' + chr(34) + 'Choice' + chr(34) + ' ' if t == 'Enumeration' else ''}"
        f'start="{"false" if t == "Boolean" else 1 if t == "Enumeration" else 0}"/>'
        for i, t in enumerate(TYPES)
    )
    outputs = "".join(
        f'<{t} name="{t}_out" valueReference="{31 + i}" causality="output"'
        f"{' declaredType=' + chr(34) + 'Choice' + chr(34) if t == 'Enumeration' else ''}/>"
        for i, t in enumerate(TYPES)
    )
    structure = "".join(f'<Output valueReference="{31 + i}" dependencies="{11 + i}"/>' for i in range(len(TYPES)))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Probe" instantiationToken="probe" generationTool="ProbeTool">
  <ModelExchange modelIdentifier="probe"/>
  <CoSimulation modelIdentifier="probe" canHandleVariableCommunicationStepSize="true"/>
  <TypeDefinitions>
    <EnumerationType name="Fails">{items()}</EnumerationType>
    <EnumerationType name="Choice"><Item name="one" value="1"/><Item name="two" value="2"/></EnumerationType>
  </TypeDefinitions>
  <ModelVariables>
    <Float64 name="time" valueReference="0" causality="independent"/>
    <Enumeration name="fails" valueReference="1" causality="parameter" declaredType="Fails" start="0"/>
    <String name="label" valueReference="2" causality="parameter" variability="fixed"><Start value="probe"/></String>
    <UInt64 name="n" valueReference="3" causality="structuralParameter" variability="fixed" start="2"/>
    <Float64 name="vector_in" valueReference="10" causality="input" start="0 0">
      <Dimension valueReference="3"/>
    </Float64>
    {inputs}
    <Float64 name="vector_out" valueReference="30" causality="output"><Dimension valueReference="3"/></Float64>
    {outputs}
    <Float64 name="x" valueReference="50" causality="output" initial="exact" start="1"/>
    <Float64 name="der(x)" valueReference="51" derivative="50"/>
    <Int32 name="events" valueReference="52" causality="output"/>
    <Int32 name="instances" valueReference="53" causality="output"/>
    <Int32 name="count" valueReference="55" causality="output"/>
    <Binary name="blob" valueReference="60" causality="parameter" variability="fixed"><Start value="00"/></Binary>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="30" dependencies="10"/>
    {structure}
    <Output valueReference="50" dependencies=""/>
    <Output valueReference="52"/>
    <Output valueReference="53"/>
    <Output valueReference="55" dependencies=""/>
    <ContinuousStateDerivative valueReference="51"/>
  </ModelStructure>
</fmiModelDescription>
"""


def description2() -> str:
    scalars = [
        ('name="time" valueReference="0" causality="independent" variability="continuous"', "<Real/>"),
        (
            'name="fails" valueReference="1" causality="parameter" variability="fixed"',
            '<Enumeration declaredType="Fails" start="0"/>',
        ),
        ('name="label" valueReference="2" causality="parameter" variability="fixed"', '<String start="probe"/>'),
        ('name="vector_in[1]" valueReference="100" causality="input"', '<Real start="0"/>'),
        ('name="vector_in[2]" valueReference="101" causality="input"', '<Real start="0"/>'),
        ('name="Int32_in" valueReference="16" causality="input" variability="discrete"', '<Integer start="0"/>'),
        ('name="Boolean_in" valueReference="20" causality="input" variability="discrete"', '<Boolean start="false"/>'),
        (
            'name="Enumeration_in" valueReference="21" causality="input" variability="discrete"',
            '<Enumeration declaredType="Choice" start="1"/>',
        ),
        ('name="vector_out[1]" valueReference="102" causality="output"', "<Real/>"),
        ('name="vector_out[2]" valueReference="103" causality="output"', "<Real/>"),
        ('name="Int32_out" valueReference="36" causality="output" variability="discrete"', "<Integer/>"),
        ('name="Boolean_out" valueReference="40" causality="output" variability="discrete"', "<Boolean/>"),
        (
            'name="Enumeration_out" valueReference="41" causality="output" variability="discrete"',
            '<Enumeration declaredType="Choice"/>',
        ),
        ('name="x" valueReference="50" causality="output" initial="exact"', '<Real start="1"/>'),
        ('name="der(x)" valueReference="51"', '<Real derivative="14"/>'),
        ('name="instances" valueReference="53" causality="output" variability="discrete"', "<Integer/>"),
        ('name="count" valueReference="55" causality="output" variability="discrete"', "<Integer/>"),
    ]
    variables = "".join(f"<ScalarVariable {a}>{b}</ScalarVariable>" for a, b in scalars)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Probe" guid="probe">
  <ModelExchange modelIdentifier="probe"/>
  <CoSimulation modelIdentifier="probe" canHandleVariableCommunicationStepSize="true"/>
  <TypeDefinitions>
    <SimpleType name="Fails"><Enumeration>{items()}</Enumeration></SimpleType>
    <SimpleType name="Choice">
      <Enumeration><Item name="one" value="1"/><Item name="two" value="2"/></Enumeration>
    </SimpleType>
  </TypeDefinitions>
  <ModelVariables>{variables}</ModelVariables>
  <ModelStructure>
    <Outputs>
      <Unknown index="9" dependencies="4"/>
      <Unknown index="10" dependencies="5"/>
      <Unknown index="11" dependencies="6"/>
      <Unknown index="12" dependencies="7"/>
      <Unknown index="13" dependencies="8"/>
      <Unknown index="14" dependencies=""/>
      <Unknown index="16"/>
      <Unknown index="17" dependencies=""/>
    </Outputs>
    <Derivatives><Unknown index="15"/></Derivatives>
  </ModelStructure>
</fmiModelDescription>
"""


def with_event_mode(description: str) -> str:
    """The FMI 3.0 probe as Co-Simulation with an Event Mode: every 0.03 s it returns early to have an event handled."""
    return description.replace("<CoSimulation ", '<CoSimulation hasEventMode="true" ')


def with_indicator(description: str) -> str:
    """The same probe with an event indicator: `x` loses 1 as soon as it is 2, not at the end of a step."""
    if 'fmiVersion="2.0"' in description:
        return description.replace("<fmiModelDescription", '<fmiModelDescription numberOfEventIndicators="1"')
    variable = '<Float64 name="z" valueReference="54"/></ModelVariables>'
    indicator = '<EventIndicator valueReference="54"/></ModelStructure>'
    text = re.sub(r"\s*</ModelVariables>", variable, description)
    return re.sub(r"\s*</ModelStructure>", indicator, text)


def write_fmu(
    path: Path, library: Path | None, description: str | None, extra: Mapping[str, str] | None = None
) -> Path:
    """An FMU with these members; without a library or a description where None is given."""
    fmi = 2 if description and 'fmiVersion="2.0"' in description else 3
    with zipfile.ZipFile(path, "w") as archive:
        if description is not None:
            archive.writestr("modelDescription.xml", description)
        if library is not None:
            archive.write(library, f"binaries/{build.platform_folder(fmi)}/{library.name}")
        for name, text in (extra or {}).items():
            archive.writestr(name, text)
    return path
