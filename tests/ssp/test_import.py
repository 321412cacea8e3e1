"""SSP packages become scenarios that do what the same system written by hand does."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from fmpy.ssp.ssd import read_ssd

import fmus
from cosim.components.component import Floats
from cosim.errors import ConfigError
from cosim.planning import load
from cosim.ssp.importing import _times, import_package
from tests.components.misbehaving import cosim, digest
from tests.distributed.networks import in_process, planned

NAMESPACES = " ".join(
    f'xmlns:{short}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for short, name in (
        ("ssd", "Description"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
        ("ssc", "Common"),
    )
)
PLANT, CONTROLLER = "resources/Mass%20spring.fmu", "resources/PDController.fmu"
BY_HAND = """\
period: 10 ms
duration: 1 s
agents:
  1:
    components:
      plant:
        fmu: MassSpringDamper
        start: {{m: {m}, k: 2.0}}
        inputs: {{u: {{to: u, gain: {gain}, offset: {offset}}}}}
      drive_pd: {{fmu: PDController, start: {{k_p: {k_p}, k_d: 3.0, p_ref: 0.4}}}}
    connections: [plant.p -> drive_pd.p, plant.v -> drive_pd.v, drive_pd.u -> plant.u]
    record: [plant.p, plant.v]
coupling: {{method: midpoint}}
"""


def package(
    folder: Path, system: str, extra: Mapping[str, str] | None = None, version: str = "1.0", after: str = ""
) -> Path:
    path = folder / "drive.ssp"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "SystemStructure.ssd",
            f'<?xml version="1.0"?>\n<ssd:SystemStructureDescription {NAMESPACES} version="{version}" name="drive">\n'
            f"{system}\n{after}\n</ssd:SystemStructureDescription>\n",
        )
        archive.write(fmus.path("MassSpringDamper"), "resources/Mass spring.fmu")
        archive.write(fmus.path("PDController"), CONTROLLER)
        for name, text in (extra or {}).items():
            archive.writestr(name, text)
    return path


def connectors(number: str = "Real", **kinds: str) -> str:
    """`p="output m"` is an output in metres."""
    found = ""
    for name, text in kinds.items():
        kind, _, unit = text.partition(" ")
        written = f' unit="{unit}"' if unit else ""
        found += f'<ssd:Connector name="{name}" kind="{kind}"><ssc:{number}{written}/></ssd:Connector>\n'
    return f"<ssd:Connectors>{found}</ssd:Connectors>"


def connection(start: str, end: str, inside: str = "", **attributes: str) -> str:
    """`.u` is a connector of the system itself."""
    written = "".join(f' {name}="{value}"' for name, value in attributes.items())
    for side, text in (("start", start), ("end", end)):
        element, _, connector = text.rpartition(".")
        written += (f' {side}Element="{element}"' if element else "") + f' {side}Connector="{connector}"'
    return f"<ssd:Connection{written}>{inside}</ssd:Connection>\n"


def binding(parameters: str, attributes: str = "", mapping: str = "") -> str:
    values = (
        f'<ssv:ParameterSet version="1.0" name="x"><ssv:Parameters>{parameters}</ssv:Parameters></ssv:ParameterSet>'
    )
    inside = f"<ssd:ParameterValues>{values}</ssd:ParameterValues>{mapping}"
    return f"<ssd:ParameterBinding {attributes}>{inside}</ssd:ParameterBinding>"


def real(name: str, value: float, unit: str = "", number: str = "Real") -> str:
    written = f' unit="{unit}"' if unit else ""
    return f'<ssv:Parameter name="{name}"><ssv:{number} value="{value}"{written}/></ssv:Parameter>'


def linear(factor: float, offset: float = 0.0) -> str:
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


def drive(
    number: str = "Real",
    outer: str = "",
    inner: str = "",
    between: str = "",
    suppressed: str = "false",
    extra: str = "",
) -> str:
    """A plant, and a nested system with its controller, whose output is scaled on both sides of the border."""
    component = connectors(number, p="input", v="input", u="output")
    return f"""\
