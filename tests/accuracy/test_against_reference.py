"""Runs of `cosim run` against the exact solution, driven by each run's own deliveries and start values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.accuracy.runs import CONTROLLER, completed, cosim_run, position_error, same_network
from tests.reference.network_ode import DivergedError, Log, Solution, solve
from tests.reference.run_folder import RunFolder

Case = tuple[RunFolder, Solution]


@pytest.fixture(scope="session")
def leaders(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """`paper_leaders` as shipped, 60 s, and its exact solution."""
    run = completed("paper_leaders", tmp_path_factory.mktemp("runs") / "leaders")
    return run, run.solve()


@pytest.fixture(scope="session")
def leaderless(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """`paper_leaderless` as shipped, 60 s, and its exact solution."""
    run = completed("paper_leaderless", tmp_path_factory.mktemp("runs") / "leaderless")
    return run, run.solve()


@pytest.fixture(params=["leaders", "leaderless"])
def shipped(request: pytest.FixtureRequest) -> Case:
    case: Case = request.getfixturevalue(request.param)
    return case


def assert_close(run: RunFolder, exact: Solution, bounds: dict[str, float]) -> None:
    """Every agent at every tick, variable by variable."""
    for variable, bound in bounds.items():
        expected = getattr(exact, variable.split(".")[1])
        recorded = run.recorded(variable, expected.shape[2])
        heard = ~np.isnan(expected)  # psi of an agent without in-neighbours is not defined
        error = float(np.abs(recorded - expected)[heard].max())
        assert error <= bound, f"{variable}: {error:.2e}, at most {bound:.0e}"


def test_shipped_scenarios_run_60_s_over_the_papers_channel(shipped: Case) -> None:
    run, exact = shipped
    assert run.ticks == 600
    assert run.recorded("plant.p").shape == exact.p.shape == (601, 10, 2)
    assert len(run.log.stamp) > 5000


def test_joint_at_5_ms_is_within_1e_6_rad_of_the_exact_solution(shipped: Case) -> None:
    """3.1e-8 rad was measured; the estimates take part in no integration and agree to rounding."""
    run, exact = shipped
    bounds = {
        "plant.p": 1e-6,
        "plant.v": 1e-5,
        "controller.u": 1e-4,
        "controller.theta_hat": 1e-5,
        "controller.v_hat": 1e-14,
    }
    assert_close(run, exact, bounds)


def test_settled_by_40_s(shipped: Case) -> None:
    run, _ = shipped
    p, v, v_hat = (run.recorded(name)[400:] for name in ("plant.p", "plant.v", "controller.v_hat"))
    leader = [agent.v_d for agent in run.agents if agent.role.value == "leader"]
    final = np.array(leader[0]) if leader else v_hat[-1].mean(axis=0)
    assert np.abs(v_hat - final).max() < 1e-6
    assert np.abs(v - final).max() < 1e-2
    assert np.abs(p - p[:, :1]).max() < 1e-2


def test_midpoint_at_1_ms_is_within_2e_5_rad_over_60_s(leaders: Case, tmp_path: Path) -> None:
    base, exact = leaders
    run = completed("paper_leaders", tmp_path / "run", "coupling.method=midpoint", "coupling.step=1 ms")
    assert same_network(run, base)
    assert position_error(run, exact) <= 2e-5


@pytest.mark.parametrize(
    ("method", "steps", "order"),
    [
        ("joint", ("2.5 ms", "1.25 ms"), 4),
        ("midpoint", ("1 ms", "500 us"), 2),
        ("gauss-seidel", ("1 ms", "500 us"), 1),
        ("jacobi", ("1 ms", "500 us"), 1),
    ],
)
def test_order_of_convergence(method: str, steps: tuple[str, str], order: int, leaders: Case, tmp_path: Path) -> None:
    base, exact = leaders
    errors = []
    for i, step in enumerate(steps):
        changes = f"coupling.method={method}", f"coupling.step={step}"
        run = completed("paper_leaders", tmp_path / f"run{i}", *changes, until="5 s")
        assert same_network(run, base)
        errors.append(position_error(run, exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1 * order)


def test_dormand_prince_is_within_1e_8_rad(leaders: Case, tmp_path: Path) -> None:
    _, exact = leaders
    run = completed("paper_leaders", tmp_path / "run", "coupling.integrator=dormand-prince", until="10 s")
    assert position_error(run, exact) <= 1e-8


def test_every_option_of_the_law_and_every_kind_of_delay(tmp_path: Path) -> None:
    """Unequal arms, gains, weights; both FMI versions; all roles and extrapolations; no delay, overtaking, losses."""
    run = completed(str(Path(__file__).with_name("varied.yaml")), tmp_path / "run")
    states = ("p", "v"), ("v_hat", "v_bar", "v_bar_dot", "eta", "psi", "theta_hat", "v_r", "e")
    bounds = {f"plant.{name}": 1e-7 for name in states[0]} | {f"controller.{name}": 1e-7 for name in states[1]}
    exact = run.solve()
    assert_close(run, exact, bounds | {"controller.u": 1e-6})
    assert np.abs(exact.p).max() > 1.0


def test_every_option_of_the_law_on_axes(tmp_path: Path) -> None:
    """The same scheme on springs, pendulums and pucks, one of them mapped and one in FMI 2.0."""
    run = completed(str(Path(__file__).with_name("axes.yaml")), tmp_path / "run")
    exact = run.solve()
    bounds = {"plant.p": 1e-8, "plant.v": 1e-7, "controller.u": 1e-6}
    states = ("v_hat", "v_bar", "v_bar_dot", "eta", "psi", "v_r", "e")
    assert_close(run, exact, bounds | {f"controller.{name}": 1e-7 for name in states})
    estimates = run.recorded("controller.theta_hat", 2, 5)
    np.testing.assert_allclose(estimates, exact.axes_theta_hat, rtol=0, atol=1e-7)


def test_mixed_plants_in_one_network(tmp_path: Path) -> None:
    """Arms, carts behind a mapping with gains, pendulums and a puck; 4e-8 rad was measured."""
    run = completed("mixed_plants", tmp_path / "run", until="15 s")
    exact = run.solve()
    assert_close(run, exact, {"plant.p": 1e-6, "plant.v": 1e-5, "controller.u": 1e-4, "controller.v_hat": 1e-14})
    arms, others = slice(0, 2), slice(2, None)
    arm_estimates = run.recorded("controller.theta_hat", 5)[:, arms]
    np.testing.assert_allclose(arm_estimates, exact.theta_hat[:, arms], rtol=0, atol=1e-5)
    estimates = run.recorded("controller.theta_hat", 2, 5)[:, others]
    np.testing.assert_allclose(estimates, exact.axes_theta_hat[:, others], rtol=0, atol=1e-5)
    assert np.abs(exact.axes_theta_hat[-1, others]).max() > 0.1


def test_mixed_plants_agree(tmp_path: Path) -> None:
    run = completed("mixed_plants", tmp_path / "run")
    p, v = run.recorded("plant.p"), run.recorded("plant.v")
    assert np.abs(v[-1] - [0.3, 0.6]).max() < 5e-3
    assert np.abs(p[-1] - p[-1, :1]).max() < 2e-2
    assert np.abs(p[100] - p[100, :1]).max() > 1.0


def test_consensus_comes_to_rest_where_the_cart_is(tmp_path: Path) -> None:
    run = completed("consensus", tmp_path / "run")
    p, v = run.recorded("plant.p"), run.recorded("plant.v")
    np.testing.assert_allclose(p[-1, 0], [3.0, -4 / 5], atol=1e-3)  # the second spring, 1 N/m, beside k_p = 4
    assert np.abs(p[-1] - p[-1, :1]).max() < 1e-3
    assert np.abs(v[-1]).max() < 1e-3


def test_arrivals_between_ticks_matter(leaders: Case) -> None:
    """Were deliveries to take effect at the next tick only, the error would be 10^5 times the bound: 0.09 rad."""
    run, _ = leaders
    log, period = run.log, run.period_ns
    on_grid = Log(log.sender, log.receiver, log.stamp, -(-log.arrival_ns // period) * period)
    assert position_error(run, solve(run.agents, period, 50, on_grid)) > 1e-2


def test_known_velocity_is_corollary_1(tmp_path: Path) -> None:
    run = completed("paper_known_velocity", tmp_path / "run", until="10 s")
    assert_close(run, run.solve(), {"plant.p": 1e-6, "plant.v": 1e-5, "controller.v_hat": 0.0})


def test_printed_sign_of_the_adaptation_law_blows_up_before_15_s(tmp_path: Path) -> None:
    run = cosim_run("paper_leaders", tmp_path / "run", f"{CONTROLLER}.adaptation_sign=1", until="20 s")
    assert run.code == 3
    assert "not finite" in run.message
    assert run.folder.ticks < 150
    with pytest.raises(DivergedError) as caught:
        run.folder.solve(ticks=150)
    assert caught.value.time < 15.0
