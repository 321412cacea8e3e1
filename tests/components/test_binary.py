"""Libraries that cannot be loaded, told from their first bytes; and those that lack functions."""

from __future__ import annotations

import platform
import struct
from pathlib import Path

import pytest

from cosim.components.component import Interface
from cosim.components.fmu import describe, open_fmu
from cosim.components.fmu.binary import HEAD_BYTES, unfit
from cosim.errors import ComponentError, ConfigError
from fmus import build
from tests.components.probe import description2, description3, write_fmu

on_linux = pytest.mark.skipif(
    (platform.system(), platform.machine()) != ("Linux", "x86_64"), reason="the examples are for Linux on x86_64"
)


def refusal(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        describe(path)
    return caught.value.problems[0].message


def fmu_around(folder: Path, content: bytes, text: str) -> Path:
    library = folder / f"probe{build.library_suffix()}"
    library.write_bytes(content)
    return write_fmu(folder / "x.fmu", library, text)


@pytest.mark.parametrize("text", [description2(), description3()], ids=["2.0", "3.0"])
@on_linux
def test_another_machine(probe_library: Path, tmp_path: Path, text: str) -> None:
    data = bytearray(probe_library.read_bytes())
    data[18:20] = struct.pack("<H", 183)
    message = refusal(fmu_around(tmp_path, bytes(data), text))
    assert "probe.so is a library for Linux on aarch64, and this is Linux on x86_64; ask the FMU's supplier" in message


@on_linux
def test_a_library_that_is_cut_short(probe_library: Path, tmp_path: Path) -> None:
    """Loading it would end this process by a bus error."""
    data = probe_library.read_bytes()
    assert "is cut short" in refusal(fmu_around(tmp_path, data[: len(data) // 2], description3()))
    assert "is cut short" in refusal(fmu_around(tmp_path, data[:100], description3()))


def test_something_else(tmp_path: Path) -> None:
    assert "is no shared library" in refusal(fmu_around(tmp_path, b"no library", description3()))
    assert "is no shared library" in refusal(fmu_around(tmp_path, b"", description3()))


@on_linux
@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"MZ" + bytes(58) + struct.pack("<I", 64) + b"PE\0\0" + struct.pack("<H", 0x8664), "Windows on x86_64"),
        (b"\xcf\xfa\xed\xfe" + struct.pack("<I", 0x0100000C), "macOS on aarch64"),
        (b"\x7fELF\x02\x01" + bytes(12) + struct.pack("<H", 999), "Linux on machine 999"),
    ],
)
def test_libraries_of_other_systems(head: bytes, said: str) -> None:
    assert f"is a library for {said}, and this is" in unfit(head, 1000)


def test_a_good_library(probe_library: Path) -> None:
    data = probe_library.read_bytes()
    assert unfit(data[:HEAD_BYTES], len(data)) == ""


# --- functions --------------------------------------------------------------------------------------------------------
def crippled(library: Path, folder: Path, *names: str) -> Path:
    """A library without these functions: they have other names."""
    data = library.read_bytes()
    for name in names:
        data = data.replace(b"\0" + name.encode() + b"\0", b"\0" + b"x" * len(name) + b"\0")
    copy = folder / library.name
    copy.write_bytes(data)
    return copy


@on_linux
@pytest.mark.parametrize(
    ("fmi", "name", "said"),
    [
        (3, "fmi3DoStep", "its library lacks fmi3DoStep, which FMI 3.0 asks for"),
        (2, "fmi2ExitInitializationMode", "its library lacks fmi2ExitInitializationMode, which FMI 2.0 asks for"),
        (3, "fmi3GetFloat64", "its library lacks fmi3GetFloat64, which FMI 3.0 asks for"),
    ],
)
def test_a_library_that_lacks_a_function(probe_library: Path, tmp_path: Path, fmi: int, name: str, said: str) -> None:
    path = write_fmu(
        tmp_path / "x.fmu", crippled(probe_library, tmp_path, name), description2() if fmi == 2 else description3()
    )
    with pytest.raises(ConfigError, match=said):
        open_fmu("probe", path, Interface.CO_SIMULATION, describe(path))


@on_linux
def test_functions_that_are_not_needed(probe_library: Path, tmp_path: Path) -> None:
    """They may be missing; asking for one nevertheless is refused as the FMU would."""
    lacking = ("fmi3GetFMUState", "fmi3GetClock", "fmi3ActivateModelPartition", "fmi3GetDirectionalDerivative")
    path = write_fmu(tmp_path / "x.fmu", crippled(probe_library, tmp_path, *lacking), description3())
    component = open_fmu("probe", path, Interface.CO_SIMULATION, describe(path))
    component.enter_initialization(0.0, 1.0)
    component.exit_initialization()
    component.step(0.0, 0.01)
    with pytest.raises(ComponentError, match="fmi3GetFMUState returned Error"):
        component.step_in_halves(0.01, 0.01, 1)
    component.terminate()