<ssd:System name="drive system">
  {connectors(number, position="output m", load="input N")}
  <ssd:ParameterBindings>{outer}</ssd:ParameterBindings>
  <ssd:Elements>
    <ssd:Component name="plant" source="{PLANT}" implementation="CoSimulation">
      {connectors(number, u="input N", p="output m", v="output m/s", k="parameter N/m")}
    </ssd:Component>
    <ssd:System name="drive">
      {connectors(number, x="input", w="input", force="output", gain="parameter")}
      <ssd:Elements>
        <ssd:Component name="pd" source="{CONTROLLER}" implementation="CoSimulation">
          {component}
          <ssd:ParameterBindings>{inner}</ssd:ParameterBindings>
        </ssd:Component>
      </ssd:Elements>
      <ssd:Connections>
        {connection("x", "pd.p")}{connection("w", "pd.v")}{connection("pd.u", "force", linear(2.0, 1.0))}
        {connection("gain", "pd.k_p")}
      </ssd:Connections>
    </ssd:System>
    {extra}
  </ssd:Elements>
  <ssd:Connections>
    {connection("plant.p", "drive.x")}{connection("plant.v", "drive.w")}
    {connection("drive.force", "plant.u", between, suppressUnitConversion=suppressed)}
    {connection("plant.p", "position")}
  </ssd:Connections>
  <ssd:Annotations><ssc:Annotation type="com.example"><x/></ssc:Annotation></ssd:Annotations>
</ssd:System>"""


def rows(text: str) -> Floats:
    record, error = in_process(planned(text))
    assert error is None, error
    return np.array([np.frombuffer(row) for _, row in record.ticks])


OUTER = binding(real("plant.m", 1500, "g") + real("plant.k", 2.0) + real("drive.gain", 20.0))
INNER = binding(real("k_p", 1.0) + real("k_d", 3.0) + real("p_ref", 0.4))
UNITS = '<ssd:Units><ssc:Unit name="g"><ssc:BaseUnit kg="1" factor="0.001"/></ssc:Unit></ssd:Units>'


@pytest.mark.parametrize(("number", "version"), [("Real", "1.0"), ("Float64", "2.0")])
def test_the_same_as_by_hand(tmp_path: Path, number: str, version: str) -> None:
    """Nested, scaled on both sides of a border, parameters by connector, by hierarchical name, and by their units."""
    system = drive(number, OUTER.replace("Real", number), INNER.replace("Real", number), between=linear(0.5, 0.25))
    path = package(tmp_path, system, version=version, after='<ssd:DefaultExperiment startTime="0" stopTime="1"/>')
    done = cosim(tmp_path, "ssp", "import", "drive.ssp", "-o", "out.yaml")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "wrote out.yaml and 2 FMUs; next: cosim check out.yaml\n"
    text = (tmp_path / "out.yaml").read_text()
    assert "#   load: leads nowhere\n" in text
    found = load(str(tmp_path / "out.yaml")).plan
    assert [name for name, _ in found.agents[0].record] == ["plant.p"]
    assert found.ticks == 100
    ran = cosim(
        tmp_path,
        "run",
        "out.yaml",
        "--out",
        "run",
        "--no-report",
        "--set",
        "agents.drive_system.record=[plant.p, plant.v]",
    )
    assert digest(ran)
    record, error = in_process(load(str(tmp_path / "out.yaml"), ["agents.drive_system.record=[plant.p, plant.v]"]).plan)
    assert error is None
    mine = np.array([np.frombuffer(row) for _, row in record.ticks])
    by_hand = rows(BY_HAND.format(k_p=20.0, m=1.5, gain=1.0, offset=0.75))  # 0.5 (2 u + 1) + 0.25
    assert np.array_equal(mine, by_hand)
    assert path.exists()


def test_the_package_of_these_tests_follows_the_standards_schema(tmp_path: Path) -> None:
    """By FMPy's copy of it, of SSP 1.0; it reads the same components."""
    description = read_ssd(str(package(tmp_path, drive(outer=OUTER, inner=INNER, between=linear(0.5, 0.25)))))
    assert [element.name for element in description.system.elements] == ["plant", "drive"]


