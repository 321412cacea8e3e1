"""The state machines of all processes over the wire format, in one thread, in every order that chance comes up with."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.distributed.assignment import Share, share_of
from cosim.errors import RunEndedError, RunError
from cosim.planning import load
from network.messages import Fate
from network.transport import WireError
from tests.distributed.loopback import Loopback
from tests.distributed.networks import Record, in_process, planned, ring, scenario, scenarios

SHIPPED = ["channel_sine", "paper_known_velocity", "paper_leaderless", "paper_leaders"]


OWNERS = st.lists(st.sampled_from(["a", "b", "c", "d"]), min_size=5, max_size=5)


def shares(owners: Sequence[str], n_agents: int) -> dict[str, Share]:
    """The agents of each owner, in any order of owners, not always next to each other."""
    owned: dict[str, list[int]] = {}
    for agent, owner in enumerate(owners[:n_agents]):
        owned.setdefault(owner, []).append(agent)
    return {owner: share_of(agents) for owner, agents in sorted(owned.items())}


@settings(deadline=None, max_examples=40)
@given(text=scenarios(), owners=OWNERS, seed=st.integers(0, 2**31))
def test_any_small_network_in_any_order_gives_what_the_in_process_run_gives(
    text: str, owners: Sequence[str], seed: int
) -> None:
    plan = planned(text)
    expected, _ = in_process(plan)
    record = Record()
    Loopback(plan, shares(owners, len(plan.agents)), [record], random.Random(seed)).run()
    assert record == expected


@settings(deadline=None, max_examples=60)
@given(
    text=scenarios(on_worker_loss="restart"),
    n_workers=st.integers(1, 4),
    losses=st.integers(1, 3),
    seed=st.integers(0, 2**31),
)
def test_any_small_network_survives_the_loss_of_any_worker_at_any_moment(
    text: str, n_workers: int, losses: int, seed: int
) -> None:
    plan = planned(text)
    expected, _ = in_process(plan)
    record = Record()
    Loopback(plan, n_workers, [record], random.Random(seed), losses=losses).run()
    assert record == expected


@pytest.mark.parametrize("n_workers", [1, 2, 10])
@pytest.mark.parametrize("config", SHIPPED)
def test_shipped_scenario(config: str, n_workers: int) -> None:
    plan = load(config, until="1 s").plan
    expected, _ = in_process(plan)
    record = Record()
    Loopback(plan, n_workers, [record], random.Random(1)).run()
    assert record == expected


@settings(deadline=None, max_examples=20)
@given(
    agents=st.lists(st.tuples(st.integers(1, 5), st.integers(0, 9)), min_size=1, max_size=3),
    channel=st.sampled_from(["ideal", "slack", "late"]),
    owners=OWNERS,
    seed=st.integers(0, 2**31),
)
def test_of_several_failures_it_is_the_first_that_ends_the_run(
    agents: Sequence[tuple[int, int]], channel: str, owners: Sequence[str], seed: int
) -> None:
    faults = {agent: ("Failing", tick / 10 + 0.05) for agent, tick in agents}
    plan = planned(scenario(5, ring(5), channel, faults=faults))
    expected, failure = in_process(plan)
    assert isinstance(failure, RunError)
    record = Record()
    with pytest.raises(RunError) as caught:
        Loopback(plan, shares(owners, 5), [record], random.Random(seed)).run()
    assert str(caught.value) == str(failure)
    assert "the gearbox is broken" in str(failure)
    assert record == expected


@settings(deadline=None, max_examples=30)
@given(
    agents=st.dictionaries(
        st.integers(1, 5), st.tuples(st.sampled_from(["Ending", "Ending", "Failing"]), st.integers(0, 9)), min_size=1
    ),
    channel=st.sampled_from(["ideal", "slack", "late", "window"]),
    owners=OWNERS,
    seed=st.integers(0, 2**31),
)
def test_a_regular_end_is_the_same_everywhere_and_says_what_is_under_way(
    agents: dict[int, tuple[str, int]], channel: str, owners: Sequence[str], seed: int
) -> None:
    faults = {agent: (kind, tick / 10 + 0.05) for agent, (kind, tick) in agents.items()}
    first = min((tick, agent) for agent, (_, tick) in agents.items())
    plan = planned(scenario(5, ring(5), channel, faults=faults))
    expected, ended = in_process(plan)
    regular = agents[first[1]][0] == "Ending"
    assert isinstance(ended, RunEndedError) is regular
    record = Record()
    with pytest.raises(RunError) as caught:
        Loopback(plan, shares(owners, 5), [record], random.Random(seed)).run()
    assert (type(caught.value), str(caught.value)) == (type(ended), str(ended))
    assert record == expected
    assert len(expected.ticks) == first[0] + 1
    under_way = expected.calls[-2:] == ["fates", "fates"]
    assert under_way is regular
    if regular and channel == "late":  # nothing arrives in the tick in which it leaves
        assert set(expected.fates_of[-1]["fate"]) == {Fate.IN_FLIGHT}


def test_failure_before_the_first_tick() -> None:
    plan = planned(scenario(3, ring(3), faults={2: ("Failing", 0.0), 3: ("Failing", 0.0)}))
    expected, failure = in_process(plan)
    record = Record()
    with pytest.raises(RunError) as caught:
        Loopback(plan, 3, [record], random.Random(1)).run()
    assert str(caught.value) == str(failure)
    assert record == expected


@settings(deadline=None, max_examples=25)
@given(nth=st.integers(0, 60), harm=st.sampled_from(["lost", "twice", "damaged"]), seed=st.integers(0, 2**31))
def test_harm_on_the_wire_is_noticed_or_of_no_consequence(nth: int, harm: str, seed: int) -> None:
    """Never another result: the run ends with an error, hangs (the deadline's business), or is what it should be."""
    plan = planned(scenario(4, ring(4)))
    expected, _ = in_process(plan)
    count = 0

    def tamper(_sender: str, _receiver: str, frame: bytes) -> Sequence[bytes]:
        nonlocal count
        count += 1
        if count != nth + 1:
            return [frame]
        damaged = bytearray(frame)
        damaged[seed % len(frame)] ^= 1 << seed % 8
        return {"lost": [], "twice": [frame, frame], "damaged": [bytes(damaged)]}[harm]

    record = Record()
    try:
        Loopback(plan, 2, [record], random.Random(seed), tamper).run()
    except (WireError, AssertionError):
        assert record.ticks == expected.ticks[: len(record.ticks)]
        assert record.fates_of == expected.fates_of[: len(record.fates_of)]
    else:
        assert record == expected
