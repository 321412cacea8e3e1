"""Losses: independent or correlated, netem's four-state Markov chain, and the Gilbert-Elliott model.

The chains are netem's (Salsano, Ludovici, Ordine, Giannuzzi: "Definition of a general and intuitive loss model for
packet networks and its implementation in the Netem module in the Linux kernel", 2012), with its defaults, but begin in
their stationary distribution instead of the good state, so that the stated rates hold from the first message on.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from network.channel import Batch, Setting, Transmission
from network.impairments.impairment import (
    Impairment,
    Stage,
    Stepwise,
    Sticky,
    schema_of,
    under_way,
    under_way_in,
    uniform,
    uniforms,
)
from network.messages import NEVER, Floats, Ints
from network.units import Probability, parse_probability


def _in_order(names: tuple[str, ...]) -> BeforeValidator:
    """As tc has it: the numbers alone, in their order."""

    def named(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            if not 0 < len(value) <= len(names):
                raise ValueError(f"write one to {len(names)} probabilities, in the order {', '.join(names)}")
            return dict(zip(names, value, strict=False))
        return {names[0]: value} if isinstance(value, (int, float, str)) else value

    return BeforeValidator(named)


class FourState(Impairment):
    """tc's `loss state p13 [p31 [p32 [p23 [p14]]]]`.

    States: 1 received in a gap, 2 received within a burst, 3 lost within a burst, 4 lost alone. pij is the probability
    of going from i to j from one message to the next; state 4 always returns to 1.
    """

    short_form = schema_of(Probability | list[Probability])
    short_field = "p13"
    p13: Probability = Field(description="a burst of losses begins")
    p31: Probability | None = Field(None, description="it ends; 1 - p13 by default")
    p32: Probability = Field(0.0, description="within a burst, messages begin to get through")
    p23: Probability = Field(1.0, description="within a burst, they stop getting through")
    p14: Probability = Field(0.0, description="a single message is lost outside bursts")

    @model_validator(mode="after")
    def _possible(self) -> FourState:
        if self.p13 + self.p14 > 1:
            raise ValueError(f"p13 + p14 is {self.p13 + self.p14:g}: what leaves state 1 cannot exceed 1")
        if self.end_of_burst + self.p32 > 1:
            raise ValueError(f"p31 + p32 is {self.end_of_burst + self.p32:g}: what leaves state 3 cannot exceed 1")
        if self.loss_rate() >= 1:
            raise ValueError("with p31 and p32 both 0 a burst never ends: nothing would arrive")
        return self

    @property
    def end_of_burst(self) -> float:
        """p31 with its default."""
        return 1 - self.p13 if self.p31 is None else self.p31

    def stationary(self) -> Floats:
        """(4,) share of messages in states 1, 2, 3, 4."""
        if self.p13 == 0:
            one, two, three = 1.0, 0.0, 0.0
        else:
            # Balance of state 2: π3 p32 = π2 p23; of {2, 3} against 1: π1 p13 = π3 p31.
            one, three = self.end_of_burst / self.p13, 1.0
            if self.p32 == 0:
                two = 0.0
            elif self.p23 == 0:  # once there, for good
                one, two, three = 0.0, 1.0, 0.0
            else:
                two = self.p32 / self.p23
        shares = np.array([one, two, three, one * self.p14])
        return np.asarray(shares / shares.sum(), np.float64)

    def loss_rate(self) -> float:
        """Long-run share of messages that are lost."""
        return float(self.stationary()[2:].sum())

    def mean_burst(self) -> float:
        """Mean number of losses in a row, NaN where nothing is lost: P(lost) / P(lost, next received)."""
        shares = self.stationary()
        ends = shares[2] * (self.end_of_burst + self.p32) + shares[3]
        return float(shares[2:].sum() / ends) if ends else float("nan")

    def open(self, setting: Setting) -> Stage:
        return _FourState(self, setting)

    def max_delay_ns(self) -> int | None:
        return 0 if self.loss_rate() == 0 else None


class GilbertElliott(Impairment):
    """tc's `loss gemodel p [r [1-h [1-k]]]`: a good and a bad state, with losses in each."""

    short_form = schema_of(Probability | list[Probability])
    short_field = "p"
    p: Probability = Field(description="from good to bad, from one message to the next")
    r: Probability | None = Field(None, description="from bad to good; 1 - p by default")
    bad: Probability = Field(1.0, alias="1-h", description="losses in the bad state")
    good: Probability = Field(0.0, alias="1-k", description="losses in the good state")

    @model_validator(mode="after")
    def _possible(self) -> GilbertElliott:
        if self.loss_rate() >= 1:
            raise ValueError("r is 0 and every message is lost in the bad state: nothing would arrive")
        return self

    @property
    def recovery(self) -> float:
        """R with its default."""
        return 1 - self.p if self.r is None else self.r

    def share_of_bad(self) -> float:
        """Long-run share of messages that meet the bad state."""
        leaving = self.p + self.recovery
        return self.p / leaving if leaving else 0.0

    def loss_rate(self) -> float:
        """Long-run share of messages that are lost."""
        share = self.share_of_bad()
        return share * self.bad + (1 - share) * self.good

    def mean_burst(self) -> float:
        """Mean number of losses in a row, infinity where losses never end.

        P(lost) / P(lost, next received), from the two-state chain of consecutive messages.
        """
        share, p, r = self.share_of_bad(), self.p, self.recovery
        ends = share * self.bad * (r * (1 - self.good) + (1 - r) * (1 - self.bad))
        ends += (1 - share) * self.good * (p * (1 - self.bad) + (1 - p) * (1 - self.good))
        return self.loss_rate() / ends if ends else float("inf")

    def open(self, setting: Setting) -> Stage:
        return _GilbertElliott(self, setting)

    def max_delay_ns(self) -> int | None:
        return 0 if self.loss_rate() == 0 else None