def test_mappings_prefixes_files_and_what_counts(tmp_path: Path) -> None:
    """Sets in files, names mapped and scaled, a prefix; of several values the later and the outer one counts."""
    ssv = (
        f'<ssv:ParameterSet {NAMESPACES} version="1.0" name="s"><ssv:Parameters>{real("mass", 3.0)}{real("other", 9.0)}'
    )
    ssv += "</ssv:Parameters></ssv:ParameterSet>"
    ssm = f'<ssm:ParameterMapping {NAMESPACES} version="1.0"><ssm:MappingEntry source="car.mass" target="plant.m">'
    ssm += f"{linear(0.5, 1.0)}</ssm:MappingEntry></ssm:ParameterMapping>"
    outer = '<ssd:ParameterBinding source="sets/a.ssv" prefix="car."><ssd:ParameterMapping source="sets/a.ssm"/>'
    outer += "</ssd:ParameterBinding>" + binding(real("k", 5.0) + real("k", 2.0), 'prefix="plant."')
    outer += binding(real("drive.pd.k_p", 7.0))
    path = package(tmp_path, drive(outer=outer, inner=INNER), {"sets/a.ssv": ssv, "sets/a.ssm": ssm})
    import_package(path, tmp_path / "out.yaml")
    parts = {part.name: part for part in load(str(tmp_path / "out.yaml")).plan.agents[0].components}
    assert parts["plant"].start["m"] == (2.5,)
    assert parts["plant"].start["k"] == (2.0,)
    assert parts["drive_pd"].start["k_p"] == (7.0,)


def table(kind: str, **entries: str) -> str:
    """`_3="9"` replaces 3 by 9."""
    inside = "".join(f'<ssc:MapEntry source="{a.lstrip("_")}" target="{b}"/>' for a, b in entries.items())
    return f"<ssc:{kind}MappingTransformation>{inside}</ssc:{kind}MappingTransformation>"


ITEMS = '<ssc:Item name="slow" value="10"/><ssc:Item name="fast" value="20"/><ssc:Item name="two" value="30"/>'
ENUMERATIONS = f'<ssv:Enumerations><ssc:Enumeration name="Speed">{ITEMS}</ssc:Enumeration></ssv:Enumerations>'
ON, THREE = '<ssv:Boolean value="true"/>', '<ssv:Integer value="3"/>'
SLOW, OWN_SLOW, OWN_TWO = (f'<ssv:Enumeration value="{x}"/>' for x in ("slow", 'slow" name="Speed', 'two" name="Speed'))


def looked_up(folder: Path, probe: Path, monkeypatch: pytest.MonkeyPatch, target: str, value: str, mapped: str) -> Path:
    """A package of one probe, a variable of which gets a value by a mapping."""
    monkeypatch.setattr(fmus, "path", lambda _name: probe)
    values = f'<ssv:ParameterSet version="1.0" name="x"><ssv:Parameters><ssv:Parameter name="given">{value}'
    values += f"</ssv:Parameter></ssv:Parameters>{ENUMERATIONS}</ssv:ParameterSet>"
    mapping = f'<ssm:ParameterMapping version="1.0"><ssm:MappingEntry source="given" target="{target}">\n{mapped}'
    mapping += "</ssm:MappingEntry></ssm:ParameterMapping>"
    system = f'<ssd:System name="s"><ssd:Elements><ssd:Component name="a" source="{PLANT}"><ssd:ParameterBindings>'
    system += f"<ssd:ParameterBinding><ssd:ParameterValues>{values}</ssd:ParameterValues>"
    system += f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping></ssd:ParameterBinding></ssd:ParameterBindings>"
    system += "</ssd:Component></ssd:Elements></ssd:System>"
    return package(folder, system)


