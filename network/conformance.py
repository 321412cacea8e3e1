"""Does a channel model keep the rules? For people who write one of their own: in a test, or from a shell.

    from network.conformance import violations
    assert not violations(MyModel(...))

    python -m network.conformance package.module:Class '{loss: 5 %}'

A run gives the same bits in one process and in many, and an edge keeps its fate whatever else is in the network, only
if every channel keeps these rules. The model is opened on a few edges and played for some hundred ticks, again and
again under different circumstances, which must make no difference.
"""

from __future__ import annotations

import argparse
import pickle
import random
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from network.channel import Channel, ChannelModel, Setting, Transmission, invalid
from network.custom import Custom
from network.draws import Draws
from network.messages import NEVER, Ints, Links
from network.units import format_duration

EDGES = (("a", "b"), ("b", "a"), ("a", "c"), ("c", "b"), ("d", "c"), ("b", "d"))
"""Those that the model is opened on."""
_Result = TypeVar("_Result")
_SPLITS = (1, 2, 40, 3, 64, 5)


class Rule(Enum):
    """What a channel must keep to; the values are what a violation says to do."""

    WORKS = "it must serve any edges, at every tick"
    MESSAGES = "`transmit` returns equally long arrays of int64, in range; see `network.channel.Transmission`"
    BOUNDS = "`min_delay_ns` and `age_bound_ns` promise no more than every message keeps; `None` is no promise of age"
    REPEATABLE = "draw from `setting.draws` only, by edge and tick; keep no state in the class or in a module"
    TICKS = "`transmit_many` does what `transmit` does at each of the ticks, however they are divided"
    OTHER_EDGES = "keep state per edge, and use of each draw only the edge's own number"
    PICKLABLE = "keep all state in the channel, in what pickle can copy: no open files, generators or local functions"
    OWN_ARRAYS = "return new arrays at every tick, not one that is written again later"
    WRITTEN = "what a model is made from must be fields that pydantic can write and read again"


@dataclass(frozen=True)
class Violation:
    """A rule that was broken, and how it showed."""

    rule: Rule
    what: str

    def __str__(self) -> str:
        return f"{self.what}: {self.rule.value}"


def violations(
    model: ChannelModel,
    *,
    n_ticks: int = 200,
    period_ns: int = 100_000_000,
    message_bytes: int = 64,
    seed: int = 1,
    edges: Sequence[tuple[str, str]] = EDGES,
) -> list[Violation]:
    """The rules that a model breaks; none if it conforms, as far as playing it can show.

    Args:
        model: to be tried.
        n_ticks: how long it is played, each time.
        period_ns: T.
        message_bytes: length of a message.
        seed: of the draws.
        edges: (sender, receiver), two at least. A model that serves only certain edges needs others than these.
    """
    trial = _Trial(model, n_ticks, period_ns, message_bytes, seed, tuple(edges))
    state = random.getstate(), np.random.get_state()  # noqa: NPY002 - whoever uses them shall be found out
    try:
        found = [*trial.messages()]
        if not found:  # else nothing else can be compared
            for check in (trial.bounds, trial.repeatable, trial.ticks, trial.other_edges, trial.picklable):
                found += check()
        found += trial.written()
    finally:
        random.setstate(state[0])
        np.random.set_state(state[1])  # noqa: NPY002
    return found


class _RaisedError(Exception):
    """What a model's code raised, and where."""


