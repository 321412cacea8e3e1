"""How late the ticks of a paced run were, over time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cosim.reporting.figures import style
from cosim.reporting.figures.scene import NotDrawn, Scene


def draw_lateness(scene: Scene) -> tuple[Figure, str]:
    """Mean and largest lateness over simulated time, with the deadline if it is near."""
    account = scene.results.realtime
    assert account is not None  # asked for only where a run is paced
    course = account["course_s"]
    every, mean, largest = int(course["ticks_per_point"]), *(1e3 * np.array(course[key]) for key in ("mean", "max"))
    if len(mean) < 2:
        raise NotDrawn("The run ended before its second tick.")
    time = np.arange(len(mean)) * every * scene.results.period_ns / 1e9
    deadline = 1e3 * account["period_s"]
    labels = ["lateness"] if every == 1 else ["largest lateness", "mean lateness"]
    near = float(largest.max()) > deadline / 5
    if near:
        labels.append("deadline")
    figure, (axes,) = style.panels(1, 1.3, lines=1)
    handles = axes.plot(time, largest, color=style.ACCENT, linewidth=0.7)
    if every > 1:
        handles += axes.plot(time, mean, color=style.WARM, linewidth=0.7)
    if near:
        handles.append(axes.axhline(deadline, color=style.INK, linewidth=0.8, linestyle=(0, (4, 2))))
    style.legend(figure, handles, labels)
    style.time_axis(axes, 0.0, float(time[-1]))
    axes.set_xlabel("simulated time (s)", labelpad=2)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("lateness (ms)")
    text = "From the release of a tick until it was complete, in wall time"
    text += "." if every == 1 else f"; each point is {every} ticks."
    if not near:
        text += f" The deadline, {deadline:.4g} ms after the release, is far above."
    return figure, text
