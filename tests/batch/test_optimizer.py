"""The batch's optimizer: its schedule of gates, its end, and the steps that it shortens or lengthens."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.association import associate
from pathspace_graph.batch.system import (
    GAIN,
    GATE_FACTOR,
    LOOSE_GATE,
    TOLERANCE_DECREASE,
    BatchSystem,
    Convergence,
    Evaluation,
    Optimizer,
    Stage,
    extrapolation_factor,
)
from pathspace_graph.errors import SingularSystemError
from pathspace_graph.graph.elimination import bayes_net, step_by
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import drawn, straight

Array = NDArray[np.float64]

BATCH = MapperSettings().batch


def noisy() -> tuple[BatchSystem, State]:
    """Returns a straight drive that was measured with noise, and the truth of it.

    The sensor's errors are known: they would move detections about the ends of the open curves.
    """
    exact, truth = straight(4.0, BATCH.sigma_smoothness, sensor=False)
    return drawn(exact, np.random.default_rng(3))[0], truth


def test_open_curves_have_no_stations_and_end_with_the_tight_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    system, state = noisy()
    stages, run = list[Stage](), Optimizer.run

    def noted(optimizer: Optimizer, state: State, stage: Stage) -> tuple[Evaluation, Convergence]:
        stages.append(stage)
        return run(optimizer, state, stage)

    monkeypatch.setattr(Optimizer, "run", noted)
    Optimizer(system).find(state)
    first, last = stages
    assert (first.gate, first.refit, last.gate, last.refit) == (LOOSE_GATE, True, BATCH.gate, True)
    assert first.tolerance > last.tolerance
    assert not (first.stations or last.stations)


# --- rounds ----------------------------------------------------------------------------------------------


def test_the_gate_shrinks_by_its_factor_to_its_last_value() -> None:
    """Only with the last gate may the optimization end, however little has changed before."""
    system, state = noisy()
    gates: list[float] = []
    optimizer = Optimizer(system, on_round=lambda: gates.append(system.gate))
    _, convergence = optimizer.run(state, Stage(8.0, 12, 1e9))
    expected = [8.0 * GATE_FACTOR**k for k in range(2)] + [BATCH.gate]
    np.testing.assert_allclose(gates[:3], expected)
    assert set(gates[3:]) <= {BATCH.gate}
    assert convergence.converged
    assert convergence.rounds == len(gates)


def test_it_ends_where_nothing_changes_any_more() -> None:
    """The gradient is small there, and another run changes neither cost nor curves."""
    system, state = noisy()
    at, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40))
    assert convergence.converged
    assert convergence.cost == at.cost
    assert convergence.steps >= convergence.rounds
    again, _ = Optimizer(system).run(at.state, Stage(BATCH.gate, 40))
    np.testing.assert_allclose(again.cost, at.cost, rtol=1e-4)
    np.testing.assert_allclose(again.state.poses, at.state.poses, atol=5e-3)


def decrease_and_step(system: BatchSystem, at: Evaluation) -> tuple[float, Array]:
    """Returns the undamped step at a state, and the decrease of the cost that it predicts."""
    layout = at.state.variables.layout
    step, decrease = step_by(bayes_net(system.linear_graph(at), layout), system.rows(at), layout)
    return decrease, step


def test_the_predicted_decrease_is_that_of_a_linear_problem() -> None:
    """Near the optimum an undamped step makes the cost smaller by just that: `1/2 g' H^-1 g`."""
    system, state = noisy()
    at, _ = Optimizer(system).run(state, Stage(BATCH.gate, 40))
    off = np.random.default_rng(4).normal(0.0, 1e-3, len(at.state.variables.values))
    beside = system.evaluate(system.retract(at.state, off))
    predicted, step = decrease_and_step(system, beside)
    decrease = beside.cost - system.evaluate(system.retract(beside.state, step)).cost
    np.testing.assert_allclose(predicted, decrease, rtol=0.1)
    _, vector = system.linear_graph(beside).hessian(beside.state.variables.layout.ordering)
    np.testing.assert_allclose(predicted, 0.5 * vector @ step, rtol=1e-6)


def test_it_ends_with_a_step_of_a_small_part_of_a_sigma() -> None:
    """The next one would be shorter."""
    system, state = noisy()
    at, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40))
    assert convergence.gradient <= np.sqrt(2.0 * TOLERANCE_DECREASE)
    assert np.sqrt(2.0 * decrease_and_step(system, at)[0]) < convergence.gradient


def test_associations_that_hardly_change_are_searched_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def counted(*arguments: Any) -> None:
        searched.append(arguments)
        associate(*arguments)

    monkeypatch.setattr("pathspace_graph.batch.system.associate", counted)
    system, state = noisy()
    _, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40, 1e-4))
    assert 1 <= len(searched) < convergence.rounds


def test_a_tolerance_ends_it_sooner() -> None:
    rounds = []
    for tolerance in (1e-4, 100.0):
        system, state = noisy()
        _, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40, tolerance))
        rounds.append(convergence.rounds)
    assert rounds[1] < rounds[0]


def test_without_rounds_left_it_has_not_converged() -> None:
    system, state = noisy()
    _, convergence = Optimizer(system).run(state, Stage(8.0, 2))
    assert not convergence.converged
    assert convergence.rounds == 2
    assert convergence.reason == "no round left"


@pytest.mark.parametrize("always", [False, True])
def test_where_the_system_is_singular_damped_steps_lead_to_the_same_optimum(
    always: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Round-off may leave a control point free on kilometres: here in the first steps, or in every one."""
    system, state = noisy()
    expected, _ = Optimizer(system).run(state, Stage(BATCH.gate, 40, 1e-4))
    calls = list[int]()

    def singular(graph: Any, layout: Any) -> gtsam.GaussianBayesNet:
        calls.append(graph.size())
        if len(calls) % 3 and (always or len(calls) < 6):  # until the second damping
            raise SingularSystemError("free")
        return bayes_net(graph, layout)

    system, state = noisy()
    monkeypatch.setattr("pathspace_graph.batch.system.bayes_net", singular)
    found, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40, 1e-4))
    off = found.state.variables.values - expected.state.variables.values
    np.testing.assert_allclose(off, 0.0, atol=2e-3)
    assert convergence.converged != always  # a damped step is short without convergence
    assert len(calls) >= (3 * convergence.rounds if always else 7)  # two steps are damped, at least


