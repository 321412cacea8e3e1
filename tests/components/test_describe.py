"""What FMU files say of themselves, and how broken ones are refused."""

from __future__ import annotations

import copy
import os
import re
import zipfile
from pathlib import Path

import pytest

import fmus
from cosim.components.component import Interface, Variable, head
from cosim.components.fmu import archive as archive_module
from cosim.components.fmu import describe, open_fmu
from cosim.components.fmu.archive import inspect, unpack
from cosim.errors import ConfigError
from cosim.fmu_commands.inspecting import report
from fmus import build
from tests.components.probe import FAILS, TYPES, description2, description3, write_fmu

BOTH = (Interface.MODEL_EXCHANGE, Interface.CO_SIMULATION)


def refusal(path: Path) -> str:
    """The single problem that `describe` reports; it names the file."""
    with pytest.raises(ConfigError) as caught:
        describe(path)
    (problem,) = caught.value.problems
    assert problem.where is not None
    assert problem.where.file == str(path.absolute())
    assert problem.message.startswith(path.name)
    return problem.message


# --- shipped FMUs ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", fmus.names())
def test_shipped_fmus_are_described(name: str) -> None:
    description = describe(fmus.path(name))
    assert description.interfaces == BOTH
    assert description.fmi == ("2.0" if name.endswith("fmi2") else "3.0")
    assert description.variable_step
    assert description.can_get_and_set_state
    assert description.platforms
    assert len(description.sha256) == 64
    assert all(key == variable.name for key, variable in description.variables.items())


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_arm(fmi: int) -> None:
    variables = describe(fmus.path(f"TwoLinkArm.fmi{fmi}")).variables
    assert variables["u"].causality == "input"
    assert variables["u"].shape == (2,)
    assert variables["u"].unit == "N.m"
    assert variables["p"].dependencies == ()
    assert variables["p"].start == (0.0, 0.0)
    assert variables["p"].initial == "exact"
    assert variables["m1"].start == (1.0,)
    assert len(variables["p"].references) == (2 if fmi == 2 else 1)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_controller(fmi: int) -> None:
    variables = describe(fmus.path(f"ArmSyncController.fmi{fmi}"), {"n_neighbours": 3}).variables
    rows = 16 if fmi == 2 else 3
    assert variables["neighbour_p"].shape == (rows, 2)
    assert variables["neighbour_stamp"].shape == (rows,)
    assert variables["neighbour_stamp"].start == (-1,) * rows
    assert variables["role"].items == {"follower": 1, "leader": 2, "known_velocity": 3}
    assert variables["u"].dependencies == ("p", "v")
    assert variables["v_hat"].dependencies == ()
    assert variables["psi_from_position"].start == (True,)


def test_arrays_take_the_start_of_their_structural_parameter() -> None:
    variables = describe(fmus.path("ArmSyncController.fmi3")).variables
    assert variables["neighbour_p"].shape == (1, 2)
    assert variables["n_neighbours"].causality == "structuralParameter"


def test_an_array_of_no_rows() -> None:
    variables = describe(fmus.path("ArmSyncController.fmi3"), {"n_neighbours": 0}).variables
    assert variables["neighbour_p"].shape == (0, 2)
    assert variables["neighbour_p"].size == 0
    assert variables["neighbour_p"].start == ()


def test_a_file_is_read_again_when_it_changed(probe_library: Path, tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "a.fmu", probe_library, description3())
    before = describe(path)
    assert describe(path).sha256 == before.sha256
    write_fmu(path, probe_library, description3().replace('modelName="Probe"', 'modelName="Changed"'))
    assert describe(path).model == "Changed"
    assert describe(path).sha256 != before.sha256


# --- the probe: every type ------------------------------------------------------------------------------------------
def test_every_type_of_fmi3(probes: dict[int, Path]) -> None:
    variables = describe(probes[3], {"n": 5, "no_such_parameter": 3}).variables
    for name in TYPES:
        assert variables[f"{name}_in"].dtype == name
        assert variables[f"{name}_out"].dependencies == (f"{name}_in",)
    assert variables["vector_out"].shape == (5,)
    assert variables["vector_in"].start == (0.0,) * 5
    assert variables["fails"].items == {name: value for value, name in enumerate(FAILS)}
    assert variables["Boolean_in"].start == (False,)
    assert variables["label"].start == ("probe",)
    assert variables["blob"].start == ("00",)
    assert variables["events"].dependencies is None


