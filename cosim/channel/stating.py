"""What can be said of a channel before it is played: its closed forms."""

from __future__ import annotations

import math

from cosim.channel.subject import Subject
from cosim.reporting.words import Rows, number
from network.impairments.loss import Loss
from network.impairments.queue import Rate
from network.profile import Profile
from network.units import format_duration, to_seconds


def stated(subject: Subject) -> Rows:
    """Losses, load and bounds that follow from the parameters."""
    model, period = subject.model, subject.period_ns
    rows: Rows = []
    if isinstance(model, Profile):
        if model.loss is not None:
            rows.append(("Losses in the long run", _losses(model.loss)))
        if model.rate is not None:
            rows.append(("A message on the link", _load(model.rate, subject)))
    bound = model.age_bound_ns(period)
    rows.append(("Least delay", format_duration(model.min_delay_ns())))
    said = "no bound: messages may be lost, or wait, for any time"
    rows.append(("Age at ticks, largest possible", said if bound is None else f"{to_seconds(bound):.6g} s"))
    return rows


def _losses(loss: Loss) -> str:
    share, burst = loss.loss_rate(), loss.mean_burst()
    if not share:
        return "none"
    runs = f"{number(burst, digits=3)} in a row on average" if math.isfinite(burst) else "without end"
    return f"{100 * share:.3g} %, {runs}"


def _load(rate: Rate, subject: Subject) -> str:
    busy = rate.transmission_ns(subject.size)
    load = busy / subject.period_ns
    text = f"{number(busy / 1e6, 'ms')} of every {format_duration(subject.period_ns)}: {100 * load:.3g} % of its time"
    if load > 1:
        queue = "messages are lost" if rate.limit is not None else "the queue grows without end"
        text += f"; more than there is, so that {queue}"
    return text
