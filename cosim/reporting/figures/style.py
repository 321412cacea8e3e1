"""How every figure looks: sizes for one column of a paper, a palette for colour-blind eyes too, lines and bands."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from cosim.recording.atomic import write_atomically
from network.messages import Floats

WIDTH = 3.5
"""Inches: one column of the usual two-column paper."""

FEW = 10
"""Up to as many lines have a colour and an entry in the legend each."""

MANY = 24
"""Beyond as many lines, bands of quantiles are drawn instead."""

# Paul Tol's "muted" scheme (https://sronpersonalpages.nl/~pault/), distinct for the common kinds of colour blindness.
AGENT_COLOURS = (
    "#332288",
    "#CC6677",
    "#117733",
    "#88CCEE",
    "#882255",
    "#DDCC77",
    "#44AA99",
    "#AA4499",
    "#999933",
    "#666666",
)
SHORT_S = 0.1
"""Shorter times are shown in milliseconds."""

INK = "#222222"
ACCENT = "#0072B2"  # blue, orange and green of Okabe and Ito
WARM = "#D55E00"
GREEN = "#009E73"
FAINT = "#9A9A9A"

_LEGEND_SIZE = 7.5
_STYLE: dict[Any, Any] = {
    "font.family": "STIXGeneral",  # a Times, as most papers have; it comes with matplotlib: the same everywhere
    "font.size": 8.0,
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "ytick.minor.size": 0.0,
    "lines.linewidth": 0.9,
    "lines.solid_joinstyle": "round",
    "legend.fontsize": _LEGEND_SIZE,
    "legend.frameon": False,
    "legend.handlelength": 0.9,
    "legend.handletextpad": 0.35,
    "legend.columnspacing": 0.5,
    "legend.borderaxespad": 0.0,
    "legend.borderpad": 0.0,
    "mathtext.fontset": "stix",
    "svg.fonttype": "path",  # the text looks the same wherever the file is opened, with no font installed
    "svg.hashsalt": "netcosim",  # else identifiers are random, and the same run gives another file
    "pdf.fonttype": 42,  # TrueType, as publishers ask
    "path.simplify_threshold": 0.3,
}

# Of a figure, in inches.
_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 0.52, 0.10, 0.36, 0.10, 0.12
_LEGEND_LINE = 0.14
_LETTER = 0.46  # of the usual letter: width over size


def styled() -> Any:
    """A context in which figures are drawn and saved."""
    return mpl.rc_context(_STYLE)


def panels(
    n: int, height: float = 1.15, *, lines: int = 1, gap: float = _GAP, share: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of panels below one another.

    Args:
        n: how many.
        height: of each, in inches.
        lines: of a legend, kept free above the first.
        gap: between panels, in inches.
        share: whether they have a common horizontal axis.

    Returns:
        The figure and the list of its axes, top to bottom.
    """
    top = _TOP + _LEGEND_LINE * lines
    total = top + n * height + (n - 1) * gap + _BOTTOM
    figure = Figure(figsize=(WIDTH, total))
    axes = figure.subplots(
        n,
        1,
        sharex=share,
        squeeze=False,
        gridspec_kw={
            "left": _LEFT / WIDTH,
            "right": 1 - _RIGHT / WIDTH,
            "bottom": _BOTTOM / total,
            "top": 1 - top / total,
            "hspace": gap / height,
        },
    )[:, 0]
    return figure, list(axes)


def time_axis(axes: Axes, start: float, stop: float) -> None:
    """Seconds, from start to stop."""
    axes.set_xlabel("time (s)", labelpad=2)
    axes.set_xlim(start, stop if stop > start else start + 1)


def seconds_axis(axis: Axis, label: str, largest: float) -> None:
    """A label with its unit: seconds, or milliseconds where nothing is as long as a tenth of a second."""
    if largest < SHORT_S:
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{1e3 * x:.6g}"))
        axis.set_label_text(f"{label} (ms)")
    else:
        axis.set_label_text(f"{label} (s)")