def test_the_cost_never_grows_in_a_step() -> None:
    """The associations of the first round are those of the last one here, so costs can be compared."""
    system, state = noisy()
    start = Optimizer(system).align_poses(state, BATCH.gate)
    costs = []
    for rounds in (1, 2, 4, 8):
        at, _ = Optimizer(system).run(start, Stage(BATCH.gate, rounds))
        costs.append(at.cost)
    assert (np.diff(costs) < 1e-3).all()


def times_its_length(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Multiply every step, with a predicted decrease that is no end."""

    def wrong(*problem: Any) -> tuple[NDArray[np.float64], float]:
        return factor * step_by(*problem)[0], 1.0

    monkeypatch.setattr("pathspace_graph.batch.system.step_by", wrong)


def test_steps_share_an_information_that_predicts_the_decrease(monkeypatch: pytest.MonkeyPatch) -> None:
    """They lead to the optimum that each step finds with an information of its own."""
    runs = []
    for gain in (GAIN, np.inf):
        calls = list[int]()

        def counted(graph: Any, layout: Any, calls: list[int] = calls) -> gtsam.GaussianBayesNet:
            calls.append(graph.size())
            return bayes_net(graph, layout)

        monkeypatch.setattr("pathspace_graph.batch.system.bayes_net", counted)
        monkeypatch.setattr("pathspace_graph.batch.system.GAIN", gain)
        system, state = noisy()
        at, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40, 1e-6))
        assert convergence.converged
        runs.append((at.state.variables.values, len(calls), convergence.rounds))
    (values, few, rounds), (expected, many, _) = runs
    assert few < min(many, rounds)
    np.testing.assert_allclose(values, expected, atol=1e-4)


def test_where_an_older_information_leads_nowhere_the_step_gets_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here the first step goes uphill."""
    system, state = noisy()
    at, _ = Optimizer(system).run(state, Stage(BATCH.gate, 3, 1e-6))
    optimizer, steps = Optimizer(system), list[float]()
    optimizer._net = bayes_net(system.linear_graph(at), at.state.variables.layout)

    def first_uphill(*problem: Any) -> tuple[NDArray[np.float64], float]:
        step, decrease = step_by(*problem)
        steps.append(decrease)
        return (-step if len(steps) == 1 else step), decrease

    monkeypatch.setattr("pathspace_graph.batch.system.step_by", first_uphill)
    after, _ = optimizer._step(at)
    assert len(steps) == 2
    assert after.cost < at.cost


def test_a_step_that_is_too_long_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times the step to the minimum makes the cost larger, half of that makes it smaller."""
    times_its_length(3.0, monkeypatch)
    system, state = noisy()
    variables = state.variables
    off = np.random.default_rng(4).normal(0.0, 1e-3, len(variables.values))
    optimizer, state = Optimizer(system), system.retract(state, off)
    at, convergence = optimizer.run(state, Stage(BATCH.gate, 1))
    assert convergence.steps == 2
    assert at.cost < system.evaluate(state).cost


def test_it_ends_where_no_part_of_a_step_decreases_the_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Backwards, the cost grows: nothing moves, and no round repeats what has failed."""
    times_its_length(-1.0, monkeypatch)
    system, state = noisy()
    at, convergence = Optimizer(system).run(state, Stage(BATCH.gate, 40))
    np.testing.assert_array_equal(at.state.variables.values, state.variables.values)
    assert not convergence.converged
    assert convergence.reason == "no part of the last step decreases the cost"
    assert convergence.rounds < 5


def test_the_poses_alone_are_aligned_beside_the_map() -> None:
    """They come back from a shift across the track, and nothing else moves."""
    system, truth = straight(4.0)
    shifted = truth.copy()
    shifted.variables.poses[1:, 1] += 0.3
    optimizer, aligned = Optimizer(system), shifted
    for _ in range(3):
        aligned = optimizer.align_poses(aligned, LOOSE_GATE)
    np.testing.assert_array_equal(aligned.map_points, truth.map_points)
    np.testing.assert_array_equal(aligned.variables.calibration, truth.variables.calibration)
    np.testing.assert_allclose(aligned.poses[:, 1], truth.poses[:, 1], atol=0.02)


# --- steps -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.4, 0.7, 0.9, -0.4, -0.9])
def test_steps_that_shrink_by_one_share_lead_to_their_limit_at_once(share: float) -> None:
    """With x_k = x + r^k d, the second step ends at x if it is made longer, or shorter where r < 0."""
    limit, off = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.1, -0.3])
    points = [limit + share**k * off for k in range(3)]
    before, step = points[1] - points[0], points[2] - points[1]
    np.testing.assert_allclose(points[1] + extrapolation_factor(step, before) * step, limit, atol=1e-12)


@pytest.mark.parametrize("step", [[0.0, 1.0], [-0.1, 0.0], [1.2, 0.0], [-1.2, 0.0], [0.1, 0.0]])
def test_other_steps_are_left_as_they_are(step: list[float]) -> None:
    assert extrapolation_factor(np.array(step), np.array([1.0, 0.0])) == 1.0
    assert extrapolation_factor(np.array(step), np.zeros(2)) == 1.0