@pytest.mark.parametrize(
    ("target", "value", "mapped", "start"),
    [
        ("Boolean_in", ON, table("Boolean", true="false", false="true"), (False,)),
        ("Boolean_in", ON, table("Boolean", _1="0"), (False,)),
        ("Boolean_in", ON, table("Boolean", false="false"), (True,)),
        ("Int32_in", THREE, table("Integer", _1="7", _3="-9"), (-9,)),
        ("Int32_in", THREE, table("Integer", _1="7"), (3,)),
        ("Int32_in", OWN_SLOW, table("Integer", _10="4"), (4,)),
        ("Float32_in", THREE, linear(2.0, 0.5), (6.5,)),
        ("n", THREE, table("Integer", _3="4"), (4,)),
        ("Enumeration_in", THREE, table("Integer", _3="2"), ("two",)),
        ("Enumeration_in", OWN_SLOW, table("Integer", _10="2"), ("two",)),
        ("Enumeration_in", SLOW, table("Enumeration", slow="two", fast="one"), ("two",)),
        ("Enumeration_in", OWN_TWO, table("Enumeration", slow="one"), ("two",)),
        ("Enumeration_in", '<ssv:Enumeration value="one"/>', table("Integer", _1="2"), ("two",)),
    ],
)
def test_values_that_a_mapping_looks_up(
    probes: dict[int, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    target: str,
    value: str,
    mapped: str,
    start: tuple[object],
) -> None:
    path = looked_up(tmp_path, probes[3], monkeypatch, target, value, mapped)
    read_ssd(str(path))  # as the standard's schema has it
    import_package(path, tmp_path / "out.yaml")
    (part,) = load(str(tmp_path / "out.yaml")).plan.agents[0].components
    assert part.start == {target: start}


@pytest.mark.parametrize(
    ("target", "value", "mapped", "said"),
    [
        (
            "Int32_in",
            THREE,
            table("Boolean", true="false"),
            "BooleanMappingTransformation is for values of the type Boolean, and this is Integer",
        ),
        (
            "Boolean_in",
            ON,
            table("Integer", _1="0"),
            "IntegerMappingTransformation is for values of the type Integer or Enumeration, and this is Boolean",
        ),
        (
            "Enumeration_in",
            THREE,
            table("Enumeration", _3="two"),
            "EnumerationMappingTransformation is for values of the type Enumeration, and this is Integer",
        ),
        ("Boolean_in", ON, linear(2.0), "LinearTransformation is for real numbers, and given is Boolean"),
        (
            "Enumeration_in",
            THREE,
            table("Integer", _3="5"),
            "Enumeration_in has no item with the value 5, only 1 (one), 2 (two)",
        ),
        (
            "Enumeration_in",
            SLOW,
            table("Enumeration", slow="tow"),
            "Enumeration_in has no item 'tow' (did you mean 'two'?)",
        ),
        ("Int32_in", ON, table("Boolean", true="false"), "Int32_in takes a number, not False"),
        ("Int32_in", THREE, table("Integer", _3="9", __3="9"), "two entries for '3'"),
        ("Int32_in", THREE, table("Integer", _3="x"), "target='x' is no value of the type Integer"),
        ("Int32_in", THREE, table("Text", _3="x"), "TextMappingTransformation is not known"),
    ],
)
def test_values_that_no_mapping_can_give(
    probes: dict[int, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    target: str,
    value: str,
    mapped: str,
    said: str,
) -> None:
    path = looked_up(tmp_path, probes[3], monkeypatch, target, value, mapped)
    done = cosim(tmp_path, "ssp", "import", path.name)
    assert done.returncode == 2
    line = 3 if mapped == linear(2.0) else 4  # the value's, or the table's
    assert done.stderr == f"drive.ssp/SystemStructure.ssd:{line}:1: error: {said}\n1 error\n"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["drive.ssp", "tmp"]


def test_a_parameter_through_a_connection_that_scales(tmp_path: Path) -> None:
    """It would arrive unscaled."""
    system = drive(inner=INNER, outer=binding(real("drive.gain", 3.0)))
    scaled = system.replace(connection("gain", "pd.k_p"), connection("gain", "pd.k_p", linear(2.0)))
    (found,) = refusal(tmp_path, scaled)
    text = "the value of drive.pd.k_p comes through a LinearTransformation, which is not supported; bind it itself"
    assert text in found


def test_units_that_only_the_package_knows(tmp_path: Path) -> None:
    """The controller's output has no unit in the FMU; the package says kN, and N where it goes."""
    system = drive(inner=INNER, outer=binding(real("plant.k", 2.0) + real("drive.pd.k_p", 0.02) + real("plant.m", 1.5)))
    system = system.replace(
        '<ssd:Connector name="force" kind="output"><ssc:Real/>',
        '<ssd:Connector name="force" kind="output"><ssc:Real unit="kN"/>',
    )
    for suppressed, gain in (("false", 2000.0), ("true", 2.0)):
        folder = tmp_path / suppressed
        folder.mkdir()
        text = system.replace('suppressUnitConversion="false"', f'suppressUnitConversion="{suppressed}"')
        import_package(package(folder, text), folder / "out.yaml")
        mapped = (folder / "out.yaml").read_text()
        assert f"gain: {gain}" in mapped
        assert f"offset: {gain / 2}" in mapped


def refusal(folder: Path, system: str, extra: Mapping[str, str] | None = None, **more: str) -> list[str]:
    path = package(folder, system, extra, **more)
    with pytest.raises(ConfigError) as caught:
        import_package(path, folder / "out.yaml")
    assert not (folder / "out.yaml").exists()
    assert not (folder / "out_fmus").exists()
    return [str(problem).replace(f"{path}/", "") for problem in caught.value.problems]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("force", "force2"), "system 'drive' has no connector 'force'"),
        (
            ('endElement="pd" endConnector="p"', 'endElement="pd" endConnector="pp"'),
            "has no variable 'pp' (did you mean 'p'?)",
        ),
        (
            ('startElement="plant" startConnector="v"', 'startElement="plnt" startConnector="v"'),
            "has no element 'plnt'",
        ),
        (
            ("<ssc:LinearTransformation", "<ssc:IntegerMappingTransformation"),
            "IntegerMappingTransformation is not supported on connections, only in parameter mappings",
        ),
        (('source="resources/PDController.fmu"', 'source="http://example.org/a.fmu"'), "lies outside of the package"),
        (('source="resources/PDController.fmu"', 'source="../../a.fmu"'), "the package holds no '../../a.fmu'"),
        (('factor="2.0"', 'factor="two"'), "factor='two' is no number"),
        (('name="x" kind="input"', 'name="x" kind="inout"'), "connector 'x': inout is not supported"),
        (
            ('name="plant" source', 'type="application/x-python" name="plant" source'),
            "component 'plant' of the type application/x-python",
        ),
        (
            ("</ssd:System>\n    \n", '</ssd:System><ssd:SignalDictionaryReference name="d" dictionary="d"/>\n'),
            "SignalDictionaryReference is not supported",
        ),
    ],
)
def test_what_is_wrong_or_not_supported_is_named_with_its_place(
    tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    system = drive(inner=INNER)
    assert change[0] in system
    changed = system.replace(change[0], change[1], 1)
    found = refusal(tmp_path, changed)
    line = 3 + next(i for i, (a, b) in enumerate(zip(system.split("\n"), changed.split("\n"), strict=False)) if a != b)
    assert any(said in text for text in found), found
    assert all(text.startswith("SystemStructure.ssd:") for text in found), found
    if "force2" not in change[1]:
        assert any(text.startswith(f"SystemStructure.ssd:{line}:") for text in found), (line, found)


def test_parameters_that_are_not_there(tmp_path: Path) -> None:
    """They are ignored, as the standard has it (SSP 2.0, 5.1.1.2), but not in silence."""
    outer = binding(real("plnt.m", 1.0) + real("plant.k", 2.0) + real("drive.gain", 3.0))
    package(tmp_path, drive(outer=outer, inner=binding(real("kp", 1.0) + real("k_d", 3.0))))
    done = cosim(tmp_path, "ssp", "import", "drive.ssp", "-o", "out.yaml")
    assert done.returncode == 0
    assert "warning: system 'drive system' has no parameter 'plnt.m'; it is ignored\n" in done.stderr
    assert "has no variable 'kp' (did you mean 'k_p'?); its value is ignored\n" in done.stderr
    assert done.stderr.count("warning") == 2
    parts = {part.name: part for part in load(str(tmp_path / "out.yaml")).plan.agents[0].components}
    assert (parts["plant"].start["k"], parts["drive_pd"].start["k_d"]) == ((2.0,), (3.0,))


def test_a_parameter_of_two_units(tmp_path: Path) -> None:
    (found,) = refusal(tmp_path, drive(outer=binding(real("plant.m", 1.0, "s"))))
    assert "plant.m is in s, and m in kg" in found


def test_no_package(tmp_path: Path) -> None:
    (tmp_path / "x.ssp").write_bytes(b"PK")
    done = cosim(tmp_path, "ssp", "import", "x.ssp")
    assert done.returncode == 2
    assert "x.ssp is no SSP package: not a ZIP archive, or a truncated one" in done.stderr
    (found,) = refusal(tmp_path, "<ssd:System")
    assert found.startswith("SystemStructure.ssd:")
    assert "broken XML" in found


def test_a_file_that_exists_is_kept(tmp_path: Path) -> None:
    path = package(tmp_path, drive(inner=INNER))
    (tmp_path / "out.yaml").write_text("mine")
    with pytest.raises(ConfigError, match="exists already"):
        import_package(path, tmp_path / "out.yaml")
    assert (tmp_path / "out.yaml").read_text() == "mine"
    assert not (tmp_path / "out_fmus").exists()


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("/sys/out.yaml", r"/sys/out_fmus: error: out_fmus cannot be written: \w+"),
        ("file/out.yaml", r"file/out_fmus: error: out_fmus cannot be written: Not a directory"),
        ("there.yaml", r"there_fmus/PDController.fmu exists already and is another file; choose another name with -o"),
        ("dir", r"error: dir exists already; choose another name with -o"),
    ],
)
def test_what_cannot_be_written_leaves_nothing_behind(tmp_path: Path, out: str, said: str) -> None:
    """A folder that is read only, even for root; a file in its place; one of two FMUs that is another one."""
    package(tmp_path, drive(inner=INNER))
    (tmp_path / "file").touch()
    (tmp_path / "dir").mkdir()
    (tmp_path / "there_fmus").mkdir()
    (tmp_path / "there_fmus" / "PDController.fmu").write_bytes(b"mine")
    before = sorted(tmp_path.rglob("*"))
    done = cosim(tmp_path, "ssp", "import", "drive.ssp", "-o", out)
    assert done.returncode == 2
    assert re.search(said, done.stderr), done.stderr
    assert "Traceback" not in done.stderr
    assert sorted(path for path in tmp_path.rglob("*") if path.name != "tmp") == before
    assert (tmp_path / "there_fmus" / "PDController.fmu").read_bytes() == b"mine"


