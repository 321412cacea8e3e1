"""Model descriptions as the standard allows them, where FMPy reads less or something else; through the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim import results
from cosim.cli import main
from cosim.components.fmu import describe
from tests.components.probe import description2, description3, write_fmu
from tests.scenario.scenarios import changed

UNITS = """<UnitDefinitions>
<Unit name="K"><BaseUnit K="1"/></Unit><Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit>
</UnitDefinitions><TypeDefinitions>"""
DIFFERENCE = {
    2: '<SimpleType name="Difference"><Real unit="degC" relativeQuantity="true"/></SimpleType>',
    3: '<Float64Type name="Difference" unit="degC" relativeQuantity="true"/>',
}


def description(fmi: int) -> str:
    return description2() if fmi == 2 else description3()


def with_attributes(fmi: int, prefix: str, attributes: str) -> str:
    """The probe whose vectors `vector_in` or `vector_out` have these attributes; K and degC are defined."""
    text = changed(("<TypeDefinitions>", UNITS + DIFFERENCE[fmi]), text=description(fmi))
    if fmi == 3:
        return changed((f'name="vector_{prefix}"', f'name="vector_{prefix}" {attributes}'), text=text)
    head, *elements = text.split(f'name="vector_{prefix}[')
    return head + f'name="vector_{prefix}['.join(
        ["", *(x.replace("<Real", f"<Real {attributes}", 1) for x in elements)]
    )


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(
    ("source", "target", "expected"),
    [
        ('unit="degC"', 'unit="K"', 283.15),
        ('unit="degC" relativeQuantity="true"', 'unit="K" relativeQuantity="true"', 10.0),
        ('unit="degC" relativeQuantity="true"', 'unit="K"', 10.0),
        ('declaredType="Difference"', 'unit="K"', 10.0),
        ('declaredType="Difference" relativeQuantity="false"', 'unit="K"', 283.15),
    ],
)
def test_the_offset_of_a_unit_does_not_count_for_differences(
    probe_library: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fmi: int,
    source: str,
    target: str,
    expected: float,
) -> None:
    """FMI 2.0.5, section 2.2.3; FMI 3.0, section 2.4.4.1: relativeQuantity."""
    write_fmu(tmp_path / "source.fmu", probe_library, with_attributes(fmi, "out", source))
    write_fmu(tmp_path / "target.fmu", probe_library, with_attributes(fmi, "in", target))
    monkeypatch.chdir(tmp_path)
    Path("net.yaml").write_text(
        """\
period: 100 ms
duration: 200 ms
agents:
  one:
    components:
      source: {fmu: source.fmu, start: {vector_in: 10}}
      target: {fmu: target.fmu}
    connections: [source.vector_out -> target.vector_in]
    record: [target.vector_out]