def test_types_of_fmi2(probes: dict[int, Path]) -> None:
    variables = describe(probes[2]).variables
    assert variables["vector_out"].references == (102, 103)
    assert variables["vector_out"].dependencies == ("vector_in",)
    assert variables["Int32_in"].dtype == "Int32"
    assert variables["Boolean_in"].start == (False,)
    assert variables["Enumeration_in"].items == {"one": 1, "two": 2}
    assert variables["instances"].dependencies is None
    assert list(variables)[:4] == ["time", "fails", "label", "vector_in"]


# --- arrays of FMI 2.0 ----------------------------------------------------------------------------------------------
def described(tmp_path: Path, library: Path, *names: str, **attributes: str) -> dict[str, Variable]:
    """The variables of an FMI 2.0 file with inputs of these names."""
    scalars = "".join(
        f'<ScalarVariable name="{name}" valueReference="{i}" causality="input">'
        f'<Real start="{i}"{attributes.get(f"v{i}", "")}/></ScalarVariable>'
        for i, name in enumerate(names)
    )
    text = description2()
    text = text[: text.index("<ModelVariables>")] + f"<ModelVariables>{scalars}</ModelVariables><ModelStructure/>"
    return dict(describe(write_fmu(tmp_path / "x.fmu", library, text + "</fmiModelDescription>")).variables)


def test_a_matrix_is_gathered_row_major(probe_library: Path, tmp_path: Path) -> None:
    variables = described(tmp_path, probe_library, "m[2,1]", "m[1,2]", "a", "m[1,1]", "m[2, 2]")
    assert list(variables) == ["m", "a"]
    assert variables["m"].shape == (2, 2)
    assert variables["m"].references == (3, 1, 0, 4)
    assert variables["m"].start == (3.0, 1.0, 0.0, 4.0)


@pytest.mark.parametrize(
    "names",
    [
        ("x[1]", "x[3]"),
        ("x[0]", "x[1]"),
        ("x[1,1]", "x[2,2]"),
        ("x[1]", "x[1,1]"),
        ("x", "x[1]", "x[2]"),
    ],
    ids=["hole", "from zero", "no rectangle", "mixed dimensions", "name taken"],
)
def test_incomplete_arrays_stay_scalars(probe_library: Path, tmp_path: Path, names: tuple[str, ...]) -> None:
    variables = described(tmp_path, probe_library, *names)
    assert tuple(variables) == names
    assert all(variable.shape == () for variable in variables.values())


def test_elements_of_different_kinds_stay_scalars(probe_library: Path, tmp_path: Path) -> None:
    assert list(described(tmp_path, probe_library, "x[1]", "x[2]", v1=' unit="m"')) == ["x[1]", "x[2]"]


# --- head -----------------------------------------------------------------------------------------------------------
def test_the_head_of_a_flattened_matrix() -> None:
    variable = describe(fmus.path("ArmSyncController.fmi2")).variables["neighbour_p"]
    top = head(variable, (3, 2))
    assert top.shape == (3, 2)
    assert top.references == variable.references[:6]
    assert head(variable, (2, 1)).references == (variable.references[0], variable.references[2])
    assert head(variable, (16, 2)) is variable
    assert head(variable, (0, 2)).references == ()


@pytest.mark.parametrize("shape", [(17, 2), (3,), (3, 2, 1)])
def test_a_head_must_fit(shape: tuple[int, ...]) -> None:
    variable = describe(fmus.path("ArmSyncController.fmi2")).variables["neighbour_p"]
    with pytest.raises(ValueError, match="too small"):
        head(variable, shape)


def test_an_fmi3_array_has_no_head() -> None:
    variable = describe(fmus.path("ArmSyncController.fmi3"), {"n_neighbours": 4}).variables["neighbour_p"]
    with pytest.raises(ValueError, match="structural parameter"):
        head(variable, (3, 2))


# --- broken files ---------------------------------------------------------------------------------------------------
def test_a_missing_file(tmp_path: Path) -> None:
    assert refusal(tmp_path / "no.fmu") == "no.fmu does not exist"


def test_a_folder(tmp_path: Path) -> None:
    (tmp_path / "folder.fmu").mkdir()
    assert "cannot be read" in refusal(tmp_path / "folder.fmu")


def test_a_truncated_archive(tmp_path: Path) -> None:
    path = tmp_path / "cut.fmu"
    path.write_bytes(fmus.path("TwoLinkArm").read_bytes()[:2000])
    assert "truncated" in refusal(path)


