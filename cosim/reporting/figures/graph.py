"""The interconnection graph, with its leaders and roots."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch

from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, Scene
from cosim.scenario.names import in_short
from cosim.topology import roots
from network.messages import Floats, Links

ON_A_CIRCLE = 14
"""Up to as many agents stand on a circle, in the order of the file."""

MAX_AGENTS = 250
"""Beyond, arrows and names cannot be told apart in a column."""

_ITERATIONS = 200


def draw_graph(scene: Scene) -> tuple[Figure, str]:
    """Agents as discs, an arrow from sender to receiver."""
    links = scene.results.links
    n = len(links.agents)
    if n > MAX_AGENTS:
        raise NotDrawn(f"With {n} agents a drawing of the graph shows nothing; the manifest lists its edges.")
    leaders = set(scene.results.analysis["leaders"])
    root = {links.agents[i] for i in roots(links)}
    all_roots = len(root) == n
    positions = circle(n) if n <= ON_A_CIRCLE else stress_layout(links)
    height = 3.4 if n > ON_A_CIRCLE else 2.5 if n > 2 else 0.9
    figure = Figure(figsize=(style.WIDTH, height))
    axes = figure.add_axes((0.02, 0.02, 0.96, 1 - 0.04 - 0.2 / height))
    axes.set_axis_off()
    outside = 2 < n <= ON_A_CIRCLE and _longest(links) > _INSIDE
    margin = _MARGIN + (2 * _NAME if outside else 0.0)
    radius = _radius(positions, height, margin)
    _arrows(axes, positions, links, radius)
    kinds = [_kind(name, leaders, set() if all_roots else root) for name in links.agents]
    for kind, (face, edge, thick, _) in _KINDS.items():
        width = min(thick, 0.22 * radius)
        here = np.array([k == kind for k in kinds], dtype=bool)
        axes.plot(
            *positions[here].T,
            "o",
            markersize=2 * radius - width,
            markerfacecolor=face,
            markeredgecolor=edge,
            markeredgewidth=width,
            zorder=3,
        )
    _names(axes, positions, links, [_KINDS[kind][0] for kind in kinds], radius)
    _frame(axes, positions, height, margin)
    present = [kind for kind in _KINDS if kind in kinds]
    if present != ["other"]:
        _legend(figure, present, height)
    text = f"Who hears whom: {_count(n, 'agent')} and {_count(len(links), 'edge')}, drawn from sender to receiver."
    text += " Every agent is a root." if all_roots else f" {_roots(links, root)}"
    return figure, text


_INSIDE = 3
"""Letters of names that fit into a disc."""

_MARGIN, _NAME = 26.0, 8.0
"""Points around the discs, and those that a name takes."""

_BESIDE = 0.3
"""A name is centred on its disc where the circle leads less to that side."""

# Fill, edge, width of the edge, label.
_KINDS = {
    "leader": (style.WARM, style.WARM, 0.6, "leader"),
    "leader and root": (style.WARM, style.INK, 1.6, "leader and root"),
    "root": ("#DCEAF5", style.INK, 1.6, "root"),
    "other": ("#DCEAF5", "#5B7F9C", 0.6, "other agent"),
}


def _kind(name: str, leaders: set[str], root: set[str]) -> str:
    if name in leaders:
        return "leader and root" if name in root else "leader"
    return "root" if name in root else "other"


def _roots(links: Links, root: set[str]) -> str:
    names = in_short(name for name in links.agents if name in root)
    if not root:
        return "The graph is not rooted."
    return f"{'Root' if len(root) == 1 else 'Roots'}: {names}."


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


# --- layout -----------------------------------------------------------------------------------------------------------
def circle(n: int) -> Floats:
    """(n, 2) clockwise from the top; two agents side by side."""
    angle = np.pi * (0.5 if n > 2 else 1.0) - 2 * np.pi * np.arange(n) / max(1, n)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def stress_layout(links: Links) -> Floats:
    """(n, 2): distances in the plane like those in the graph, edges taken as undirected.

    Stress majorisation with weights d^-2 (Gansner, Koren, North: "Graph drawing by stress majorization", 2004), started
    from classical scaling; the long axis lies across.
    """
    distance = _distances(links)
    n = len(distance)
    with np.errstate(divide="ignore"):
        weight = np.where(np.eye(n, dtype=bool), 0.0, 1 / np.maximum(distance, 1e-9) ** 2)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    inverse = np.linalg.pinv(laplacian)
    positions = _classical_scaling(distance)
    for _ in range(_ITERATIONS):
        gap = _gaps(positions)
        ratio = np.where(gap > 1e-9, weight * distance / np.maximum(gap, 1e-9), 0.0)
        moved = inverse @ ((np.diag(ratio.sum(axis=1)) - ratio) @ positions)
        change = np.abs(moved - positions).max()
        positions = moved
        if change < 1e-3:
            break
    _, axes = np.linalg.eigh(np.cov(positions.T))
    positions = (positions - positions.mean(axis=0)) @ axes[:, ::-1]
    positions = positions * np.where(positions[0] < 0, 1, -1)  # the first agent on the left, below
    return _separate(positions)


def _separate(positions: Floats) -> Floats:
    """Push apart the pairs that are much closer than is usual."""
    np.fill_diagonal(gap := _gaps(positions), np.inf)
    wanted = 0.75 * float(np.median(gap.min(axis=1)))
    for _ in range(50):
        apart = positions[:, None] - positions[None]
        gap = np.maximum(_gaps(positions), 1e-9)
        np.fill_diagonal(gap, np.inf)
        push = np.maximum(0.0, wanted - gap) / gap
        if not push.any():
            break
        positions = positions + 0.5 * (push[:, :, None] * apart).sum(axis=1)
    return positions


def _gaps(positions: Floats) -> Floats:
    """(n, n) distances in the plane."""
    gaps: Floats = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return gaps


def _distances(links: Links) -> Floats:
    """(n, n) edges between any two agents, whatever their direction; where there is no way, longest + 1."""
    n = len(links.agents)
    adjacent = np.zeros((n, n), dtype=np.float32)
    adjacent[links.sender, links.receiver] = adjacent[links.receiver, links.sender] = 1
    distance = np.full((n, n), np.inf)
    reached = np.eye(n, dtype=bool)
    distance[reached] = 0
    for hops in range(1, n):
        further = (reached.astype(np.float32) @ adjacent > 0) & ~reached
        if not further.any():
            break
        distance[further] = hops
        reached |= further
    finite = distance[np.isfinite(distance)].max()
    return np.where(np.isfinite(distance), distance, finite + 1)


def _classical_scaling(distance: Floats) -> Floats:
    """Torgerson's: eigenvectors of the centred squared distances; signs fixed, so that it is always the same."""
    n = len(distance)
    centre = np.eye(n) - 1 / n
    values, vectors = np.linalg.eigh(-0.5 * centre @ distance**2 @ centre)
    top = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 1e-9))
    signs = np.sign(top[np.abs(top).argmax(axis=0), [0, 1]])
    nudge = 1e-3 * np.stack([np.cos(np.arange(n)), np.sin(np.arange(n))], axis=1)  # twins must not coincide
    scaled: Floats = top * signs + nudge
    return scaled


