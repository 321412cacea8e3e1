"""The order in which values move: outputs after the inputs that feed through to them, and loops named."""

from dataclasses import replace

import numpy as np
import pytest

from cosim.agents.transfers import Direction
from cosim.agents.wiring import AlgebraicLoopError, wire
from cosim.components.component import Description, Interface, Variable
from cosim.plan import AgentPlan, ComponentPlan, Connection, Method, Port
from network.messages import MessageLayout
from tests.agents.plans import alone

DESCRIPTION = Description("M", "3.0", (Interface.MODEL_EXCHANGE,), {})


def port(component: int, name: str, causality: str, size: int = 1, feeds: tuple[str, ...] | None = ()) -> Port:
    shape = () if size == 1 else (size,)
    return Port(component, Variable(name, causality, "continuous", "Float64", shape, dependencies=feeds))


def agent(connections: list[tuple[Port, Port]], n_components: int = 2, method: Method = Method.JOINT) -> AgentPlan:
    components = (ComponentPlan(f"c{i}", None, "x:Y", DESCRIPTION, {}) for i in range(n_components))
    return alone(components, connections, method=method)


def loop(feedthrough_of_plant: tuple[str, ...] | None, method: Method = Method.JOINT) -> AgentPlan:
    """Plant (0) and controller (1) in a feedback loop; the controller's output feeds through from its input."""
    y, u_in = port(0, "y", "output", 2, feedthrough_of_plant), port(0, "u", "input")
    u, y_in = port(1, "u", "output", 1, ("y",)), port(1, "y", "input", 2)
    return agent([(u, u_in), (y, y_in)], method=method)


NO_MESSAGES = MessageLayout((), ())


def test_feedback_through_a_state_is_ordered() -> None:
    wiring = wire(loop(()), NO_MESSAGES)
    order = [(t.direction, t.component, [v.name for v in t.variables]) for t in wiring.propagate]
    assert order == [
        (Direction.GET, 0, ["y"]),
        (Direction.SET, 1, ["y"]),
        (Direction.GET, 1, ["u"]),
        (Direction.SET, 0, ["u"]),
    ]
    y, u = wiring.propagate[0].positions, wiring.propagate[2].positions
    assert np.array_equal(wiring.propagate[1].positions, y)
    assert np.array_equal(wiring.propagate[3].positions, u)
    assert sorted([*y.tolist(), *u.tolist()]) == list(range(wiring.n_signals))


@pytest.mark.parametrize("feedthrough", [("u",), None])
def test_algebraic_loop_is_named(feedthrough: tuple[str, ...] | None) -> None:
    (found,) = wire(loop(feedthrough), NO_MESSAGES).loops
    assert found.names in ("c0.y -> c1.u -> c0.y", "c1.u -> c0.y -> c1.u")
    assert [t.component for t in found.gets] == [t.component for t in found.sets] == [0, 1]


def test_algebraic_loop_of_whole_numbers_is_refused() -> None:
    plan = loop(None)
    whole = [
        Connection(replace(x.source, variable=replace(x.source.variable, dtype="Int32")), x.target)
        for x in plan.connections
    ]
    with pytest.raises(AlgebraicLoopError, match=r"an algebraic loop: c\d\.. -> .*not all of them are real numbers"):
        wire(replace(plan, connections=tuple(whole)), NO_MESSAGES)


def test_a_loop_does_not_matter_where_outputs_are_only_read_between_steps() -> None:
    assert wire(loop(None, Method.MIDPOINT), NO_MESSAGES).propagate == ()


def test_chain_of_feedthrough_is_followed_against_the_order_of_the_file() -> None:
    # c2.z feeds c1 which feeds through to c0, which feeds through to its own output
    z = port(2, "z", "output")
    y_in, y = port(1, "z", "input"), port(1, "y", "output", 1, ("z",))
    x_in, x = port(0, "y", "input"), port(0, "x", "output", 1, ("y",))
    end = port(2, "x", "input")
    wiring = wire(agent([(x, end), (y, x_in), (z, y_in)], 3), NO_MESSAGES)
    gets = [t.variables[0].name for t in wiring.propagate if t.direction is Direction.GET]
    assert gets == ["z", "y", "x"]
