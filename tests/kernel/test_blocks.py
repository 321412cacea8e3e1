"""Agents advanced by one call of the native loop do what they do one by one in Python: every bit, every failure."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cosim.agents.group import Agents
from cosim.errors import RunError
from cosim.plan import Integrator, Loop, Method
from fmus import build
from network.messages import Mail
from tests.distributed.networks import in_process
from tests.kernel.networks import Arms, Averagers, Network, parts

AVERAGER = Path(__file__).parents[2] / "benchmarks" / "averager"
METHODS = list(Method)
many = settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="session")
def averagers(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The FMU by FMI version."""
    return dict(enumerate(build.build_model(AVERAGER, tmp_path_factory.mktemp("averager")), start=2))


def require_same(network: Network) -> str:
    """Run it by itself in Python, and as a block; what the run ended with."""
    expected, error = in_process(network.plan([Loop.PYTHON] * len(network.loops)))
    record, same_error = in_process(network.plan(network.loops))
    assert record == expected
    assert (type(error), str(error)) == (type(same_error), str(same_error))
    return str(error or "")


@pytest.mark.parametrize("method", METHODS)
@given(data=st.data())
@many
def test_networks_that_fail_or_do_not(
    averagers: dict[int, Path], probes: dict[int, Path], method: Method, data: st.DataObject
) -> None:
    with np.errstate(all="ignore"):
        require_same(Averagers(**data.draw(parts(method)), averagers=averagers, probes=probes))


@pytest.mark.parametrize("method", METHODS)
def test_networks_of_arms(method: Method) -> None:
    network = Arms(
        edges=((0, 1), (1, 2), (2, 0), (0, 2)),
        channel="lossy",
        method=method,
        integrator=Integrator.DORMAND_PRINCE,
        failures={},
        loops=(Loop.NATIVE, Loop.PYTHON, Loop.NATIVE),
        fmi=(2, 3, 3),
        seed=3,
        ticks=3,
    )
    assert not require_same(network)


def averager_network(averagers: dict[int, Path], probes: dict[int, Path], failures: dict[int, str]) -> Averagers:
    """Four agents in a circle, all native."""
    circle = tuple((i, (i + 1) % 4) for i in range(4))
    return Averagers(
        edges=circle,
        channel="slack",
        method=Method.JOINT,
        integrator=Integrator.RK4,
        failures=failures,
        loops=(Loop.NATIVE,) * 4,
        fmi=(3, 2, 3, 3),
        seed=1,
        ticks=5,
        averagers=averagers,
        probes=probes,
    )


def test_of_several_failures_the_first_agent_counts(averagers: dict[int, Path], probes: dict[int, Path]) -> None:
    """Both fail in the first period, the later one earlier in time."""
    message = require_same(averager_network(averagers, probes, {3: "update_error", 1: "derivative_nan"}))
    assert message.startswith("agent 2, component probe, ")


def test_the_loops_mix(averagers: dict[int, Path], probes: dict[int, Path]) -> None:
    """An agent in Python that fails counts before a native one behind it, and the other way round."""
    network = averager_network(averagers, probes, {2: "derivative_nan", 1: "derivative_nan"})
    messages = set()
    for first, second in ((Loop.NATIVE, Loop.PYTHON), (Loop.PYTHON, Loop.NATIVE)):
        record, error = in_process(network.plan((Loop.NATIVE, first, second, Loop.PYTHON)))
        messages.add(f"{error} {record.ticks}")
    assert len(messages) == 1
    assert messages.pop().startswith("agent 2, component probe, ")


def test_libraries_of_their_own(averagers: dict[int, Path], probes: dict[int, Path], tmp_path: Path) -> None:
    """FMUs that can be instantiated only once per process are loaded once per agent: agents alike call other code."""
    copy = tmp_path / "once.fmu"
    with zipfile.ZipFile(averagers[3]) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                once = b'canBeInstantiatedOnlyOncePerProcess="%s"'
                assert once % b"false" in content
                content = content.replace(once % b"false", once % b"true")
            target.writestr(name, content)
    network = averager_network({2: averagers[2], 3: copy}, probes, {})
    assert not require_same(network)


def test_memory_in_any_order(averagers: dict[int, Path], probes: dict[int, Path]) -> None:
    """The kernel reads mail by address; whoever hands it over may have cut it out of something."""
    plan = averager_network(averagers, probes, {}).plan([Loop.NATIVE] * 4)
    n, width = 4, plan.layout.width
    table = np.zeros((n, 8), np.int64)
    table[:, :3] = [[k * 10_000_000, 0, 0] for k in range(n)]
    values = np.asfortranarray(np.arange(n * width, dtype=float).reshape(n, width))
    ends = np.arange(2 * n + 1)[::2] // 2
    strided = Mail(ends, table[:, 0], table[:, 1], table[:, 2], values)
    plain = Mail(ends.copy(), *(table[:, i].copy() for i in range(3)), np.ascontiguousarray(values))
    seen = set()
    for mail in (strided, plain):
        agents = Agents(plan)
        try:
            agents.initialise()
            before = agents.row()
            agents.advance(0, mail)
            assert not np.array_equal(agents.row(), before)
            seen.add(agents.row().tobytes())
        finally:
            agents.terminate()
    assert len(seen) == 1


def test_agents_that_failed_do_not_go_on(averagers: dict[int, Path], probes: dict[int, Path]) -> None:
    plan = averager_network(averagers, probes, {1: "derivative_nan"}).plan([Loop.NATIVE] * 4)
    none = np.zeros(0, np.int64)
    mail = Mail(np.zeros(5, np.int64), none, none, none, np.zeros((0, plan.layout.width)))
    agents = Agents(plan)
    try:
        agents.initialise()
        with pytest.raises(RunError, match="agent 2"):
            agents.advance(0, mail)
        with pytest.raises(ValueError, match="failed or ended"):
            agents.advance(0, mail)
    finally:
        agents.terminate()