coupling: {method: gauss-seidel}
""",
        encoding="utf-8",
    )
    assert main(["run", "net.yaml", "--out", "run", "--no-report"]) == 0
    mixed = expected == 10.0 and "relative" not in target
    assert ("'source.vector_out' is a difference (relativeQuantity), 'target" in capsys.readouterr().err) is mixed
    assert results.load("run").array("target.vector_out")[-1, 0].tolist() == pytest.approx([expected] * 2)


CLOCK = ("</TypeDefinitions>", '<ClockType name="Beat" intervalVariability="triggered"/></TypeDefinitions>')
CLOCKED = (
    "</ModelVariables>",
    '<Clock name="beat" valueReference="70" causality="input" declaredType="Beat" intervalVariability="triggered"/>'
    '<Int32 name="beats" valueReference="71" clocks="  70  "/></ModelVariables>',
)
COMMENT = "<!-- a comment\n of two lines -->"


@pytest.mark.parametrize(
    ("fmi", "changes"),
    [
        (3, [CLOCK, CLOCKED]),
        (3, [("</TypeDefinitions>", '<BinaryType name="Image" mimeType="image/png" maxSize="9"/></TypeDefinitions>')]),
        (3, [('valueReference="30" dependencies="10"', 'valueReference="30" dependencies=" 10\n  11 "')]),
        (2, [('dependencies="4"', 'dependencies=" 4  5 " dependenciesKind="dependent\n   dependent"')]),
        (2, [('<SimpleType name="Choice">', f'<SimpleType name="Choice">{COMMENT}')]),
        (3, [('<EnumerationType name="Choice">', f'<EnumerationType name="Choice">{COMMENT}')]),
    ],
    ids=["types of clocks", "types of binaries", "blanks", "blanks of FMI 2.0", "comment of FMI 2.0", "comment"],
)
def test_what_the_standard_allows_is_read(
    probe_library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], fmi: int, changes: list[tuple[str, str]]
) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, changed(*changes, text=description(fmi)))
    variables = describe(path).variables
    assert variables["Enumeration_in"].items == {"one": 1, "two": 2}
    assert variables["vector_out"].dependencies is not None
    assert variables["vector_out"].dependencies[:1] == ("vector_in",)
    assert main(["fmu", "inspect", str(path)]) == 0
    said = capsys.readouterr().out.partition(" problems\n")[2]
    plain = write_fmu(tmp_path / "plain.fmu", probe_library, description(fmi))
    assert main(["fmu", "inspect", str(plain)]) == 0
    assert len(said.splitlines()) == len(capsys.readouterr().out.partition(" problems\n")[2].splitlines())


@pytest.mark.parametrize(
    ("change", "dependencies"),
    [
        (
            (
                ' start="1"/>\n    <Float64 name="der',
                ' start="1"><Alias name="also"/></Float64>\n    <Float64 name="der',
            ),
            (),
        ),
        (
            ('valueReference="30" causality="output">', 'valueReference="30" causality="output"><Alias name="also"/>'),
            ("vector_in",),
        ),
    ],
    ids=["of a state", "of an output"],
)
def test_an_alias_depends_on_what_its_variable_does(
    probe_library: Path, tmp_path: Path, change: tuple[str, str], dependencies: tuple[str, ...]
) -> None:
    path = write_fmu(tmp_path / "x.fmu", probe_library, changed(change, text=description3()))
    assert describe(path).variables["also"].dependencies == dependencies


def test_an_output_of_a_states_value_makes_no_algebraic_loop(
    probe_library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In FMI 2.0, where aliases share a value reference; the model structure says nothing of this output."""
    also = (
        '<ScalarVariable name="also" valueReference="50" causality="output"><Real/></ScalarVariable></ModelVariables>'
    )
    text = changed(
        ("</ModelVariables>", also),
        ('<Unknown index="16"/>', '<Unknown index="16"/><Unknown index="17"/>'),
        text=description2(),
    )
    write_fmu(tmp_path / "x.fmu", probe_library, text)
    monkeypatch.chdir(tmp_path)
    Path("net.yaml").write_text(
        """\
period: 100 ms
duration: 200 ms
agents:
  one:
    components:
      plant: {fmu: x.fmu, outputs: {y: [also, also]}}
      controller: {fmu: x.fmu}
    connections: [plant.y -> controller.vector_in, controller.vector_out -> plant.vector_in]
    record: [plant.y]
coupling: {method: joint}
""",
        encoding="utf-8",
    )
    assert main(["check", "net.yaml"]) == 0
    assert "algebraic" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("starts", "expected"),
    [(("a", "b"), ("a", "b")), (("a",), ("a", "a")), (("a", "b", "c"), None)],
    ids=["each its own", "one for all", "of another size"],
)
def test_texts_of_an_array_start_each_with_its_own(
    probe_library: Path, tmp_path: Path, starts: tuple[str, ...], expected: tuple[str, ...] | None
) -> None:
    array = "".join(f'<Start value="{start}"/>' for start in starts)
    text = changed(('<Start value="probe"/>', f'<Dimension start="2"/>{array}'), text=description3())
    assert describe(write_fmu(tmp_path / "x.fmu", probe_library, text)).variables["label"].start == expected


def test_a_display_unit_of_nothing_is_said(
    probe_library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alias = (
        '<Dimension valueReference="3"/><Alias name="w" displayUnit="mm"/></Float64>\n    <Float32 name="Float32_out"'
    )
    text = changed(
        ('<Dimension valueReference="3"/></Float64>\n    <Float32 name="Float32_out"', alias), text=description3()
    )
    assert main(["fmu", "inspect", str(write_fmu(tmp_path / "x.fmu", probe_library, text))]) == 0
    assert '"w" (line 18) has the display unit "mm" without a unit\n' in capsys.readouterr().out