def test_a_damaged_description(tmp_path: Path) -> None:
    path = tmp_path / "damaged.fmu"
    data = bytearray(fmus.path("TwoLinkArm").read_bytes())
    with zipfile.ZipFile(fmus.path("TwoLinkArm")) as archive:
        offset = archive.getinfo("modelDescription.xml").header_offset
    data[offset + 200 : offset + 260] = bytes(60)
    path.write_bytes(data)
    assert "broken modelDescription.xml" in refusal(path)


def test_no_description(probe_library: Path, tmp_path: Path) -> None:
    assert "holds no modelDescription.xml" in refusal(write_fmu(tmp_path / "x.fmu", probe_library, None))


SIZE = '"vector_in" (line 14) has a size given by the value reference 77, which no variable has'
NO_SIZE = '"vector_in" (line 14) has a size given by a variable whose start value is missing'
ODD_NUMBER = "\"vector_in\" (line 14): could not convert string to float: 'zero'"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "Document is empty"),
        ("<fmiModelDescription", "broken modelDescription.xml"),
        (description3()[:-60], "broken modelDescription.xml"),
        ("<html/>", "does not say which version of FMI"),
        (description3().replace(' valueReference="50"', "", 1), "valueReference"),
        (
            description3().replace('dependencies="10"', 'dependencies="99"'),
            "names the value reference 99, which does not",
        ),
        (
            description2().replace('dependencies="4"', 'dependencies="44"'),
            "names variable number 44, which does not exist",
        ),
        (description3().replace('<Dimension valueReference="3"/>', '<Dimension valueReference="77"/>'), SIZE),
        (
            description3().replace('valueReference="3" c', 'valueReference="3" unit="m" c').replace(' start="2"', ""),
            NO_SIZE,
        ),
        (description3().replace('derivative="50"', 'derivative="98"'), '"der(x)" (line 21) is the derivative of'),
        (
            description3().replace('declaredType="Fails"', 'declaredType="Odd"'),
            "has the type 'Odd', which is not defined",
        ),
        (description3().replace('start="0 0"', 'start="0 zero"'), ODD_NUMBER),
        (description2().replace('start="0"/>', 'start="nil"/>'), "'nil'"),
        (description3().replace(' value="3"/>', ' value="three"/>'), '"fails" (line 11): invalid literal'),
    ],
    ids=[
        *("empty", "cut in the root", "cut at the end", "another document", "attribute missing", "unknown reference"),
        *("unknown index", "unknown size", "no size", "derivative of nothing", "unknown type"),
        *("start of FMI 3.0", "start of FMI 2.0", "item of an enumeration"),
    ],
)
def test_a_broken_description(probe_library: Path, tmp_path: Path, text: str, said: str) -> None:
    assert said in refusal(write_fmu(tmp_path / "x.fmu", probe_library, text))


def test_fmi1_is_refused(probe_library: Path, tmp_path: Path) -> None:
    text = description3().replace('fmiVersion="3.0"', 'fmiVersion="1.0"')
    message = refusal(write_fmu(tmp_path / "x.fmu", probe_library, text))
    assert message == "x.fmu is an FMU of FMI 1.0; export it for FMI 2.0 or 3.0"


def test_no_binary_for_this_platform(tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "x.fmu", None, description3(), {"binaries/riscv64-plan9/probe.so": ""})
    assert "it has: riscv64-plan9" in refusal(path)


def test_no_binary_at_all(tmp_path: Path) -> None:
    assert "it has: none" in refusal(write_fmu(tmp_path / "x.fmu", None, description2()))


def test_an_fmu_that_needs_its_tool(probe_library: Path, tmp_path: Path) -> None:
    needs = 'modelIdentifier="probe" needsExecutionTool="true"'
    text = description3().replace('modelIdentifier="probe"', needs)
    message = refusal(write_fmu(tmp_path / "x.fmu", probe_library, text))
    assert "only works together with ProbeTool" in message


def test_python_is_here(probe_library: Path, tmp_path: Path) -> None:
    """PythonFMU declares that it needs its tool, which is Python."""
    needs = 'modelIdentifier="probe" needsExecutionTool="true"'
    text = description2().replace('modelIdentifier="probe"', needs)
    text = text.replace("<fmiModelDescription", '<fmiModelDescription generationTool="PythonFMU 0.7.0"')
    assert describe(write_fmu(tmp_path / "x.fmu", probe_library, text)).interfaces == BOTH


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_library_of_another_name(probe_library: Path, tmp_path: Path, fmi: int) -> None:
    """As in an FMU that somebody renamed; FMI wants both names equal, but if there is one library, it is meant."""
    text = (description2() if fmi == 2 else description3()).replace(
        'modelIdentifier="probe"', 'modelIdentifier="Probe"'
    )
    path = write_fmu(tmp_path / "x.fmu", probe_library, text)
    component = open_fmu("probe", path, Interface.CO_SIMULATION, describe(path))
    component.enter_initialization(0.0, 1.0)
    component.exit_initialization()
    component.step(0.0, 0.5)
    component.terminate()
    assert f"its library is called {probe_library.name} and its model identifier Probe" in report(path)


