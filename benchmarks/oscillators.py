"""Two coupled oscillators, split in two ways, against the whole: orders of convergence, and a stiff coupling.

    python -m benchmarks.oscillators [--figure docs/images/oscillators.svg]

Prints the tables of the section of `docs/accuracy.md` and draws its figure. Run it from the repository's root; it takes
about a minute.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.accuracy.coupled_oscillators import PERIOD_MS, SPLITS, STIFF, Oscillators, build_models, error, simulate

METHODS = ("joint", "midpoint", "gauss-seidel", "jacobi")
STEPS_US = (10_000, 5_000, 2_500, 1_250, 625)
CASES = {"k_c = 30 N/m": Oscillators(), "k_c = 1000 N/m": STIFF}

Errors = Mapping[tuple[str, str], Sequence[float]]
"""Per split and method: the largest error of a position at each of STEPS_US, m."""


def table(name: str, oscillators: Oscillators, built: Path, folder: Path) -> Errors:
    """Print the errors of one pair of oscillators."""
    amplitude = np.abs(oscillators.solution(np.arange(101) * PERIOD_MS / 1e3)).max()
    print(f"{name}; the positions stay below {amplitude:.2g} m\n")
    print("| split | coupling | " + " | ".join(f"{step / 1000:g} ms" for step in STEPS_US) + " | order |")
    print("|---|---|" + "---|" * (len(STEPS_US) + 1))
    errors = {}
    for split in SPLITS:
        for method in METHODS:
            found = []
            for step in STEPS_US:
                out = Path(tempfile.mkdtemp(dir=folder)) / "run"
                found.append(error(simulate(oscillators, split, method, step, built, out), oscillators))
            errors[split, method] = found
            shown = " | ".join(f"{e:.1e}" if e < 10 * amplitude else "diverges" for e in found)
            order = f"{np.log2(found[-2] / found[-1]):.2f}" if found[-2] < amplitude else ""
            print(f"| {split} | {method} | {shown} | {order} |")
    print()
    return errors


def draw(cases: Mapping[str, Errors], figure: Path) -> None:
    """Error over step, both logarithmic, a panel per pair of oscillators."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["svg.hashsalt"] = "oscillators"
    from matplotlib import pyplot as plt

    fig, panels = plt.subplots(1, 2, figsize=(8.6, 4.2), sharey=True, layout="constrained")
    steps = np.array(STEPS_US) / 1e3
    for axes, (name, errors) in zip(panels, cases.items(), strict=True):
        for number, method in enumerate(METHODS):
            for split, style in zip(SPLITS, ("-", "--"), strict=True):
                label = method if split == SPLITS[0] else None
                axes.loglog(steps, errors[split, method], style, marker="os^v"[number], color=f"C{number}", label=label)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("step [ms]")
        axes.set_xticks(steps, [f"{step:g}" for step in steps], minor=False)
        axes.minorticks_off()
        axes.set_ylim(1e-12, 1e3)
        axes.grid(visible=True, which="major", linewidth=0.4)
    for order, method in ((1, "gauss-seidel"), (2, "midpoint"), (4, "joint")):
        guide = cases["k_c = 30 N/m"][SPLITS[0], method][1] * (steps[1:] / steps[1]) ** order * 0.3
        panels[0].plot(steps[1:], guide, color="0.6", linewidth=0.8)
        panels[0].annotate(f"order {order}", (steps[-1], guide[-1]), color="0.4", fontsize=8, va="top")
    panels[0].set_ylabel("largest error of a position over 10 s [m]")
    panels[0].plot([], [], "-", color="0.4", label=SPLITS[0])
    panels[0].plot([], [], "--", color="0.4", label=SPLITS[1])
    panels[0].legend(frameon=False, fontsize=8, loc="upper left")
    figure.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(figure, metadata={"Date": None})


def main() -> None:
    """Print the tables, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=Path("docs/images/oscillators.svg"))
    figure = parser.parse_args().figure
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = build_models(folder / "fmus")
        draw({case: table(case, pair, built, folder) for case, pair in CASES.items()}, figure)
    print(f"wrote {figure}")


if __name__ == "__main__":
    main()