def test_a_system_of_another_description(tmp_path: Path) -> None:
    """A component that is an .ssd of the package is the system that it describes, with its own bindings last."""
    inner = f'<ssd:SystemStructureDescription {NAMESPACES} version="1.0" name="i"><ssd:System name="i">'
    inner += (
        connectors(p="output m", u="input N")
        + f"<ssd:ParameterBindings>{binding(real('m.m', 2.0))}</ssd:ParameterBindings>"
    )
    inner += f'<ssd:Elements><ssd:Component name="m" source="{PLANT}"/></ssd:Elements><ssd:Connections>'
    inner += (
        connection("m.p", "p")
        + connection("u", "m.u")
        + "</ssd:Connections></ssd:System></ssd:SystemStructureDescription>"
    )
    component = '<ssd:Component name="second" type="application/x-ssp-definition" source="second.ssd">'
    component += connectors(p="output m")
    component += f"<ssd:ParameterBindings>{binding(real('m.m', 4.0))}</ssd:ParameterBindings></ssd:Component>"
    import_package(package(tmp_path, drive(inner=INNER, extra=component), {"second.ssd": inner}), tmp_path / "out.yaml")
    parts = {part.name: part for part in load(str(tmp_path / "out.yaml")).plan.agents[0].components}
    assert parts["second_m"].start["m"] == (4.0,)


