"""A small scenario with the shipped FMUs, ways to break it, and where the break must be reported."""

from pathlib import Path

from cosim.errors import ConfigError, Problem, Severity
from cosim.planning import Planned, plan
from cosim.scenario.merging import Override
from cosim.scenario.reading import read_scenario

FILE = "net.yaml"
BASE = """\
period: 100 ms
duration: 1 s
seed: 3
templates:
  arm:
    components:
      plant:
        fmu: TwoLinkArm
        start: {p: {uniform: [-1, 1]}, v: 0}
      controller:
        fmu: ArmSyncController
        start: {role: follower}
    connections:
      - plant.p -> controller.p
      - plant.v -> controller.v
      - controller.u -> plant.u
    publish:
      p: plant.p
      v_hat: controller.v_hat
    receive:
      count: controller.n_neighbours
      period: controller.T
      stamp: controller.neighbour_stamp
      time: controller.neighbour_time
      weight: controller.weight
      p: controller.neighbour_p
      v_hat: controller.neighbour_v_hat
    record: [plant.p, plant.v]
agents:
  1..3: {template: arm}
  2: {components: {controller: {start: {role: leader}}}}
coupling: {method: joint, step: 5 ms}
graph:
  channel: fast
  edges:
    - 1 -> 2
    - 2 -> 3
    - 3 -> 1
    - 2 -> 1
channels:
  fast: {model: ideal}
analysis:
  position: plant.p
  velocity: plant.v
  reference_velocity: [0.3, 0.6]
  leaders: {controller.role: leader}
  k_eta: controller.k_eta
  lambda: controller.lambda
"""


def changed(*changes: tuple[str, str], text: str = BASE) -> str:
    """The scenario with pieces of its text replaced; each piece must occur exactly once."""
    for old, new in changes:
        assert text.count(old) == 1, f"{old!r} occurs {text.count(old)} times"
        text = text.replace(old, new)
    return text


def marked(text: str) -> tuple[str, str]:
    """The text without its mark `§`, and the place of the mark as `file:line:column`."""
    before, _, after = text.partition("§")
    lines = before.split("\n")
    return before + after, f"{FILE}:{len(lines)}:{len(lines[-1]) + 1}"


def planned(folder: Path, text: str = BASE, *settings: str) -> Planned:
    """What the text is planned as."""
    path = folder / FILE
    path.write_text(text, encoding="utf-8")
    return plan(read_scenario(path, FILE, [Override.from_setting(setting) for setting in settings]))


def problems(folder: Path, text: str, *settings: str) -> list[Problem]:
    """What is wrong with the text; nothing if it can be planned."""
    try:
        planned(folder, text, *settings)
    except ConfigError as error:
        return list(error.problems)
    return []


def errors(folder: Path, text: str, *settings: str) -> list[Problem]:
    """What must be mended in the text."""
    return [problem for problem in problems(folder, text, *settings) if problem.severity is Severity.ERROR]