def legend_lines(labels: Sequence[str], title: str = "") -> int:
    """How many lines the legend of these labels takes; for `panels`."""
    return -(-len(labels) // _legend_columns(labels, title)) if labels else 0


def legend(figure: Figure, handles: Sequence[Any], labels: Sequence[str], title: str = "") -> None:
    """A legend in the space that `panels` kept free, filled line by line; its title stands before it."""
    if not labels:
        return
    columns = _legend_columns(labels, title)
    by_column = [i for column in range(columns) for i in range(column, len(labels), columns)]
    y = 1 - 0.05 / figure.get_figheight()
    if title:
        figure.text(_LEFT / WIDTH, y, title, fontsize=_LEGEND_SIZE, va="top")
    figure.legend(
        [handles[i] for i in by_column],
        [labels[i] for i in by_column],
        loc="upper left",
        ncols=columns,
        bbox_to_anchor=(_LEFT / WIDTH + _title_width(title) / 72 / WIDTH, y),
    )


def _legend_columns(labels: Sequence[str], title: str) -> int:
    """As many as fit beside one another, by an estimate of the width of the text; lines of about equal length."""
    room = 72 * (WIDTH - _LEFT - _RIGHT) - _title_width(title)
    widths = [_LEGEND_SIZE * (1.75 + _LETTER * _text_length(label)) for label in labels]
    if sum(widths) <= room:
        return len(labels)
    lines = -(-len(labels) // max(1, int(room / max(widths))))
    return -(-len(labels) // lines)


def _title_width(title: str) -> float:
    """In points."""
    return _LEGEND_SIZE * (_LETTER * _text_length(title) + 0.2) if title else 0.0


def _text_length(text: str) -> int:
    """Characters that show: a formula's marks do not."""
    return len(text) - sum(text.count(mark) for mark in "${}\\_^")


def agent_colours(n: int) -> list[Any]:
    """A colour per agent: distinct for a few, along one scale for more."""
    if n <= len(AGENT_COLOURS):
        return list(AGENT_COLOURS[:n])
    return [mpl.colormaps["viridis"](x) for x in np.linspace(0.0, 0.92, n)]


def channel_colours(n: int) -> list[Any]:
    """A colour per channel."""
    return [ACCENT] if n == 1 else agent_colours(n)


def spread(axes: Axes, time: Floats, values: Floats, colours: Sequence[Any], *, steps: bool = False) -> list[Any]:
    """One quantity of several agents over time: lines, or for many agents bands of quantiles.

    Args:
        axes: where.
        time: (n_times,)
        values: (n_times, n_agents)
        colours: (n_agents,)
        steps: whether the values hold until the next time.

    Returns:
        The handles for a legend, one per agent or per band.
    """
    if values.shape[1] > MANY:
        return bands(axes, time, values)
    width = 0.9 if values.shape[1] <= FEW else 0.5
    style = "steps-post" if steps else "default"
    return [
        axes.plot(time, values[:, i], color=colours[i], linewidth=width, drawstyle=style)[0]
        for i in range(values.shape[1])
    ]


BAND_LABELS = ("all", "10–90 %", "25–75 %", "median")
_BAND_COLOURS = ("#D3E5F1", "#A2C8E1", "#5C9FCB")
_MEDIAN_COLOUR = "#003A5D"


def bands(axes: Axes, time: Floats, values: Floats) -> list[Any]:
    """Quantiles over agents; the handles that belong to `BAND_LABELS`."""
    low, q10, q25, median, q75, q90, high = np.quantile(values, (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0), axis=1)
    handles: list[Any] = [
        axes.fill_between(time, lower, upper, color=colour, linewidth=0)
        for lower, upper, colour in zip((low, q10, q25), (high, q90, q75), _BAND_COLOURS, strict=True)
    ]
    return handles + axes.plot(time, median, color=_MEDIAN_COLOUR, linewidth=0.9)


def save(figure: Figure, folder: Path, name: str) -> str:
    """Write `name.svg` and `name.pdf`; no dates in them. The text of the SVG."""
    svg, pdf = io.BytesIO(), io.BytesIO()
    figure.savefig(svg, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    figure.savefig(pdf, format="pdf", metadata={"CreationDate": None, "Creator": "netcosim"})
    write_atomically(folder / f"{name}.svg", svg.getvalue())
    write_atomically(folder / f"{name}.pdf", pdf.getvalue())
    return svg.getvalue().decode()