def test_connections_as_they_are_drawn(tmp_path: Path) -> None:
    """Which end gives the value follows from the kinds of the connectors, and "" is the system's own, as OMSimulator
    writes it.
    """
    system = drive(inner=INNER, between=linear(0.5, 0.25))
    import_package(package(tmp_path, system), tmp_path / "straight.yaml")
    turned = re.sub(r'start(Element|Connector)="', r'xxx\1="', system)
    turned = re.sub(r'end(Element|Connector)="', r'start\1="', turned).replace("xxx", "end")
    turned = re.sub(r"<ssd:Connection (?!.*startElement)", '<ssd:Connection startElement="" ', turned)
    import_package(package(tmp_path, turned), tmp_path / "turned.yaml")
    straight, reverse = ((tmp_path / f"{name}.yaml").read_text() for name in ("straight", "turned"))
    assert straight.replace("straight_fmus", "turned_fmus") == reverse
    both = system.replace('startElement="plant" startConnector="v"', 'startElement="drive" startConnector="x"', 1)
    assert "connects drive.x and drive.w, which both take a value" in " ".join(refusal(tmp_path, both))


def test_a_folder(tmp_path: Path) -> None:
    """An unpacked package, whose FMUs may lie outside, and a description beside the usual one."""
    folder = tmp_path / "unpacked"
    zipfile.ZipFile(package(tmp_path, drive(inner=INNER))).extractall(folder)
    text = (folder / "SystemStructure.ssd").read_text()
    (folder / "SystemStructure.ssd").write_text(text.replace(CONTROLLER, "../outside/PDController.fmu"))
    (folder / "variant.ssd").write_text(text)
    (tmp_path / "outside").mkdir()
    (folder / CONTROLLER).rename(tmp_path / "outside/PDController.fmu")
    for said, name in (("unpacked", "unpacked"), ("unpacked/SystemStructure.ssd", "unpacked")):
        done = cosim(tmp_path, "ssp", "import", said)
        assert (done.returncode, done.stderr) == (0, "")
        assert load(str(tmp_path / f"{name}.yaml")).plan.agents[0].components[1].name == "drive_pd"
        (tmp_path / f"{name}.yaml").unlink()
    done = cosim(tmp_path, "ssp", "import", "unpacked/variant.ssd")
    assert done.returncode == 2
    assert "variant.ssd" in done.stderr
    assert f"the package holds no '{CONTROLLER}'" in done.stderr
    done = cosim(tmp_path, "ssp", "import", "unpacked/none.ssd")
    assert (done.returncode, "none.ssd does not exist" in done.stderr) == (2, True)


