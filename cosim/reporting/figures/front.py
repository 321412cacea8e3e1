"""Assumption 1: which pairs (k*, h) the deliveries admit, and the pair with the least k*·T + h."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cosim.reporting.edges import Edges
from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, need_messages
from cosim.reporting.words import number
from network.freshness import Front, common_front

FAR = 2.5
"""So many times the least k*·T + h are shown at most."""


def draw_front(edges: Edges) -> tuple[Figure, str]:
    """The front of every channel, common to its edges, and of the network; the line of the least k*·T + h."""
    need_messages(edges)
    if not edges.fronts_are_known:
        raise NotDrawn("The log is too long for Assumption 1 to be evaluated.")
    groups = edges.by_channel
    fronts = {name: common_front([edges.fronts[link] for link in links]) for name, links in groups.items()}
    common = edges.common_front
    if not any(len(front.h_ns) for front in fronts.values()):
        raise NotDrawn("An edge of every channel delivered nothing: no pair (k*, h) is admitted.")
    several = len(groups) > 1
    labels = [*(name for name, front in fronts.items() if len(front.h_ns) and several)]
    labels += ["all edges"] if several and len(common.h_ns) else []
    figure, (axes,) = style.panels(1, 1.6, lines=style.legend_lines(labels))
    handles = []
    right, top = _corner([front for front in (*fronts.values(), common) if len(front.h_ns)], edges.span.period_ns)
    for colour, front in zip(style.channel_colours(len(groups)), fronts.values(), strict=True):
        if len(front.h_ns):
            handles.append(_draw(axes, front, (right, top), colour, 0.9))
    text = "Above and to the right of a curve, Assumption 1 held with that (k*, h)"
    text += " on all edges of the channel." if several or len(edges) > 1 else "."
    if len(common.h_ns):
        if several:
            handles.append(_draw(axes, common, (right, top), style.INK, 1.4))
        text += _draw_best(axes, common, edges.span.period_ns, right)
    style.legend(figure, handles if labels else [], labels)
    axes.set_xlim(-0.02 * right, right)
    axes.set_ylim(0, top)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.set_xlabel("k* (ticks)", labelpad=2)
    style.seconds_axis(axes.yaxis, "h", top)
    return figure, text


def _corner(fronts: Sequence[Front], period_ns: int) -> tuple[float, float]:
    """The largest k* and h that are shown: all of them, unless that is far beyond the pairs with the least sums."""
    far = FAR * max(front.smallest_sum_ns(period_ns) or 0 for front in fronts)
    k_star = min(far / period_ns, max(int(front.k_star.max()) for front in fronts))
    h = min(far, max(int(front.h_ns.max()) for front in fronts)) / 1e9
    return 1.06 * k_star + 0.5, 1.12 * h or 1e-3


def _draw(axes: Axes, front: Front, corner: tuple[float, float], colour: object, width: float) -> object:
    """A step curve: with more ticks between samples that are in time, a smaller h will do."""
    k_star, h = front.k_star[::-1], front.h_ns[::-1] / 1e9
    x = np.concatenate(([k_star[0]], k_star, [max(corner[0], float(k_star[-1]))]))
    y = np.concatenate(([max(corner[1], float(h[0]))], h, h[-1:]))
    return axes.step(x, y, where="post", color=colour, linewidth=width)[0]


def _draw_best(axes: Axes, front: Front, period_ns: int, right: float) -> str:
    """The pair with the least k*·T + h, and the line of all pairs with this sum; says so in the caption."""
    total = front.k_star * period_ns + front.h_ns
    best = int(np.argmin(total))
    k_star, h, least = int(front.k_star[best]), front.h_ns[best] / 1e9, total[best] / 1e9
    x = np.array((0.0, right))
    axes.plot(x, least - x * period_ns / 1e9, color=style.FAINT, linewidth=0.8, linestyle=(0, (4, 2)), zorder=1)
    axes.plot([k_star], [h], "o", color=style.WARM, markersize=3.5, markeredgewidth=0, zorder=4)
    return (
        f" The dot is the pair with the least k*·T + h common to all edges, {number(least, 's')}, with "
        f"k* = {k_star} and h = {number(h, 's')}; on the dashed line lie all pairs with this sum."
    )