class _Trial:
    def __init__(  # noqa: PLR0917
        self,
        model: ChannelModel,
        n_ticks: int,
        period_ns: int,
        message_bytes: int,
        seed: int,
        edges: tuple[tuple[str, str], ...],
    ) -> None:
        self._model = model
        self._n_ticks, self._period_ns, self._bytes, self._seed = n_ticks, period_ns, message_bytes, seed
        self._edges = edges
        self._sent: list[Transmission] = []  # the first play, to which all others are compared

    # --- the rules ----------------------------------------------------------------------------------------------------
    def messages(self) -> Iterator[Violation]:
        """Whether it plays at all; remembers what it sends."""
        try:
            channel = self._open(self._edges)
            returned = []
            for tick in range(self._n_ticks):
                sent = self._call(lambda: channel.transmit(tick), f"transmit({tick})")  # noqa: B023 - called at once
                wrong = invalid(sent, tick, len(self._edges), channel.history)
                if wrong:
                    yield Violation(Rule.MESSAGES, f"at tick {tick} {wrong}")
                    return
                returned.append(sent)
                self._sent.append(Transmission(*(c.copy() for c in (sent.link, sent.stamp, sent.delay_ns, sent.copy))))
        except _RaisedError as error:
            yield Violation(Rule.WORKS, str(error))
            return
        changed = [tick for tick in range(self._n_ticks) if not _same(returned[tick], self._sent[tick])]
        if changed:
            yield Violation(Rule.OWN_ARRAYS, f"what was returned at tick {changed[0]} was changed at a later tick")

    def bounds(self) -> Iterator[Violation]:
        least, most = self._model.min_delay_ns(), self._model.age_bound_ns(self._period_ns)
        if least < 0:
            yield Violation(Rule.BOUNDS, f"min_delay_ns() is {least}, less than 0")
        for tick, sent in enumerate(self._sent):
            alive = sent.delay_ns[sent.delay_ns != NEVER]
            if len(alive) and alive.min() < least:
                delay, promised = format_duration(int(alive.min())), format_duration(least)
                yield Violation(
                    Rule.BOUNDS, f"at tick {tick} a message takes {delay}, less than min_delay_ns(), {promised}"
                )
                break
        if most is not None and (age := self._largest_age_ns()) > most:
            yield Violation(
                Rule.BOUNDS,
                f"an age of {format_duration(age)} was seen, more than age_bound_ns(), {format_duration(most)}",
            )

    def repeatable(self) -> Iterator[Violation]:
        """Once more, beside a second channel with other draws, and with other global random numbers."""

        def play() -> list[Transmission]:
            channel, other = self._open(self._edges), self._open(self._edges, self._seed + 1)
            sent = []
            for tick in range(self._n_ticks):
                random.seed(tick)
                np.random.seed(tick)  # noqa: NPY002
                other.transmit(tick)
                sent.append(channel.transmit(tick))
            return sent

        yield from self._compared(Rule.REPEATABLE, play, "played again, beside another channel of the same model")

    def ticks(self) -> Iterator[Violation]:
        def play() -> list[Transmission]:
            channel, sent = self._open(self._edges), list[Transmission]()
            while len(sent) < self._n_ticks:
                n_ticks = min(_SPLITS[len(sent) % len(_SPLITS)], self._n_ticks - len(sent))
                sent += channel.transmit_many(range(len(sent), len(sent) + n_ticks)).by_tick()
            return sent

        yield from self._compared(Rule.TICKS, play, "asked for several ticks at once")

    def other_edges(self) -> Iterator[Violation]:
        """Some of the edges, in another order."""
        for kept in (range(len(self._edges) - 1, -1, -1), *([i] for i in range(len(self._edges)))):
            edges = tuple(self._edges[i] for i in kept)

            def play(edges: tuple[tuple[str, str], ...] = edges) -> list[Transmission]:
                channel = self._open(edges)
                return [channel.transmit(tick) for tick in range(self._n_ticks)]

            alone = f"{edges[0][0]} -> {edges[0][1]} served alone" if len(edges) == 1 else "the edges in another order"
            found = [*self._compared(Rule.OTHER_EDGES, play, alone, kept)]
            if found:
                yield found[0]
                return

    def picklable(self) -> Iterator[Violation]:
        """Saved half way, and gone on with."""
        half = self._n_ticks // 2

        def play() -> list[Transmission]:
            channel = self._open(self._edges)
            sent = [channel.transmit(tick) for tick in range(half)]
            copy = pickle.loads(pickle.dumps(channel))  # noqa: S301 - our own bytes
            for tick in range(half, self._n_ticks):
                channel.transmit(tick)  # which must not move the copy
            return sent + [copy.transmit(tick) for tick in range(half, self._n_ticks)]

        yield from self._compared(Rule.PICKLABLE, play, "saved and loaded half way")

    def written(self) -> Iterator[Violation]:
        try:
            again = type(self._model).model_validate(self._model.as_written())
        except Exception as error:
            yield Violation(Rule.WRITTEN, f"what as_written() gives is refused ({type(error).__name__}: {error})")
            return
        if again != self._model:
            yield Violation(Rule.WRITTEN, "what as_written() gives makes another model")

    # --- playing ------------------------------------------------------------------------------------------------------
    def _open(self, edges: Sequence[tuple[str, str]], seed: int | None = None) -> Channel:
        names = tuple(dict.fromkeys(name for edge in self._edges for name in edge))
        sender, receiver = (np.array([names.index(edge[side]) for edge in edges], np.int64) for side in (0, 1))
        slot = np.array([sum(r == edge[1] for _, r in edges[:i]) for i, edge in enumerate(edges)], np.int64)
        draws = Draws(self._seed if seed is None else seed, *([edge[side] for edge in edges] for side in (0, 1)))
        setting = Setting(Links(names, sender, receiver, slot), self._period_ns, draws, self._bytes)
        return self._call(lambda: self._model.open(setting), "open")

    @staticmethod
    def _call(what: Callable[[], _Result], name: str) -> _Result:
        try:
            return what()
        except Exception as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(frame.filename).name}, line {frame.lineno}"
            raise _RaisedError(f"{name} raised {type(error).__name__}: {error} ({place})") from error

    def _compared(
        self, rule: Rule, play: Callable[[], list[Transmission]], how: str, kept: Sequence[int] | None = None
    ) -> Iterator[Violation]:
        """The first tick at which another play differs."""
        try:
            sent = self._call(play, how)
        except _RaisedError as error:
            yield Violation(rule, str(error))
            return
        for tick, (expected, found) in enumerate(zip(self._sent, sent, strict=True)):
            if not _same(found, expected if kept is None else _of(expected, kept)):
                yield Violation(rule, f"{how}, it sends something else at tick {tick}")
                return

    def _largest_age_ns(self) -> int:
        """Read at ticks, of all edges."""
        freshest = np.zeros((self._n_ticks, len(self._edges)), np.int64)
        for tick, sent in enumerate(self._sent):
            due = -(-(tick * self._period_ns + sent.delay_ns) // self._period_ns)
            there = (sent.delay_ns != NEVER) & (due < self._n_ticks)
            np.maximum.at(freshest, (due[there], sent.link[there]), sent.stamp[there])
        ages = np.arange(self._n_ticks)[:, None] - np.maximum.accumulate(freshest, axis=0)
        return int(ages.max()) * self._period_ns


def _rows(sent: Transmission) -> Ints:
    """(n, 4), in an order of their own: a channel may list its messages as it likes."""
    rows = np.stack((sent.link, sent.copy, sent.stamp, sent.delay_ns), axis=1)
    return rows[np.lexsort(rows.T[::-1])]


def _same(one: Transmission, other: Transmission) -> bool:
    return np.array_equal(_rows(one), _rows(other))


def _of(sent: Transmission, kept: Sequence[int]) -> Transmission:
    """The messages of some edges, numbered as those are."""
    number = np.full(max(int(sent.link.max(initial=0)), *kept) + 1, -1)
    number[list(kept)] = np.arange(len(kept))
    link = number[sent.link]
    mine = link >= 0
    return Transmission(link[mine], sent.stamp[mine], sent.delay_ns[mine], sent.copy[mine])


def main(arguments: Sequence[str] | None = None) -> int:
    """Try a class; 2 if it breaks a rule."""
    import yaml

    parser = argparse.ArgumentParser(prog="python -m network.conformance", description="Does a channel keep the rules?")
    parser.add_argument("cls", metavar="CLASS", help="package.module:Class")
    parser.add_argument("options", metavar="OPTIONS", nargs="?", default="{}", help="its fields, as in a scenario")
    parser.add_argument("--ticks", type=int, default=200, help="how long it is played each time (200)")
    args = parser.parse_args(arguments)
    try:
        model = Custom.model_validate({"class": args.cls, "options": yaml.safe_load(args.options)}).served
    except ValidationError as error:
        for each in error.errors():
            print(f"error: {each['msg'].removeprefix('Value error, ')}", file=sys.stderr)
        return 2
    except yaml.YAMLError as error:
        print(f"error: the options are no YAML: {error}", file=sys.stderr)
        return 2
    found = violations(model, n_ticks=args.ticks)
    for violation in found:
        print(f"{args.cls}: {violation}")
    if not found:
        print(f"{args.cls} keeps the rules ({args.ticks} ticks, {len(EDGES)} edges)")
    return 2 if found else 0


if __name__ == "__main__":
    sys.exit(main())