STEPS = {
    "OSP": '<osp:Algorithm xmlns:osp="o"><osp:FixedStepAlgorithm baseStepSize="1e-4"/></osp:Algorithm>',
    "OMSimulator": '<oms:S xmlns:oms="o"><oms:FixedStepMaster description="oms-ma" stepSize="0.000100"/></oms:S>',
}


@pytest.mark.parametrize("tool", STEPS)
def test_the_step_that_a_tool_wrote_down(tmp_path: Path, tool: str) -> None:
    annotation = f'<ssd:Annotations><ssc:Annotation type="x">{STEPS[tool]}</ssc:Annotation></ssd:Annotations>'
    experiment = f'<ssd:DefaultExperiment stopTime="2">{annotation}</ssd:DefaultExperiment>'
    import_package(package(tmp_path, drive(inner=INNER), after=experiment), tmp_path / "out.yaml")
    plan = load(str(tmp_path / "out.yaml")).plan
    assert plan.agents[0].coupling.step_ns == 100_000
    assert (plan.period_ns, plan.ticks) == (10_000_000, 200)


@pytest.mark.parametrize(
    ("duration", "step", "found"),
    [
        (10.0, None, (10_000_000, 10_000_000_000, 1)),
        (0.0002, None, (200_000, 200_000, 1)),
        (1.0, 0.003, (9_000_000, 1_008_000_000, 3_000_000)),
        (1.0, 0.02, (20_000_000, 1_000_000_000, 20_000_000)),
        (1.003, 0.001, (1_000_000, 1_003_000_000, 1_000_000)),
        (1 / 3, None, (10_000_000, 340_000_000, 1)),
    ],
)
def test_a_period_that_divides_the_duration(duration: float, step: float | None, found: tuple[int, int, int]) -> None:
    assert _times(duration, step) == found


