"""A measured log turned into a profile, and the two beside each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.channel import measured
from cosim.channel.playing import Alone, play
from cosim.channel.subject import PERIOD, SEED, Subject, pairs
from cosim.errors import ConfigError, Location, Problem
from cosim.recording.atomic import write_atomically
from cosim.reporting import network
from cosim.reporting.edges import Edges
from cosim.reporting.words import NOTHING, Rows, number
from network.fitting.delays import DelayFit, correlation, fit_delays
from network.fitting.losses import LossFit, fit_losses
from network.impairments.distributions import TABLE_SCALE
from network.messages import NEVER, Fate, Fates, Floats
from network.netem import Netem
from network.traffic import loss_runs
from network.units import format_duration, parse_duration

MOST_TICKS = 50_000
"""Of the fitted profile that is played beside the log."""

FAR = 0.03
"""Kolmogorov's distance at which the best distribution is not good enough, and the log's own is taken."""

TABLE_ENTRIES = 4096
"""As many as iproute2's tables have."""

_SMOOTH_MESSAGES = 100_000
_MOST_EDGES = 50
_KOLMOGOROV = 1.358  # the 95 % point of the statistic's limit


@dataclass(frozen=True)
class Fitted:
    """A log, everything that was fitted to it, and the profile made of the best.

    Attributes:
        delays, losses: the best first; no losses were fitted where there were none.
        correlation: of a delay with the one before.
        model: the profile.
        distance: Kolmogorov's, between the delays of the log and the best distribution.
        table: the file with the log's own distribution, where no other is near enough.
    """

    log: measured.Log
    delays: list[DelayFit]
    losses: list[LossFit]
    correlation: float
    model: Netem
    distance: float
    table: Path | None

    @property
    def period_ns(self) -> int:
        """Of the log, or the usual one."""
        period = self.log.period
        return parse_duration(PERIOD) if period is None else max(1, round(period * 1e9))

    @cached_property
    def measured(self) -> Edges:
        """The log, as if its messages had been samples."""
        return Edges(_as_deliveries(self.log, one_way(self.log), self.period_ns))

    @cached_property
    def played(self) -> Edges:
        """The profile, played for as long as the log on one edge."""
        return Edges(play(self._subject(1)))

    @cached_property
    def smooth(self) -> Edges:
        """The same on many edges, so that chance matters less."""
        return Edges(play(self._subject(max(1, min(_MOST_EDGES, _SMOOTH_MESSAGES // len(self.log.delay))))))

    def _subject(self, edges: int) -> Subject:
        ticks = min(len(self.log.delay), MOST_TICKS)
        return Subject("fitted", "", "", self.model, pairs(edges), self.period_ns, ticks, SEED, 8)

    @property
    def allowed(self) -> float:
        """The distance that 95 % of the logs keep which the distribution itself makes."""
        return _KOLMOGOROV / math.sqrt(len(self.log.arrived))


def one_way(log: measured.Log) -> Floats:
    """(n,) seconds: the delays of the log, of round trips the half."""
    return log.delay / 2 if log.round_trip else log.delay


def fit(log: measured.Log, path: Path, folder: Path) -> Fitted:
    """The profile under which a log is most likely.

    Args:
        log: that was read.
        path: of it.
        folder: where the log's own distribution is written, if no other is near enough.

    Raises:
        ConfigError: its delays are not positive.
        OSError: the distribution cannot be written.
    """
    arrived = one_way(log)[~log.lost]
    try:
        delays = fit_delays(arrived)
    except ValueError as error:
        raise ConfigError([Problem(str(error), Location(str(path)))]) from None
    losses = fit_losses(log.lost) if log.lost.any() else []
    correlated = correlation(delays[0], arrived)
    distance, table = _distance(delays[0], arrived), None
    if distance > max(FAR, _KOLMOGOROV / math.sqrt(len(arrived))):
        table = folder / f"{path.stem}.dist"
        folder.mkdir(parents=True, exist_ok=True)
    model = _model(log, arrived, delays[0], losses, correlated, table)
    return Fitted(log, delays, losses, correlated, model, distance, table)


def _distance(fit: DelayFit, delays: Floats) -> float:
    """Of a distribution, with its steps, from that of some delays."""
    if fit.name is None:
        return 0.0
    values, counts = np.unique(delays, return_counts=True)
    share = np.cumsum(counts) / len(delays)
    before = np.concatenate(([0.0], share[:-1]))
    half = np.diff(values).min() / 2  # what was rounded to a value may lie on either side of it
    return float(np.maximum(share - fit.cdf(values + half), fit.cdf(values - half) - before).max())


def _write_table(path: Path, delays: Floats) -> tuple[float, float]:
    """A file in iproute2's format with the quantiles of some delays; its time and jitter, in seconds."""
    time = float(delays.mean())
    jitter = max(float(delays.std()), float(np.abs(delays - time).max()) / 100)
    quantiles = np.quantile(delays, (np.arange(TABLE_ENTRIES) + 0.5) / TABLE_ENTRIES)
    entries = np.rint((quantiles - time) / jitter * TABLE_SCALE).astype(np.int64).tolist()
    lines = (" ".join(map(str, entries[i : i + 8])) for i in range(0, len(entries), 8))
    write_atomically(path, f"# quantiles of {len(delays)} measured delays\n" + "\n".join(lines) + "\n")
    return time, jitter


def _model(  # noqa: PLR0917
    log: measured.Log,
    arrived: Floats,
    delay: DelayFit,
    losses: list[LossFit],
    correlated: float,
    table: Path | None,
) -> Netem:
    written: dict[str, Any] = {}
    if losses:
        best = losses[0]
        values = {name: _rounded(value) for name, value in best.values.items()}
        written["loss"] = {"random": values["random"]} if best.name == "random" else {"gemodel": values}
    if log.duplicates:
        written["duplicate"] = _rounded(log.duplicates / len(log.arrived))
    spread = float(log.arrived.max() - log.arrived.min())
    in_order = log.period is not None and not log.reordered and spread > log.period
    written["delay"] = _delay(delay, correlated, fifo=in_order)
    if table is not None:
        time, jitter = _write_table(table, arrived)
        kept = {name: value for name, value in written["delay"].items() if name in ("correlation", "fifo")}
        written["delay"] = {"time": _time(time), "jitter": _time(jitter), "table": str(table.absolute()), **kept}
    return Netem.model_validate(written)


def _delay(fit: DelayFit, correlated: float, *, fifo: bool) -> Any:
    extra = ({"correlation": _rounded(correlated, 2)} if correlated else {}) | ({"fifo": True} if fifo else {})
    if fit.name is None:
        return {"time": _time(fit.time)} | ({"fifo": True} if fifo else {})
    return {
        "time": _time(fit.time),
        "jitter": _time(fit.jitter),
        "distribution": fit.name,
        "min": _time(fit.least),
        **extra,
    }


def _time(seconds: float) -> str:
    """Five digits: no log says more."""
    return format_duration(round(float(f"{seconds * 1e9:.5g}")))


def _rounded(probability: float, digits: int = 4) -> float:
    return float(f"{probability:.{digits}g}")


def _as_deliveries(log: measured.Log, delay: Floats, period_ns: int) -> Alone:
    """What the emulator would say of messages that fared as those of the log."""
    n = len(delay)
    stamp = np.arange(n)
    lost = np.isnan(delay)
    arrival = np.where(lost, NEVER, stamp * period_ns + np.rint(np.nan_to_num(delay) * 1e9).astype(np.int64))
    fate = np.full(n, Fate.LOST, np.int64)
    order = np.flatnonzero(~lost)
    order = order[np.lexsort((order, arrival[order]))]
    before = np.concatenate(([-1], np.maximum.accumulate(order)[:-1])) if len(order) else order
    fate[order] = np.where(order > before, Fate.DELIVERED, Fate.SUPERSEDED)
    fate[arrival >= n * period_ns] = Fate.IN_FLIGHT
    zeros = np.zeros(n, np.int64)
    return Alone(log.name, pairs(1), period_ns, n, Fates(zeros, zeros + 1, stamp, stamp, arrival, fate), None)


# --- as text ----------------------------------------------------------------------------------------------------------
def summary(fitted: Fitted) -> Rows:
    """What the log is."""
    log = fitted.log
    lost = int(log.lost.sum())
    text = (
        f"{len(log.delay)}, of which {len(log.arrived)} arrived, {lost} were lost ({100 * lost / len(log.delay):.3g} %)"
    )
    text += f", {log.duplicates} came twice" if log.duplicates else ""
    rows = [("Messages", text)]
    if log.period is not None:
        rows.append(("Sent every", number(log.period, "s")))
    else:
        rows.append(("Sent every", f"unknown; {PERIOD} is taken"))
    if log.round_trip:
        rows.append(("Delays", "of round trips: each way gets half of them, and all of the losses"))
    return rows


def delay_rows(fitted: Fitted) -> list[tuple[str, ...]]:
    """Distribution, parameters, AIC and BIC less the best's; the best first."""
    best = fitted.delays[0]
    rows: list[tuple[str, ...]] = []
    for one in fitted.delays:
        time, jitter = _with_error(one.time, one.time_error), _with_error(one.jitter, one.jitter_error)
        said = f"time {time}" + ("" if one.name is None else f", jitter {jitter}")
        least_aic = min(other.aic for other in fitted.delays)
        rows.append((one.name or "fixed", said, _more(one.aic - least_aic), _more(one.bic - best.bic)))
    return rows


def loss_rows(fitted: Fitted) -> list[tuple[str, ...]]:
    """Model, parameters with their intervals, AIC and BIC less the best's; the best first."""
    rows: list[tuple[str, ...]] = []
    for one in fitted.losses:
        said = ", ".join(
            f"{name} {100 * value:.3g} %{_interval(*one.intervals[name])}" for name, value in one.values.items()
        )
        least_aic = min(other.aic for other in fitted.losses)
        rows.append((one.name, said, _more(one.aic - least_aic), _more(one.bic - fitted.losses[0].bic)))
    return rows


def _with_error(seconds: float, error: float) -> str:
    text = number(1e3 * seconds, digits=4)
    return f"{text} ms" if not math.isfinite(error) or not error else f"{text} ± {number(1e3 * error, digits=2)} ms"


def _interval(low: float, high: float) -> str:
    return f" [{100 * low:.3g}, {100 * high:.3g}]" if math.isfinite(low) and math.isfinite(high) else ""


def _more(difference: float) -> str:
    return "least" if difference == 0 else f"+{difference:.4g}"


def comparison(fitted: Fitted) -> list[tuple[str, str, str]]:
    """Each measure of the log, and of the profile."""
    ours, theirs = dict(network.measures(fitted.measured)), dict(network.measures(fitted.played))
    skipped = ("Evaluated over", "Age at ticks, largest that the channels allow (h*)", "Duplicates that arrived")
    return [
        (label, value, theirs.get(label, NOTHING)) for label, value in ours.items() if not label.startswith(skipped)
    ]


def goodness(fitted: Fitted) -> Rows:
    """Numbers for how well it fits."""
    name = fitted.delays[0].name or "fixed"
    text = f"{fitted.distance:.2g}; of logs that it made itself 95 % are within {fitted.allowed:.2g}: "
    if fitted.table is not None:
        text += f"too far; so the profile has the log's own distribution, {fitted.table.name}"
    elif fitted.distance > fitted.allowed:
        text += "they differ a little"
    else:
        text += "no difference to be seen"
    rows = [(f"Kolmogorov's distance of {name}", text)]
    if fitted.losses:
        logged, model = _runs(fitted.measured), _runs(fitted.smooth)
        rows.append(("Losses in a row, mean", f"{_mean(logged)} in the log, {_mean(model)} of the profile"))
    if fitted.correlation:
        rows.append(("Correlation of delays", f"{fitted.correlation:.2g} from one to the next: part of the profile"))
    return rows


def _runs(edges: Edges) -> Floats:
    return np.concatenate([loss_runs(log) for log in edges.logs]).astype(np.float64)


def _mean(runs: Floats) -> str:
    return number(float(runs.mean()), digits=3) if len(runs) else "0"
