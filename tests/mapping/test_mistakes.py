"""Every mistake that a user can make in a mapping: the sentence, and the line and column it points to."""

from pathlib import Path

import pytest

from cosim.errors import Severity
from tests.components.probe import write_fmu
from tests.mapping.foreign import CONNECTIONS, MAPPED, PLANT, renamed
from tests.scenario.scenarios import FILE, changed, errors, marked, problems

MISTAKES = {
    "unknown": ("[tau_shoulder,", "[§tau_sholder,", "no variable 'tau_sholder' (did you mean 'tau_shoulder'?)"),
    "unknown output": ("[q1, q2]", "[q1, §qd3]", "no variable 'qd3' (did you mean 'qd"),
    "no input": ("[tau_shoulder,", "[§q1,", "'q1' is an output, not an input"),
    "an input read": ("[q1, q2]", "[§tau_elbow, q2]", "'tau_elbow' is an input, not something that can be read"),
    "twice": ("tau_elbow]}", "tau_elbow], w: §tau_elbow}", "'tau_elbow' is mapped twice, first at line 9"),
    "no such element": ("[q1, q2]", '[§"q1[2]", q2]', "'q1' is one number; there is no 'q1[2]'"),
    "name of an input": ("v: [qd1", "§u: q1, v: [qd1", "'u' is an input already; an output needs another name"),
    "rows": ("[q1, q2]", "§[[q1], [q2, q1]]", "the rows of this list are of different lengths"),
    "gain of nothing": ("[q1, q2]", "§{from: [q1, q2], gain: 0}", "a gain of 0 leaves nothing"),
    "incompatible": (
        "[q1, q2]",
        "{from: [q1, q2], unit: §m}",
        "'q1' is in rad, which does not convert to m; with a 'gain', 'unit' says what results",
    ),
    "unit": ("[q1, q2]", "{from: [q1, q2], unit: §degs}", "the unit 'degs' means nothing here"),
    "form": ("[q1, q2]", "§3", "write a variable of the component, {from: variable, gain: 2}, or a list"),
    "form inside": ("[q1, q2]", "{from: [q1, §2]}", "write the name of a variable of the component, or a list"),
    "key": ("[q1, q2]", "{§to: q1, from: q1}", "unknown key 'to' (known: gain, offset, unit, from)"),
    "start": ("v: 0}", "v: 0, §qd1: 1}", "no variable 'qd1'; it is called 'v' here"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_reported_where_it_is(tmp_path: Path, name: str) -> None:
    renamed(tmp_path / "other.fmu")
    old, new, sentence = MISTAKES[name]
    assert MAPPED.count(old) == 1
    text, place = marked(changed((PLANT, MAPPED.replace(old, new))))
    found = [problem for problem in errors(tmp_path, text) if str(problem.where) == place]
    assert any(sentence in problem.message for problem in found), errors(tmp_path, text)


CONNECTED = {
    "size": ("q1", "§plant.p", "'plant.p' has 1 number, but 'controller.p' takes 2 numbers"),
    "unit": ("[qd1, qd2]", "§plant.p", "'plant.p' is in rad/s, but 'controller.p' is in rad"),
    "old name": ("[q1, q2]", "§plant.q1", "'plant' has no variable 'q1'; it is called 'p' here"),
}


@pytest.mark.parametrize("name", CONNECTED)
def test_what_does_not_fit_what_it_is_connected_to(tmp_path: Path, name: str) -> None:
    renamed(tmp_path / "other.fmu")
    behind, source, sentence = CONNECTED[name]
    connections = CONNECTIONS.replace("plant.p", source)
    text, place = marked(changed((PLANT, MAPPED.replace("[q1, q2]", behind)), (CONNECTIONS, connections)))
    assert any(str(p.where) == place and sentence in p.message for p in errors(tmp_path, text)), errors(tmp_path, text)


def test_all_at_once_and_none_that_follows_from_another(tmp_path: Path) -> None:
    renamed(tmp_path / "other.fmu")
    wrong = MAPPED.replace("[q1, q2]", "[q1, nothing]").replace("tau_elbow", "tau_elbo")
    found = errors(tmp_path, changed((PLANT, wrong)))
    assert [problem.message.split(" (")[0] for problem in found] == [
        "the component has no variable 'tau_elbo'",
        "the component has no variable 'nothing'",
    ]


def test_a_name_does_not_hide_an_output_that_nothing_else_names(tmp_path: Path) -> None:
    mapped = PLANT.replace("start:", "outputs: {p: v}\n        start:").replace("{p: {uniform: [-1, 1]}, v: 0}", "{}")
    (found,) = [p for p in errors(tmp_path, changed((PLANT, mapped))) if "of its own" in p.message]
    assert found.message == "the component has an output 'p' of its own; map that under another name as well"
    swapped = mapped.replace("{p: v}", "{p: v, v: p}")
    assert not any("of its own" in p.message for p in errors(tmp_path, changed((PLANT, swapped))))


def test_brackets_must_be_in_quotes(tmp_path: Path) -> None:
    text, place = marked(changed((PLANT, PLANT.replace("start:", "outputs: {p: [x§[1], x[2]]}\n        start:"))))
    (found,) = errors(tmp_path, text)
    assert str(found.where) == place
    assert "a name with brackets must be in quotes, such as 'x[1]'" in found.message


def test_an_unknown_unit_is_a_note(tmp_path: Path) -> None:
    renamed(tmp_path / "other.fmu", {"u[1]": "tau_shoulder"})
    mapped = PLANT.replace("start:", "outputs: {p: {from: p, gain: 1, unit: gon}}\n        start:")
    found = problems(tmp_path, changed((PLANT, mapped), ("step: 5 ms", "stp: 5 ms")))
    notes = [problem for problem in found if problem.severity is Severity.WARNING]
    assert any("nothing says what 'gon' is, so values pass as they are" in note.message for note in notes)
    assert str(notes[0].where).startswith(FILE)


def test_an_input_that_has_no_value(tmp_path: Path, probe_library: Path) -> None:
    """Neither a connection nor a start value: nothing says what it is."""
    write_fmu(
        tmp_path / "bare.fmu",
        probe_library,
        '<fmiModelDescription fmiVersion="2.0" modelName="Bare" guid="probe"><CoSimulation modelIdentifier="probe"/>'
        '<ModelVariables><ScalarVariable name="f" valueReference="10" causality="input"><Real/></ScalarVariable>'
        '<ScalarVariable name="g" valueReference="11" causality="input"><Real/></ScalarVariable>'
        "</ModelVariables><ModelStructure/></fmiModelDescription>",
    )
    bare = (
        "period: 1 s\nduration: 1 s\nagents:\n  a:\n    components:\n      §plant:\n        fmu: bare.fmu\n        {}\n"
    )
    text, place = marked(bare.replace("{}", "inputs: {u: f}\n        start: {g: 1}"))
    (found,) = errors(tmp_path, text)
    assert str(found.where) == place
    assert found.message.startswith("'plant.u' has no value: nothing feeds it, and the component gives it none")
    assert not errors(tmp_path, text.replace("{g: 1}", "{g: 1, u: 2}"))


@pytest.mark.parametrize("recorded", ["", ', §"plant.p[1]"'], ids=["every output", "those that are listed"])
def test_two_numbers_never_share_a_column(tmp_path: Path, recorded: str) -> None:
    """One was silently recorded over the other."""
    renamed(tmp_path / "other.fmu")
    mapped = MAPPED.replace("v: [qd1, qd2]}", 'v: [qd1, qd2], "p[1]": {from: q2, gain: -1}}')
    record = ("    record: [plant.p, plant.v]\n", f"    record: [plant.p, plant.v{recorded}]\n" if recorded else "")
    text = changed((PLANT, mapped), record)
    text, place = marked(text if recorded else text.replace("      plant:\n", "      §plant:\n", 1))
    (found,) = errors(tmp_path, text)
    assert str(found.where) == place
    assert "'plant.p' and 'plant.p[1]' are both recorded in a column 'plant.p[1]'; l" in found.message