class Loss(Impairment):
    """`2 %`, or one of tc's three: `random`, `state` or `gemodel`."""

    short_form = schema_of(Probability)
    short_field = "random"
    from_short = parse_probability

    random: Probability | None = Field(None, description="every message with this probability")
    correlation: Probability = Field(0.0, description="of `random`, from one message to the next; the rate stays")
    state: Annotated[FourState, _in_order(("p13", "p31", "p32", "p23", "p14"))] | None = None
    gemodel: Annotated[GilbertElliott, _in_order(("p", "r", "1-h", "1-k"))] | None = None

    @model_validator(mode="after")
    def _one(self) -> Loss:
        if sum(model is not None for model in (self.random, self.state, self.gemodel)) != 1:
            raise ValueError("give one of `random`, `state` and `gemodel`, such as {random: 2 %}")
        if self.correlation and self.random is None:
            raise ValueError("`correlation` is for `random`; `state` and `gemodel` have their own")
        return self

    def loss_rate(self) -> float:
        """Long-run share of messages that are lost."""
        model = self.state or self.gemodel
        return model.loss_rate() if model is not None else self.random or 0.0

    def mean_burst(self) -> float:
        """Mean number of losses in a row, infinity where they never end, NaN where there are none."""
        model = self.state or self.gemodel
        if model is not None:
            return model.mean_burst() if model.loss_rate() else float("nan")
        goes_on = self.correlation + (1 - self.correlation) * (self.random or 0.0)
        return 1 / (1 - goes_on) if goes_on < 1 else float("inf")

    def open(self, setting: Setting) -> Stage:
        model = self.state or self.gemodel
        if model is not None:
            return model.open(setting)
        if self.correlation:
            return _Correlated(self.random or 0.0, self.correlation, setting)
        return _Random(self.random or 0.0, setting)

    def max_delay_ns(self) -> int | None:
        return 0 if self.loss_rate() == 0 else None


class _Random(Stage):
    def __init__(self, rate: float, setting: Setting) -> None:
        self._rate = rate
        self._draws = setting.draws

    def apply(self, batch: Batch) -> Batch:
        delay = batch.delay_ns.copy()
        for copy, which in under_way_in(batch):
            lost = uniforms(self._draws, "loss", batch, copy, which) < self._rate
            delay[which] = np.where(lost, NEVER, delay[which])
        return batch.with_delay(delay)


