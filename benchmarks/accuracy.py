"""Accuracy: `cosim run` against the exact solution of the paper's network, and how it converges.

    python -m benchmarks.accuracy [--figure docs/images/convergence.svg]

Prints the tables of `docs/accuracy.md` and draws its figure. The exact solution (`tests/reference`) is computed first
and checked against a second one at half the tolerances. Run it from the repository's root; it takes about two minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.accuracy.runs import completed, cosim_run, position_error, same_network
from tests.reference.arm import Floats
from tests.reference.integrators import dop853
from tests.reference.network_ode import Log, Solution, solve
from tests.reference.run_folder import RunFolder

SHIPPED = ("paper_leaders", "paper_leaderless", "paper_known_velocity")
HORIZON = "10 s"
STEPS_US = {
    "joint": (10_000, 5_000, 2_500, 1_250, 625),
    "midpoint": (5_000, 2_500, 1_250, 625, 312.5),
    "gauss-seidel": (5_000, 2_500, 1_250, 625, 312.5),
    "jacobi": (5_000, 2_500, 1_250, 625, 312.5),
}
OVER_60_S = {
    "joint, Runge-Kutta 4, 5 ms": (),
    "joint, Dormand-Prince": ("coupling.integrator=dormand-prince",),
    "midpoint, 1 ms": ("coupling.method=midpoint", "coupling.step=1 ms"),
    "gauss-seidel, 1 ms": ("coupling.method=gauss-seidel", "coupling.step=1 ms"),
    "jacobi, 1 ms": ("coupling.method=jacobi", "coupling.step=1 ms"),
}

Errors = Mapping[str, Sequence[tuple[float, float]]]
"""Per method: step in s, largest error of an angle in rad (NaN where the run broke down)."""


def shipped_scenarios(folder: Path) -> tuple[RunFolder, Solution]:
    """Table: the shipped scenarios over their whole length. Returns the first of them with its exact solution."""
    variables = ("plant.p", "plant.v", "controller.u", "controller.v_hat", "controller.theta_hat")
    print("| scenario | " + " | ".join(f"`{name}`" for name in variables) + " | exact solution itself |")
    print("|---|" + "---|" * (len(variables) + 1))
    cases = []
    for name in SHIPPED:
        run = completed(name, folder / name)
        exact = run.solve()
        second = run.solve(integrate=dop853(rtol=5e-13, atol=5e-14, max_step=5e-3))
        expected = [getattr(exact, variable.split(".")[1]) for variable in variables]
        errors = [
            np.abs(run.recorded(variable, values.shape[2]) - values).max()
            for variable, values in zip(variables, expected, strict=True)
        ]
        own = np.nanmax(np.abs(second.states - exact.states))
        print(f"| `{name}` | " + " | ".join(f"{error:.1e}" for error in errors) + f" | {own:.0e} |")
        cases.append((run, exact))
    print()
    settling(cases)
    return cases[0]


def settling(cases: Sequence[tuple[RunFolder, Solution]]) -> None:
    """Table: how far from synchrony from some time on, in the recorded runs."""
    print(
        "| scenario | from | `max abs(p_1 - p_i)` rad | `max abs(v_i - v_c)` rad/s | `max abs(v_hat_i - v_c)` rad/s |"
    )
    print("|---|---|---|---|---|")
    for name, (run, exact) in zip(SHIPPED, cases, strict=True):
        p, v, v_hat = (run.recorded(variable) for variable in ("plant.p", "plant.v", "controller.v_hat"))
        for second in (20, 30, 40, 50):
            late = slice(np.searchsorted(exact.time, second - 1e-9), None)
            final = v_hat[-1].mean(axis=0)
            gaps = (p[late] - p[late, :1], v[late] - final, v_hat[late] - final)
            print(f"| `{name}` | {second} s | " + " | ".join(f"{np.abs(gap).max():.1e}" for gap in gaps) + " |")
    print()


def couplings(folder: Path, base: RunFolder, exact: Solution) -> None:
    """Table: every coupling over 60 s of the first scenario."""
    print("| coupling | error after 10 s | error over 60 s |")
    print("|---|---|---|")
    ten = 10**10 // base.period_ns
    head = replace_length(exact, ten)
    for i, (name, changes) in enumerate(OVER_60_S.items()):
        run = completed(SHIPPED[0], folder / f"coupling{i}", *changes)
        assert same_network(run, base)
        print(f"| {name} | {position_error(run, head):.1e} | {position_error(run, exact):.1e} |")
    print()


def replace_length(exact: Solution, ticks: int) -> Solution:
    """The first `ticks` periods of a solution."""
    names = ("time", "states", "v_hat", "u", "e", "v_r")
    return replace(exact, **{name: getattr(exact, name)[: ticks + 1] for name in names})


def late_arrivals(base: RunFolder, exact: Solution) -> None:
    """Table: what it would cost to take deliveries late; exact solutions only."""
    print("| deliveries take effect | error over 10 s |")
    print("|---|---|")
    log, ticks = base.log, 10**10 // base.period_ns
    grids = {"at the next tick": base.period_ns, "on a grid of 5 ms": 5_000_000, "on a grid of 1 ms": 1_000_000}
    for name, grid in grids.items():
        late = Log(log.sender, log.receiver, log.stamp, -(-log.arrival_ns // grid) * grid)
        moved = solve(base.agents, base.period_ns, ticks, late)
        print(f"| {name} | {np.abs(moved.p - exact.p[: ticks + 1]).max():.1e} |")
    print()


def convergence(folder: Path, base: RunFolder, exact: Solution) -> Errors:
    """Table: error over the step, per method."""
    print(f"| coupling | step | error over {HORIZON} | order |")
    print("|---|---|---|---|")
    errors: dict[str, list[tuple[float, float]]] = {}
    for method, steps in STEPS_US.items():
        errors[method] = []
        for step in steps:
            changes = f"coupling.method={method}", f"coupling.step={round(step * 1000)} ns"
            done = cosim_run(SHIPPED[0], folder / f"{method}-{step}", *changes, until=HORIZON)
            if done.code == 0:
                assert same_network(done.folder, base)
            error = position_error(done.folder, exact) if done.code == 0 else float("nan")
            order = f"{np.log2(errors[method][-1][1] / error):.2f}" if errors[method] else ""
            print(f"| {method} | {step / 1000:g} ms | {error:.1e} | {order} |")
            errors[method].append((step * 1e-6, error))
    print()
    return errors


def draw(errors: Errors, figure: Path) -> None:
    """Error over step, both logarithmic, with the slopes of orders 1, 2 and 4."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "convergence"
    from matplotlib import pyplot as plt

    fig, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for (method, points), marker, style in zip(errors.items(), "os^v", ("-", "-", "-", "--"), strict=True):
        table: Floats = np.array(points)
        axes.loglog(table[:, 0] * 1e3, table[:, 1], marker=marker, linestyle=style, label=method)
    for order, method in ((1, "jacobi"), (2, "midpoint"), (4, "joint")):
        table = np.array(errors[method])[1:]
        guide = table[0, 1] * (table[:, 0] / table[0, 0]) ** order * 0.4
        axes.loglog(table[:, 0] * 1e3, guide, color="0.6", linewidth=0.8)
        axes.annotate(f"order {order}", (table[-1, 0] * 1e3, guide[-1]), color="0.4", fontsize=8, va="top")
    axes.set_xlabel("step [ms]")
    axes.set_ylabel(f"largest error of an angle over {HORIZON} [rad]")
    axes.grid(visible=True, which="major", linewidth=0.4)
    axes.legend(frameon=False)
    figure.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(figure, metadata={"Date": None})


def main() -> None:
    """Print the tables, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=Path("docs/images/convergence.svg"))
    figure = parser.parse_args().figure
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base, exact = shipped_scenarios(folder)
        couplings(folder, base, exact)
        late_arrivals(base, exact)
        draw(convergence(folder, base, exact), figure)
    print(f"wrote {figure}")


if __name__ == "__main__":
    main()