def test_a_system_without_components(tmp_path: Path) -> None:
    inside = '<ssd:Elements><ssd:System name="s"/></ssd:Elements>'
    (found,) = refusal(tmp_path, f'<ssd:System name="empty">{inside}</ssd:System>')
    assert found.endswith("error: system 'empty' has no components")


def test_local_variables_whole_numbers_and_items_are_connected(
    probes: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A local variable as an output, and an integer to an input that is an enumeration: real packages do both."""
    monkeypatch.setattr(fmus, "path", lambda _name: probes[3])
    kinds = connectors(Int32_out="output", Enumeration_in="input", x="output")
    rate = '<ssd:Connector name="der(x)" kind="local"/>'
    component = f'<ssd:Component name="{{}}" source="{PLANT}" implementation="CoSimulation">'
    component += kinds.replace("</ssd:Connectors>", f"{rate}</ssd:Connectors>") + "</ssd:Component>"
    system = '<ssd:System name="s"><ssd:Elements>' + component.format("a") + component.format("b")
    system += "</ssd:Elements><ssd:Connections>" + connection("a.Int32_out", "b.Enumeration_in")
    system += connection("a.der(x)", "b.Float32_in") + "</ssd:Connections>"
    value = '<ssv:Parameter name="a.Int32_in"><ssv:Integer value="2"/></ssv:Parameter>'
    system += f"<ssd:ParameterBindings>{binding(value)}</ssd:ParameterBindings></ssd:System>"
    import_package(package(tmp_path, system), tmp_path / "out.yaml")
    plan = load(str(tmp_path / "out.yaml"), ["agents.s.record=[a.der(x), b.Float32_out, b.Enumeration_out]"]).plan
    record, error = in_process(plan)
    assert error is None
    rate, seen, item = np.array([np.frombuffer(row) for _, row in record.ticks])[-1]
    assert (seen, item) == (np.float32(rate), 2.0)
    assert rate != 0.0


def test_what_feeds_through_comes_after_what_it_reads(tmp_path: Path) -> None:
    """As `midpoint` wants it, in whatever order the package has them."""
    components = "".join(
        f'<ssd:Component name="{name}" source="{source}" implementation="CoSimulation"/>'
        for name, source in (("pd", CONTROLLER), ("plant", PLANT))
    )
    wires = connection("plant.p", "pd.p") + connection("plant.v", "pd.v") + connection("pd.u", "plant.u")
    system = f'<ssd:System name="s"><ssd:Elements>{components}</ssd:Elements>'
    system += f"<ssd:Connections>{wires}</ssd:Connections></ssd:System>"
    import_package(package(tmp_path, system), tmp_path / "out.yaml")
    planned = load(str(tmp_path / "out.yaml"))
    assert [part.name for part in planned.plan.agents[0].components] == ["plant", "pd"]
    assert not [problem for problem in planned.warnings if "order 1" in problem.message]