def _longest(links: Links) -> int:
    """Letters of the longest name."""
    return max(map(len, links.agents))


# --- drawing ----------------------------------------------------------------------------------------------------------
def _scale(positions: Floats, height: float, margin: float = _MARGIN) -> float:
    """Points per unit of the layout."""
    extent = np.maximum(np.ptp(positions, axis=0), 1e-9)
    room = 72 * np.array([0.96 * style.WIDTH, 0.96 * height - 0.2]) - margin
    return float(np.min(room / extent))


def _radius(positions: Floats, height: float, margin: float = _MARGIN) -> float:
    """Of a disc in points: as large as the nearest pair allows, within reason."""
    if len(positions) < 2:
        return 9.0
    np.fill_diagonal(gap := _gaps(positions), np.inf)
    nearest = float(np.quantile(gap.min(axis=1), 0.1)) * _scale(positions, height, margin)
    return float(np.clip(0.36 * nearest, 3.2, 9.0))


def _frame(axes: Axes, positions: Floats, height: float, margin: float) -> None:
    """Equal scales, room for the discs at the rim."""
    scale = _scale(positions, height, margin)
    middle = (positions.max(axis=0) + positions.min(axis=0)) / 2
    half = 72 * np.array([0.96 * style.WIDTH, 0.96 * height - 0.2]) / 2 / scale
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])


def _arrows(axes: Axes, positions: Floats, links: Links, radius: float) -> None:
    """Straight, or bent towards the middle of a circle; an edge and its opposite are bent apart."""
    few = len(links.agents) <= ON_A_CIRCLE
    pairs = list(zip(links.sender.tolist(), links.receiver.tolist(), strict=True))
    opposite = {(receiver, sender) for sender, receiver in pairs}
    for sender, receiver in pairs:
        (x1, y1), (x2, y2) = positions[sender], positions[receiver]
        bend = 0.0
        if (sender, receiver) in opposite:
            bend = 0.18
        elif few and len(positions) > 2:
            bend = -0.1 if x1 * y2 > x2 * y1 else 0.1
        axes.add_patch(
            FancyArrowPatch(
                tuple(positions[sender]),
                tuple(positions[receiver]),
                arrowstyle=f"-|>,head_length={0.35 if few else 0.22},head_width={0.16 if few else 0.11}",
                mutation_scale=10,
                connectionstyle=f"arc3,rad={bend}",
                shrinkA=radius,
                shrinkB=radius + 0.3,
                linewidth=0.7 if few else 0.4,
                color="#6A6A6A" if few else "#8C8C8C",
                zorder=2,
            )
        )


def _names(axes: Axes, positions: Floats, links: Links, faces: list[str], radius: float) -> None:
    """Inside the discs; where they are long, outside of a circle, or below the discs."""
    longest = _longest(links)
    inside = longest <= _INSIDE
    circular = 2 < len(positions) <= ON_A_CIRCLE
    size = min(8.5, 1.9 * radius / (0.5 * max(2, longest))) if inside else 7.0
    for (x, y), name, face in zip(positions.tolist(), links.agents, faces, strict=True):
        out_x, out_y = (x, y) if circular else (0.0, -1.0)
        away = 0.0 if inside else radius + 2
        axes.annotate(
            name,
            (x, y),
            xytext=(away * out_x, away * out_y),
            textcoords="offset points",
            ha="center" if inside or abs(out_x) < _BESIDE else "left" if out_x > 0 else "right",
            va="center_baseline" if inside or abs(out_y) < _BESIDE else "bottom" if out_y > 0 else "top",
            fontsize=size,
            color="white" if inside and face == style.WARM else style.INK,
            zorder=4,
        )


def _legend(figure: Figure, kinds: list[str], height: float) -> None:
    handles = [
        Line2D([], [], linestyle="none", marker="o", markersize=5, markerfacecolor=face, markeredgecolor=edge,
               markeredgewidth=width)
        for face, edge, width, _ in (_KINDS[kind] for kind in kinds)
    ]  # fmt: skip
    figure.legend(
        handles,
        [_KINDS[kind][3] for kind in kinds],
        loc="upper center",
        ncols=4,
        bbox_to_anchor=(0.5, 1 - 0.04 / height),
    )
