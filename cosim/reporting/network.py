"""What a report says of the network: what each controller got, how old and how often, and whether assumptions held.

The measures are defined in docs/freshness.md, whose table is in every page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.reporting.edges import Edges, Logged
from cosim.reporting.words import NOTHING, Rows, number
from cosim.scenario.names import in_short
from cosim.theory import mu, published_bound
from network.connectivity import unreached
from network.freshness import Front
from network.messages import Floats, Ints
from network.traffic import QUANTILES, loss_runs, most_losses_in, one_way_delays, times_between
from network.units import to_seconds

OPEN_ROWS = 10
"""Of a table of edges; the others are folded."""

MOST_ROWS = 1000
"""Of a table of edges, the folded ones included."""

MOST_NAMED = 8
"""Channels in a sentence."""

FIRM_K = 10
"""Of (m, k)-firmness, edge by edge."""

FIRM_KS = (5, 10, 20, 50, 100)
"""Of (m, k)-firmness, over all edges."""


@dataclass(frozen=True)
class Table:
    """A table of edges, the worst first.

    Attributes:
        columns: heads.
        rows: of text.
        left_out: edges that have no row.
    """

    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    left_out: int = 0

    @property
    def first(self) -> Sequence[tuple[str, ...]]:
        """The rows that are shown at once."""
        return self.rows[:OPEN_ROWS]

    @property
    def rest(self) -> Sequence[tuple[str, ...]]:
        """Those that are folded."""
        return self.rows[OPEN_ROWS:]


def is_told(edges: Edges) -> bool:
    """Whether there is anything to say."""
    return len(edges) > 0 and edges.results.n_ticks >= 2


# --- the whole network ------------------------------------------------------------------------------------------------
def totals(edges: Edges) -> Rows:
    """What the controllers got, and how often the network was jointly rooted."""
    return [*measures(edges), _rootedness(edges)] if is_told(edges) else []


def measures(edges: Edges) -> Rows:
    """Counts, delays, ages, and the pairs of Assumption 1, over all edges: one at least, two ticks at least."""
    traffic, ages = edges.traffic, edges.ages
    sent, delivered, superseded, lost = (
        sum(getattr(one, name) for one in traffic) for name in ("sent", "delivered", "superseded", "lost")
    )
    in_flight = sum(one.in_flight for one in traffic)
    counts = {"delivered": delivered, "superseded": superseded, "lost": lost, "in flight at the end": in_flight}
    known = delivered + superseded + lost
    seconds = to_seconds(edges.span.end_ns)
    rows = [] if edges.span.n_ticks == edges.results.n_ticks - 1 else [("Evaluated over", f"the first {seconds:g} s")]
    delays = np.concatenate([one_way_delays(log, edges.span) for log in edges.logs])
    reordered = sum(one.reordered * (one.delivered + one.superseded) for one in traffic if one.delivered)
    rows += [
        ("Messages sent", f"{sent}, per edge and tick {number(sent / (len(edges) * edges.span.n_ticks), digits=3)}"),
        ("Of these", ", ".join(f"{count} {name}" for name, count in counts.items())),
        ("Delivery ratio", _percent((delivered + superseded) / known if known else math.nan)),
        ("One-way delay", _quantiles(delays)),
        ("Losses in a row on an edge", _runs(edges)),
        (f"Most losses in any {_listed(FIRM_KS)} in a row", _listed(_firm(edges, k) for k in FIRM_KS)),
        ("Reordered", _percent(reordered / len(delays) if len(delays) else math.nan)),
        ("Duplicates that arrived", str(sum(one.duplicates for one in traffic))),
        ("Time between fresh arrivals", _quantiles(np.concatenate([times_between(log) for log in edges.logs]))),
        ("Longest time without a fresh arrival (MATI)", number(max(one.most_between for one in traffic), "s")),
        ("Oldest sample that was fresh on arrival (MAD)", number(_largest(one.most_stale for one in traffic), "s")),
        ("Age of information, mean over edges and time", number(float(np.mean([one.mean for one in ages])), "s")),
        ("Age of information, largest read at a tick", number(max(one.tick_sup for one in ages), "s")),
        ("Age of information, least upper bound over time", number(max(one.sup for one in ages), "s")),
        ("Age at ticks, largest that the channels allow (h*)", _bound(edges.results)),
    ]
    return [*rows, *_assumption(edges)]


def _runs(edges: Edges) -> str:
    runs = np.concatenate([loss_runs(log) for log in edges.logs])
    return f"mean {number(float(runs.mean()), digits=3)}, most {runs.max()}" if len(runs) else "0"


def _firm(edges: Edges, k: int) -> str:
    """The m of (m, k), or a dash where no edge sent so many messages."""
    known = [most_losses_in(log, k) for log in edges.logs if len(log.sent) >= k]
    return str(max(known)) if known else NOTHING


def _listed(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))


def _largest(values: Iterable[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=math.nan)


def _quantiles(delays: Floats) -> str:
    if not len(delays):
        return NOTHING
    names = ("median", *(f"{100 * q:g} %" for q in QUANTILES[1:]), "largest")
    values = [*np.quantile(delays, QUANTILES).tolist(), float(delays.max())]
    return ", ".join(f"{name} {number(value, 's')}" for name, value in zip(names, values, strict=True))


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if math.isfinite(share) else NOTHING


def _bound(results: Logged) -> str:
    bounds = [results.age_bound(link) for link in range(len(results.links))]
    known = [bound for bound in bounds if bound is not None]
    if len(known) == len(bounds):
        return number(max(known), "s")
    return "no bound" + (f" on {len(bounds) - len(known)} of {len(bounds)} edges" if known else "")


def _assumption(edges: Edges) -> Rows:
    """The pairs (k*, h) and the literal minimum of k*T + h: the other number that the paper calls h*."""
    label = "Assumption 1: least k*·T + h"
    if not edges.fronts_are_known:
        return [(label, "not evaluated: the log is too long")]
    period = edges.span.period_ns
    sums = [front.smallest_sum_ns(period) for front in edges.fronts]
    known = [to_seconds(one) for one in sums if one is not None]
    common = edges.common_front
    if not known or not len(common.h_ns):
        return [(label, "none: an edge delivered nothing")]
    total = common.k_star * period + common.h_ns
    best = int(np.argmin(total))
    text = number(to_seconds(int(total[best])), "s")
    if len(edges) == 1:
        rows = [(label, f"{text}, {_pair(common, best)}")]
    else:
        text += f" common to all edges, {_pair(common, best)}"
        rows = [(label, f"{text}; {number(float(np.median(known)), 's')} for the median edge")]
    if len(total) > 1:
        pairs = f"{_pair(common, -1)} to {_pair(common, 0)}"
        rows.append(("Pairs (k*, h), from least k* to least h", pairs.replace("(k*, h) = ", "")))
    return rows


def _pair(front: Front, index: int) -> str:
    k_star, h = int(front.k_star[index]), to_seconds(int(front.h_ns[index]))
    return f"(k*, h) = ({k_star}, {number(h, 's')})"


def _rootedness(edges: Edges) -> tuple[str, str]:
    """How often the update sets were jointly rooted, and when first not."""
    label = "Jointly rooted"
    if edges.assumed_h_star_ns is None:
        return label, "not evaluated: no h* is assumed"
    found = edges.connectivity
    if found is None:
        return label, "not evaluated: too many agents for the length of the run"
    label += f", in windows of {found.window} ticks"
    if not len(found.rooted):
        return label, "not evaluated: the run is shorter than a window"
    gap = found.first_gap
    if gap is None:
        return label, f"all {len(found.rooted)} windows"
    ticks = range(gap, gap + found.window)
    missed = unreached(edges.logs, edges.results.links, edges.span, ticks, edges.leaders)
    names = f"agent{'' if len(missed) == 1 else 's'} {in_short(edges.results.agents[i] for i in missed)}"
    period = edges.span.period_ns
    begin, end = to_seconds(gap * period), to_seconds((gap + found.window - 1) * period)
    gaps = int(np.count_nonzero(~found.rooted))
    return label, (
        f"{len(found.rooted) - gaps} of {len(found.rooted)} windows; the first that was not, from {begin:g} to "
        f"{end:g} s, did not reach {names}"
    )


# --- edge by edge -----------------------------------------------------------------------------------------------------
def freshness_table(edges: Edges) -> Table:
    """Per edge: how old, how often."""
    columns = ("Edge", "Channel", "Age: mean", "mean peak", "at ticks", "h* assumed", "least k*·T + h", "MATI", "MAD")
    rows = []
    for link in _shown(edges):
        age, counts, assumed = edges.ages[link], edges.traffic[link], edges.assumed[link].h_star_ns
        least = edges.fronts[link].smallest_sum_ns(edges.span.period_ns) if edges.fronts_are_known else None
        seconds = (
            *(age.mean, age.peak_mean, age.tick_sup),
            *(None if one is None else to_seconds(one) for one in (assumed, least)),
            *(counts.most_between, counts.most_stale),
        )
        rows.append((edges.name(link), edges.results.channel(link), *(number(one, "s", 3) for one in seconds)))
    return Table(columns, rows, max(0, len(edges) - MOST_ROWS))


def traffic_table(edges: Edges) -> Table:
    """Per edge: delays, losses, order."""
    columns = (
        *("Edge", "Sent", "Arrived", "Never sent", "Delay: median", "95 %", "99 %", "largest"),
        *("Losses in a row", f"in any {FIRM_K}", "Reordered", "Duplicates"),
    )
    rows = []
    for link in _shown(edges):
        one = edges.traffic[link]
        sent = (edges.name(link), str(one.sent), _percent(one.delivery_ratio), _percent(one.never_sent))
        delays = (number(delay, "s", 3) for delay in one.delay.tolist())
        losses = (str(one.losses_in_a_row), str(most_losses_in(edges.logs[link], FIRM_K)))
        rows.append((*sent, *delays, *losses, _percent(one.reordered), str(one.duplicates)))
    return Table(columns, rows, max(0, len(edges) - MOST_ROWS))


def _shown(edges: Edges) -> list[int]:
    return edges.worst_first[:MOST_ROWS]


# --- who broke what was assumed ---------------------------------------------------------------------------------------
def breaks_table(edges: Edges) -> Table | None:
    """The edges that were older at ticks than the design assumed, and when; None where nothing was assumed."""
    if all(one.h_star_ns is None for one in edges.assumed):
        return None
    broken = [link for link in edges.worst_first if len(edges.breaks[link])]
    rows = []
    for link in broken[:MOST_ROWS]:
        spans, assumed = edges.breaks[link], edges.assumed[link]
        share = int((spans[:, 1] - spans[:, 0]).sum()) / edges.span.n_ticks
        rows.append(
            (
                edges.name(link),
                edges.results.channel(link),
                f"{number(to_seconds(assumed.h_star_ns or 0), 's')}, {assumed.origin}",
                number(edges.ages[link].tick_sup, "s"),
                _percent(share),
                _times(spans, edges.span.period_ns),
            )
        )
    columns = ("Edge", "Channel", "h* assumed", "Largest age at ticks", "Too old for", "When")
    return Table(columns, rows, max(0, len(broken) - MOST_ROWS))


def broken(edges: Edges) -> str | None:
    """In a sentence, how many edges of which channels broke what was assumed; None where nothing was assumed."""
    assumed = [link for link in range(len(edges)) if edges.assumed[link].h_star_ns is not None]
    if not assumed:
        return None
    count = sum(len(edges.breaks[link]) > 0 for link in assumed)
    if not count:
        return f"kept by all {len(assumed)} edges" if len(assumed) > 1 else "kept by the edge"
    found = []
    for name, links in edges.by_channel.items():
        if too_old := sum(len(edges.breaks[link]) > 0 for link in links):
            found.append(f"{too_old} of {len(links)} with the channel {name}")
    return f"broken by {count} of {len(assumed)} edges: {', '.join(found[:MOST_NAMED])}" + (
        f" and {len(found) - MOST_NAMED} channels more" if len(found) > MOST_NAMED else ""
    )


def _times(spans: Ints, period_ns: int, limit: int = 4) -> str:
    """`10.4–14 s, 20.3 s and 3 more`: from the first tick to the last one of each; the longest."""
    longest = np.sort(np.argsort(spans[:, 0] - spans[:, 1], kind="stable")[:limit])
    text = ", ".join(
        f"{first * period_ns / 1e9:g}" + (f"–{(stop - 1) * period_ns / 1e9:g}" if stop - first > 1 else "")
        for first, stop in spans[longest].tolist()
    )
    return f"{text} s" + (f" and {len(spans) - limit} shorter times" if len(spans) > limit else "")


# --- the published condition ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Reading:
    """The published condition with one of the numbers that can be taken for h*; as text."""

    name: str
    h_star: str
    margin: str
    verdict: str


def readings(edges: Edges) -> list[Reading]:
    """μ_i > 1 + 2h* with the channels' bound, with the largest age that was read, and with the least k*T + h."""
    results = edges.results
    if not is_told(edges):
        return []
    hearing = sorted(set(results.links.receiver.tolist()))
    bounds = {}
    for i in hearing:
        k_eta, lambda_ = ((results.analysis[key] or {}).get(results.agents[i]) for key in ("k_eta", "lambda"))
        if k_eta is not None and lambda_ is not None:
            bounds[i] = published_bound(mu(k_eta, lambda_))
    if not bounds:
        return []
    allowed, observed = dict.fromkeys(hearing, 0.0), dict.fromkeys(hearing, 0.0)
    for link, receiver in enumerate(results.links.receiver.tolist()):
        bound = results.age_bound(link)
        allowed[receiver] = max(allowed[receiver], math.inf if bound is None else bound)
        observed[receiver] = max(observed[receiver], edges.ages[link].tick_sup)
    found = [
        _reading("largest age at ticks that the channels allow", allowed, bounds, results),
        _reading("largest age read at a tick in this run", observed, bounds, results),
    ]
    if edges.fronts_are_known:
        least = edges.common_front.smallest_sum_ns(edges.span.period_ns)
        every = dict.fromkeys(hearing, math.inf if least is None else to_seconds(least))
        found.append(_reading("least k*·T + h of this run, common to all edges", every, bounds, results))
    return found


def _reading(name: str, h_star: dict[int, float], bounds: dict[int, float], results: Logged) -> Reading:
    known = {i: bounds[i] - h_star[i] for i in bounds if math.isfinite(h_star[i])}
    largest = max(h_star[i] for i in bounds)
    unknown = f", cannot be evaluated for {len(bounds) - len(known)}" if len(known) < len(bounds) else ""
    if not known:
        return Reading(name, "no bound", NOTHING, "cannot be evaluated")
    tightest = min(known, key=lambda i: known[i])
    holds = sum(margin > 0 for margin in known.values())
    return Reading(
        name,
        number(largest, "s") if math.isfinite(largest) else "no bound",
        f"{number(known[tightest], 's', 3)}, agent {results.agents[tightest]}",
        f"holds for {holds} of {len(bounds)} agents{unknown}",
    )