class _Losses(Stepwise):
    """Loses messages one copy after the other."""

    def step(self, tick: int, messages: Transmission) -> Transmission:
        delay = messages.delay_ns.copy()
        for copy, index in under_way(messages):
            delay[index[self._lost(tick, copy, messages.link[index])]] = NEVER
        return messages.with_delay(delay)

    @abstractmethod
    def _lost(self, tick: int, copy: int, link: Ints) -> NDArray[np.bool_]:
        """Which of the next messages, one each of the edges `link`, are lost."""


class _Correlated(_Losses):
    def __init__(self, rate: float, correlation: float, setting: Setting) -> None:
        self._rate = rate
        self._numbers = Sticky(setting, "loss", correlation)

    def _lost(self, tick: int, copy: int, link: Ints) -> NDArray[np.bool_]:
        return self._numbers.next(tick, copy, link) < self._rate


class _FourState(_Losses):
    def __init__(self, model: FourState, setting: Setting) -> None:
        # What follows each state, as a partition of [0, 1): rows of thresholds, and the state below each.
        out3 = (model.p32, model.p32 + model.end_of_burst)
        self._threshold = np.array([[model.p14, model.p14 + model.p13], [0.0, model.p23], out3, [0.0, 0.0]])
        self._next = np.array([[3, 2, 0], [2, 2, 1], [1, 0, 2], [0, 0, 0]])
        start = np.cumsum(model.stationary())[:-1]
        self._state = np.searchsorted(start, setting.draws.uniform("loss start", 0), side="right")
        self._draws = setting.draws

    def _lost(self, tick: int, copy: int, link: Ints) -> NDArray[np.bool_]:
        number = uniform(self._draws, "loss", tick, copy)[link]
        state = self._state[link]
        bounds = self._threshold[state]
        which = (number >= bounds[:, 0]).astype(np.int64) + (number >= bounds[:, 1])
        after = self._next[state, which]
        self._state[link] = after
        return np.asarray(after >= 2)


class _GilbertElliott(_Losses):
    def __init__(self, model: GilbertElliott, setting: Setting) -> None:
        self._leave = np.array([model.p, model.recovery])
        self._loss = np.array([model.good, model.bad])
        self._bad = setting.draws.uniform("loss start", 0) < model.share_of_bad()
        self._draws = setting.draws

    def apply(self, batch: Batch) -> Batch:
        if not batch.whole:
            return super().apply(batch)
        table = (len(batch.ticks), len(self._bad))
        alive = batch.delay_ns.reshape(table) != NEVER
        bad = self._states(batch.ticks, alive)
        lost = alive & (self._draws.uniforms("loss", batch.ticks) < np.where(bad, self._loss[1], self._loss[0]))
        return batch.with_delay(np.where(lost.reshape(-1), NEVER, batch.delay_ns))

    def _states(self, ticks: range, alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(ticks, edges) whether each message meets the bad state."""
        number = self._draws.uniforms("loss state", ticks)
        p, r = self._leave.tolist()
        # A number below both probabilities changes either state; one between them only that which is easier to leave.
        swaps = alive & (number < min(p, r))
        stays = ~alive | (number >= max(p, r)) | swaps
        bad = np.empty_like(alive)
        state = self._bad
        for row in range(len(ticks)):
            bad[row] = state
            state = state ^ swaps[row]
            state = state | ~stays[row] if p > r else state & stays[row]
        self._bad = state
        return bad

    def _lost(self, tick: int, copy: int, link: Ints) -> NDArray[np.bool_]:
        bad = self._bad[link].astype(np.int64)
        leaves = uniform(self._draws, "loss state", tick, copy)[link] < self._leave[bad]
        self._bad[link] ^= leaves
        return np.asarray(uniform(self._draws, "loss", tick, copy)[link] < self._loss[bad])
