"""`midpoint` where messages make inputs jump, at any distance from the ends of steps: against the exact solution.

A mass is listed before the controller that pulls it to what it hears, so that what the controller gives jumps at every
arrival and reaches the mass a step late. Between arrivals the loop is linear: its solution is a matrix exponential.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.running.estimation import Estimate
from cosim.running.inline import run
from tests.accuracy.test_step_control import Accounted
from tests.distributed.networks import planned
from tests.reference.arm import Floats

TICKS, T = 30, 0.1
SENDERS = ((0.8, 1.0), (-0.5, 4.0), (1.1, -2.0), (0.3, 7.0))
"""Where each starts and how fast; a spring and a damper bring it to rest."""

SCENARIO = """\
period: 100 ms
duration: 3 s
templates:
  sender:
    components: {mass: {fmu: MassSpringDamper, start: {solver_step: 0.0005}}}
    publish: {p: mass.p, v: mass.v}
    record: []
agents:
  hearer:
    components:
      mass: {fmu: MassSpringDamper, start: {solver_step: 0.0005, p: 1}}
      controller: {fmu: ConsensusController, start: {k_p: 3, k_v: 0.5, k_d: 2}}
    connections: [mass.p -> controller.p, mass.v -> controller.v, controller.u -> mass.u]
    publish: {p: mass.p, v: mass.v}
    receive: {p: controller.neighbour_p, v: controller.neighbour_v, stamp: controller.neighbour_stamp,
              count: controller.n_neighbours}
    record: [mass.p]
"""


def scenario(delays_ns: tuple[int, ...], coupling: str, *, feedback: bool = True) -> str:
    """Without feedback, what the controller is told of the mass stays 0: it only gives its pull."""
    text = SCENARIO if feedback else SCENARIO.replace("mass.p -> controller.p, mass.v -> controller.v, ", "")
    lines, channels = [text.rstrip()], ["channels:"]
    edges = ["graph:", "  edges:"]
    for i, delay_ns in enumerate(delays_ns):
        p, v = SENDERS[i]
        lines.append(f"  s{i}: {{template: sender, components: {{mass: {{start: {{p: {p}, v: {v}}}}}}}}}")
        channels.append(f"  d{i}: {{model: netem, delay: {delay_ns} ns}}")
        edges.append(f"    - {{from: s{i}, to: hearer, channel: d{i}}}")
    return "\n".join([*lines, *channels, *edges, f"coupling: {{{coupling}}}", ""])


def simulate(delays_ns: tuple[int, ...], coupling: str, *, feedback: bool = True) -> Accounted:
    seen = Accounted()
    run(planned(scenario(delays_ns, coupling, feedback=feedback)), [seen])
    return seen


def exact(delays_ns: tuple[int, ...], *, feedback: bool = True) -> Floats:
    """The mass at every tick. Before a sender is heard, it counts as nothing."""
    heard: dict[int, Floats] = {}
    arrivals = sorted((k * 10**8 + delay, i, k) for k in range(TICKS) for i, delay in enumerate(delays_ns))
    ticks = [((k + 1) * 10**8, -1, k) for k in range(TICKS)]
    x, now, found = np.array([1.0, 0.0]), 0, [1.0]
    for at, sender, tick in sorted(arrivals + ticks):
        pull = sum((3.0 * p + 0.5 * v for p, v in heard.values()), 0.0)
        stiffness, damping = (3.0 * len(heard), 2.0 + 0.5 * len(heard)) if feedback else (0.0, 0.0)
        whole = np.array([[0.0, 1.0, 0.0], [-1.0 - stiffness, -0.5 - damping, pull], [0.0, 0.0, 0.0]])
        x = (expm((at - now) / 1e9 * whole) @ [*x, 1.0])[:2]
        now = at
        if sender < 0:
            found.append(float(x[0]))
        else:
            heard[sender] = expm(tick * T * np.array([[0.0, 1.0], [-1.0, -0.5]])) @ SENDERS[sender]
    return np.array(found)


DELAYS = {
    "1 us before the tick": (99_999_000,),
    "1 ns before the tick": (99_999_999,),
    "two that are 1 ns apart": (37_300_000, 37_300_001),
    "four, some of them close to each other": (20_300_000, 20_850_000, 64_123_456, 64_123_999),
    "four over the period": (23_456_789, 45_678_901, 56_789_012, 78_901_234),
}


@pytest.mark.parametrize("delays_ns", DELAYS.values(), ids=DELAYS.keys())
def test_an_arrival_costs_no_more_than_where_outputs_are_held(delays_ns: tuple[int, ...]) -> None:
    true, errors = exact(delays_ns), {}
    for method in ("midpoint", "gauss-seidel"):
        for step_ms in (4, 1):
            rows = simulate(delays_ns, f"method: {method}, step: {step_ms} ms").rows
            errors[method, step_ms] = float(np.abs(np.array(rows)[:, 0] - true).max())
    for step_ms in (4, 1):
        assert errors["midpoint", step_ms] < errors["gauss-seidel", step_ms]
    assert errors["midpoint", 1] < 0.35 * errors["midpoint", 4] < 0.35 * 2e-2, "of order 1 in the step"


def test_both_loops_make_the_same_of_steps_of_a_nanosecond() -> None:
    for delays_ns in DELAYS.values():
        native, python = (simulate(delays_ns, f"method: midpoint, loop: {loop}") for loop in ("native", "python"))
        assert native.ticks == python.ticks


@pytest.mark.parametrize("feedback", [True, False])
@pytest.mark.parametrize("delays_ns", list(DELAYS.values())[2::2], ids=list(DELAYS)[2::2])
def test_a_tolerance_sees_the_jumps(delays_ns: tuple[int, ...], *, feedback: bool) -> None:
    """Without feedback, nobody reads what the mass does; it is recorded."""
    true, errors = exact(delays_ns, feedback=feedback), []
    for tolerance in (1e-3, 1e-5):
        seen = simulate(delays_ns, f"method: midpoint, tolerance: {tolerance}", feedback=feedback)
        account = seen.accounts[0]
        assert account.agent == "hearer"
        errors.append(float(np.abs(np.array(seen.rows)[:, 0] - true).max()))
        assert errors[-1] < tolerance * account.steps
    assert errors[1] < 0.1 * errors[0]


@pytest.mark.parametrize("loop", ["native", "python"])
@pytest.mark.parametrize("method", ["midpoint", "gauss-seidel", "jacobi"])
@pytest.mark.parametrize(
    ("delays_ns", "step"), [((25_000_000, 50_000_000, 75_000_000), "50 ms"), ((7_000_000, 50_000_000), "20 ms")]
)
def test_the_estimated_error_where_arrivals_cut_the_steps(
    delays_ns: tuple[int, ...], step: str, method: str, loop: str
) -> None:
    """In the first case every step is half as long as what is asked for: half of that alone would change nothing."""
    plan = planned(scenario(delays_ns, f"method: {method}, step: {step}, loop: {loop}"))
    estimate, seen = Estimate(plan), Accounted()
    estimate.prepare(lambda: False)
    run(plan, [estimate, seen])
    found = np.array(seen.rows)[:, 0]
    (error,) = estimate.errors()
    assert error.error == pytest.approx(np.abs(found - exact(delays_ns)).max(), rel=0.2)
