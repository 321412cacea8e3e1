"""`cosim channel`: what it prints and draws."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.channel import subject as subjects
from cosim.channel.playing import play
from cosim.channel.stating import stated
from cosim.channel.subject import Subject, Wanted
from cosim.errors import ConfigError, Problem
from cosim.recording.atomic import write_atomically
from cosim.recording.manifest import command_line, folder_problem, versions
from cosim.reporting import network, page
from cosim.reporting.edges import Edges
from cosim.reporting.words import Rows
from cosim.running.stopping import StopRequest
from cosim.scenario.source import dump, dump_on_one_line
from network.units import format_duration

if TYPE_CHECKING:
    from cosim.channel.fit import Fitted

PAGE = "channel.html"
FOLDER = Path("runs") / "channels"


def main(args: argparse.Namespace) -> int:
    """Play a profile, fit one, list them or explain a parameter, as `args` say; the exit code.

    Raises:
        ConfigError: everything that is wrong.
    """
    if args.list:
        return _list()
    if args.explain is not None:
        return _explain(args.explain)
    if args.fit is not None:
        return _fit(args)
    if args.profile is None:
        raise ConfigError([Problem("name a profile, such as wifi_busy; cosim channel --list shows them")])
    stop = StopRequest()
    with stop.listening():
        wanted = Wanted(args.ticks, args.edges, args.period, args.seed, args.size)
        subject = subjects.find(args.profile, wanted)
        edges = Edges(play(subject))
        _print_table(subject, edges)
        if not args.report:
            return 0
        drawn = draw(subject, edges, args.out or FOLDER / subject.name, stop)
    if drawn is None:
        return stop.exit_code
    print(f"\n{drawn}")
    return 0


def _list() -> int:
    from cosim.scenario import profiles

    names = profiles.names()
    width = max(map(len, names))
    for name in names:
        profile = profiles.load(profiles.find(name, Path()))
        print(f"{name:{width}}  {profile.title}")
    return 0


def _explain(term: str) -> int:
    from cosim.channel import explaining

    if not term:
        print("\n".join(explaining.entries()))
        return 0
    shown = [f"{entry.text}\n\n{explaining.page()}:{entry.line}" for entry in explaining.explain(term)]
    print("\n\n".join(shown))
    return 0


def _fit(args: argparse.Namespace) -> int:
    from cosim.channel import fit, measured

    if args.profile is not None:
        raise ConfigError([Problem("give a PROFILE to play, or a log to --fit, not both")])
    path = args.fit
    stop = StopRequest()
    with stop.listening():
        log = measured.read(path, round_trip=args.round_trip)
        folder = args.out or FOLDER / path.stem
        profile = folder / f"{path.stem}.yaml"
        try:
            fitted = fit.fit(log, path, folder)
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(profile, _profile_text(path, fitted))
        except OSError as error:
            raise folder_problem(Path(error.filename or folder), f"cannot be written: {error.strerror}") from None
        _print_fit(path, fitted)
        drawn = _draw_fit(path, fitted, folder, stop) if args.report else profile
    if drawn is None:
        return stop.exit_code
    print(f"\n{profile}" + (f"\n{drawn}" if args.report else ""))
    return 0


# --- a table for the terminal -----------------------------------------------------------------------------------------
def _print_table(subject: Subject, edges: Edges) -> None:
    print(f"{subject.name}{f': {subject.title}' if subject.title else ''}")
    got = network.measures(edges)
    for line in sections((("", _setting(subject)), ("As stated", stated(subject)), ("What a controller gets", got))):
        print(line)


def sections(parts: Iterable[tuple[str, Rows]]) -> Iterator[str]:
    """Lines of tables with their headings; all have their values in one column."""
    parts = list(parts)
    width = max(len(label) for _, rows in parts for label, _ in rows)
    for heading, rows in parts:
        if heading:
            yield f"\n{heading}"
        yield from (f"  {label:{width}}  {value}" for label, value in rows)


def _setting(subject: Subject) -> Rows:
    n = len(subject.links)
    played = f"{subject.n_ticks} ticks of {format_duration(subject.period_ns)} on {n} edge{'' if n == 1 else 's'}"
    return [
        ("Channel", dump_on_one_line(subject.model.as_written())),
        ("Played", f"{played}, seed {subject.seed}, messages of {subject.size} B"),
    ]


def _print_fit(path: Path, fitted: Fitted) -> None:
    from cosim.channel import fit

    losses = [(name, f"{said}; AIC {aic}, BIC {bic}") for name, said, aic, bic in fit.loss_rows(fitted)]
    delays = [(name, f"{said}; AIC {aic}, BIC {bic}") for name, said, aic, bic in fit.delay_rows(fitted)]
    parts = [("Delays, by maximum likelihood", delays), ("How well it fits", fit.goodness(fitted))]
    if losses:
        parts.insert(0, ("Losses, by maximum likelihood", losses))
    channel = [("Channel", dump_on_one_line(fitted.model.as_written()))]
    print(path.name)
    for line in sections((("", fit.summary(fitted)), *parts, ("The profile", channel))):
        print(line)


# --- a page -----------------------------------------------------------------------------------------------------------
def draw(subject: Subject, edges: Edges, folder: Path, stop_requested: StopRequest) -> Path | None:
    """The page and its figures; None if it was stopped before they were there.

    Raises:
        ConfigError: the folder cannot be written.
    """
    from cosim.reporting.figures import CHANNEL, HEAT

    entries = (*CHANNEL, HEAT) if len(edges) > 1 else CHANNEL
    return page.write(
        folder / PAGE,
        "channel.html.jinja",
        entries,
        edges,
        lambda: _facts(subject, edges),
        stop_requested=stop_requested,
    )


def _profile_text(path: Path, fitted: Fitted) -> str:
    """A profile's file."""
    log = fitted.log
    source = f"Fitted by maximum likelihood to {path.name}: {len(log.delay)} messages"
    source += ", round trips, each way half of the delay and all of the losses" if log.round_trip else ""
    channel = fitted.model.as_written()
    if fitted.table is not None:
        channel["delay"]["table"] = fitted.table.name  # beside the profile
    return dump({"title": path.stem, "source": f"{source}.", "channel": channel})


def _draw_fit(path: Path, fitted: Fitted, folder: Path, stop_requested: StopRequest) -> Path | None:
    from cosim.channel import fit
    from cosim.reporting.figures import FITTED

    def facts() -> dict[str, Any]:
        return {
            "title": f"{path.name}, and a profile that fits",
            "profile": _profile_text(path, fitted),
            "summary": fit.summary(fitted),
            "goodness": fit.goodness(fitted),
            "delays": fit.delay_rows(fitted),
            "losses": fit.loss_rows(fitted),
            "comparison": fit.comparison(fitted),
            "provenance": _provenance(),
        }

    return page.write(folder / "fit.html", "fit.html.jinja", FITTED, fitted, facts, stop_requested=stop_requested)


def _facts(subject: Subject, edges: Edges) -> dict[str, Any]:
    several = len(edges) > 1
    return {
        "title": subject.title or subject.name,
        "name": subject.name,
        "source": subject.source,
        "profile": dump({"channel": subject.model.as_written()}),
        "setting": _setting(subject)[1:],
        "stated": stated(subject),
        "measures": network.measures(edges),
        "freshness": network.freshness_table(edges) if several else None,
        "traffic": network.traffic_table(edges) if several else None,
        "provenance": _provenance(),
    }


def _provenance() -> Rows:
    return [
        ("Command", " ".join(command_line())),
        ("Versions", ", ".join(f"{name} {version}" for name, version in versions().items())),
    ]