def test_several_libraries_of_other_names(probe_library: Path, tmp_path: Path) -> None:
    text = description3().replace('modelIdentifier="probe"', 'modelIdentifier="Probe"')
    folder, suffix = build.platform_folder(3), build.library_suffix()
    path = write_fmu(tmp_path / "x.fmu", probe_library, text, {f"binaries/{folder}/other{suffix}": ""})
    both = f"binaries/{folder}/probe{suffix}, binaries/{folder}/other{suffix}"
    assert f"holds no Probe{suffix}, as its model description calls it, but {both}; ask" in refusal(path)


def test_an_interface_that_needs_its_tool_is_not_offered(probe_library: Path, tmp_path: Path) -> None:
    needs = '<ModelExchange modelIdentifier="probe" needsExecutionTool="true"'
    text = description3().replace('<ModelExchange modelIdentifier="probe"', needs)
    description = describe(write_fmu(tmp_path / "x.fmu", probe_library, text))
    assert description.interfaces == (Interface.CO_SIMULATION,)


def test_scheduled_execution_alone_is_refused(probe_library: Path, tmp_path: Path) -> None:
    text = description3()
    start, end = text.index("  <ModelExchange"), text.index("  <TypeDefinitions")
    text = text[:start] + '<ScheduledExecution modelIdentifier="probe"/>' + text[end:]
    assert "neither Model Exchange nor Co-Simulation" in refusal(write_fmu(tmp_path / "x.fmu", probe_library, text))


@pytest.mark.parametrize("name", ["/etc/cosim", "../outside", "resources/../../outside", "C:/outside", "a\\b"])
def test_members_that_leave_the_folder_are_refused(probe_library: Path, tmp_path: Path, name: str) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3(), {name: "x"})
    assert "is refused: its member" in refusal(path)


@pytest.mark.parametrize(("mode", "said"), [(0o120777, "is a symbolic link"), (0o010644, "is neither a file nor")])
def test_links_and_the_like_are_refused(probe_library: Path, tmp_path: Path, mode: int, said: str) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3())
    member = zipfile.ZipInfo("resources/link")
    member.external_attr = mode << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(member, "/etc")
    assert said in refusal(path)


# --- archives made to fill the disk -----------------------------------------------------------------------------------
def test_what_grows_beyond_measure_is_refused(probe_library: Path, tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("resources/zeros", "w") as member:
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert re.search(r"is refused: unpacked it would take 0\.31\d GB, \d+ times its own size", refusal(path))


def test_members_that_share_their_bytes_are_refused(probe_library: Path, tmp_path: Path) -> None:
    """As those of the archives of D. Fifield, A better zip bomb (2019)."""
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("resources/kernel", os.urandom(1 << 16))
        kernel = archive.getinfo("resources/kernel")
        for i in range(8):
            twin = copy.copy(kernel)
            twin.filename = f"resources/twin{i}"
            archive.filelist.append(twin)
            archive.NameToInfo[twin.filename] = twin
        archive._didModify = True  # type: ignore[attr-defined] # writes the table of contents anew
    assert "its members overlap" in refusal(path)


def test_too_many_members_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive_module, "_MOST_MEMBERS", 10)
    path = write_fmu(tmp_path / "x.fmu", None, description3(), {f"resources/{i}": "" for i in range(10)})
    assert "it holds 11 files, more than 10" in refusal(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_are_refused(tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "x.fmu", None, description3())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("modelDescription.xml", description2())
    assert "its member 'modelDescription.xml' is there twice with different contents" in refusal(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_member_may_be_there_twice_if_it_is_the_same(probe_library: Path, tmp_path: Path) -> None:
    """As in modelica's Roberts.fmu, whose build names a folder twice."""
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("modelDescription.xml", description3())
    assert describe(path).model == "Probe"


def test_a_member_that_is_longer_than_it_says_is_not_unpacked_further(probe_library: Path, tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, description3())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("resources/long", bytes(1 << 20))
        archive.getinfo("resources/long").file_size = 100
    checked = inspect(path)
    with pytest.raises(ConfigError, match="cannot be unpacked"):
        unpack(checked, lambda name: name == "resources/long")
