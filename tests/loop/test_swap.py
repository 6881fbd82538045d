"""The swap: the loop closes as the map goes on from the batch of the lap, and nothing is counted twice."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam import GaussianFactorGraph
from numpy.typing import NDArray

from pathspace_graph.batch.lap import LapMarginal, OpenLap, solve_lap
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.factors.gtsam_factors import boundary_point_factor
from pathspace_graph.factors.se2 import left_of, wrap_angle
from pathspace_graph.graph.gaussian import normal_equations
from pathspace_graph.graph.variables import CALIBRATION_KEY, Layout, Variables, pose_keys
from pathspace_graph.labels import LEFT
from pathspace_graph.loop import drive as drives
from pathspace_graph.loop import lap_solver
from pathspace_graph.loop.drive import DriveRecord
from pathspace_graph.loop.open import STAYS_OPEN
from pathspace_graph.mapping.road import HELD, Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import GivenFactor
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import information_of
from ..scenes.drives import (
    Mapped,
    bean_track,
    lap_log,
    map_beginning,
    map_log,
    mapped,
    noisy,
    replay,
    true_poses,
)
from ..scenes.drives import noisy_lap as log
from ..scenes.graph import columns_of, dense_rows
from ..shared import laps

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@cache
def run() -> Mapped:
    return mapped(log())


def open_lap() -> Mapped:
    """Returns a mapper shortly before it is at its beginning again, and what it said."""
    mapper, results = run()
    return map_beginning(log(), closing_cycle(results) - mapper.settings.open_lap.cycles - 5)


def with_settings(**changes: object) -> MapperSettings:
    settings = MapperSettings()
    return replace(settings, open_lap=replace(settings.open_lap, **changes))  # type: ignore[arg-type]


def closing_cycle(results: list[CycleResult]) -> int:
    return [result.closed for result in results].index(True)


def test_the_loop_closes_by_the_swap_the_set_number_of_cycles_after_the_return() -> None:
    mapper, results = run()
    _, lap = swapped()
    swaps = [cycle for cycle, result in enumerate(results) if result.jump is not None]
    assert swaps == [len(lap.chain) - 1 + mapper.settings.open_lap.cycles] == [closing_cycle(results)]
    jump = results[swaps[0]].jump
    assert jump is not None
    assert np.isfinite(jump).all()
    assert np.hypot(*jump[:2]) > 0.0
    assert not any(result.notice for result in results)
    assert mapper.lap_seconds > 0.0


def test_the_map_is_within_the_noise() -> None:
    truth = log().truth
    assert truth is not None
    assert lap_metrics(run()[0].map(), truth, 0).rmse < 0.05


def test_the_same_log_gives_the_same_map_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lap is solved by a process of its own this time, as in a vehicle."""
    monkeypatch.setattr(lap_solver, "submit", laps.IN_A_PROCESS)
    again, mapper = map_log(log())[0], run()[0]
    for label in mapper.boundaries:
        assert (again.control_points(label) == mapper.control_points(label)).all()
    assert (again.poses == mapper.poses).all()


# --- the moment of the swap ------------------------------------------------------------------------------


@dataclass(eq=False)
class Swap:
    """Holds what is known right after the map has gone on from the marginal of the lap."""

    marginal: LapMarginal
    prior: GaussianFactorGraph
    variables: Variables
    keys: IntArray
    """(k,) Those of the marginal, in its order."""
    system: tuple[Array, Array]
    """Hessian (n, n) and negative gradient (n,) of the marginal and of each later measurement, once."""
    covariance: Array
    """(n, n) What the smoother claims of all variables."""
    associated_with: Array
    """(k,) Calibrations by which the detections were associated with the new curves."""


def swap_of(smoother: CurveSmoother, marginal: LapMarginal, associated_with: Array) -> Swap:
    """Returns the state of a smoother, and the dense system that it must have."""
    smoother.refresh()
    variables, points = smoother.variables, smoother.map.state.map_keys
    cycles = np.arange(smoother.first_cycle, smoother.next_cycle)
    measured = smoother.map.rows(cycles) + smoother.window.odometry.rows(variables, cycles)
    assert not smoother.map.weak  # the prior has those of all control points
    J, r, _ = dense_rows([rows for rows in measured if len(rows)], variables.keys)
    first = pose_keys(np.array([marginal.first_kept]))
    keys = np.concatenate([variables.calibration_keys, points, first])
    own, hessian, gradient = columns_of(keys, variables.keys), J.T @ J, J.T @ r
    hessian[np.ix_(own, own)] += information_of(marginal)
    gradient[own] += information_of(marginal) @ (variables.of(keys) - marginal.mean)
    claimed = smoother.covariance(variables.keys)
    return Swap(
        marginal, smoother.prior, variables.copy(), keys, (hessian, -gradient), claimed, associated_with
    )


@cache
def swapped() -> tuple[Swap, OpenLap]:
    """Returns the swap of a drive, and the lap that was solved for it."""
    swaps: list[Swap] = []
    laps: list[OpenLap] = []
    calibrations: list[Array] = []
    take, record, associate = drives.take_marginal, DriveRecord.lap, CurveSmoother.reassociate

    def take_marginal(road: Road, marginal: LapMarginal, given: Sequence[GivenFactor]) -> Array:
        jump = take(road, marginal, given)
        swaps.append(swap_of(road.smoother, marginal, calibrations[-1]))
        return jump

    def reassociate(self: CurveSmoother) -> None:
        calibrations.append(self.variables.calibrations.copy())
        associate(self)

    def lap(self: DriveRecord, *arguments: Any, **options: Any) -> OpenLap:
        laps.append(record(self, *arguments, **options))
        return laps[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drives, "take_marginal", take_marginal)
        patch.setattr(DriveRecord, "lap", lap)
        patch.setattr(CurveSmoother, "reassociate", reassociate)
        mapper, known = open_lap()
        for odometry, detections in islice(split_odometry(log()), len(known), None):
            replay(mapper, odometry, detections)
            if swaps:
                break
    return swaps[0], laps[0]


def test_the_prior_after_the_swap_is_the_marginal() -> None:
    swap, _ = swapped()
    assert np.sort(swap.keys).tolist() == swap.keys.tolist()
    layout = Layout(swap.keys)
    information, vector = normal_equations(swap.prior, layout)
    scale = np.sqrt(np.diagonal(information_of(swap.marginal)))
    off = (information - information_of(swap.marginal)) / np.outer(scale, scale)
    assert np.abs(off).max() < 1e-9
    reference = swap.variables.reference[swap.variables.layout.entries(swap.keys)]
    mean = reference + np.linalg.solve(information, vector)
    np.testing.assert_allclose(mean, swap.marginal.mean, atol=1e-9)


def test_detections_are_associated_with_the_new_curves_by_the_calibration_of_the_batch() -> None:
    swap, _ = swapped()
    np.testing.assert_array_equal(swap.associated_with, swap.marginal.calibration)
    assert len(swap.associated_with) > 2  # the sensor's too


def test_the_window_has_every_measurement_once() -> None:
    """The covariance is that of the marginal and of the window's own measurements, as dense algebra has it.

    The estimate is where these have their optimum.
    """
    swap, _ = swapped()
    hessian, negative_gradient = swap.system
    assert swap.variables.first_cycle == swap.marginal.first_kept
    expected = np.linalg.inv(hessian)
    scale = np.sqrt(np.diagonal(expected))
    assert np.abs((swap.covariance - expected) / np.outer(scale, scale)).max() < 1e-8
    assert np.abs(expected @ negative_gradient / scale).max() < 0.05


def test_poses_are_held_until_the_swap_where_the_window_empties_faster() -> None:
    """After the return, cycles come at half the rate; the marginal has none of the poses it must not have."""
    drive, closes = log(), len(swapped()[1].chain) - 1
    cycles = [c for k, c in enumerate(drive.cycles) if k <= closes or (k - closes) % 2 == 0]
    slow = replace(drive, cycles=tuple(cycles))
    mapper, slower = map_log(slow, *map_beginning(drive, closes))
    assert sum(result.jump is not None for result in slower) == 1
    truth = drive.truth
    assert truth is not None
    assert lap_metrics(mapper.map(), truth, 0).rmse < 0.05


@pytest.mark.parametrize(
    ("limit", "most", "reason"),
    [
        ("drive.MOST_CYCLES", 50, "the lap is too long for a batch"),
        ("open.MOST_CONES", 20, "the lap has too many cones for a batch"),
    ],
)
def test_a_lap_without_a_batch_stays_open_and_says_why(
    limit: str, most: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"pathspace_graph.loop.{limit}", most)
    mapper, results = map_log(log(), FixedLagMapper())
    assert not mapper.closed
    assert [result.notice for result in results if result.notice] == [f"{STAYS_OPEN}: {reason}"]
    assert all(result.jump is None for result in results)


def test_a_batch_that_does_not_converge_closes_nothing_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its optimum is farther away than nothing at all, so it is never near enough."""
    monkeypatch.setattr(lap_solver, "SOLVED", 0.0)
    monkeypatch.setattr(lap_solver, "submit", _unconverged)
    mapper, results = map_log(log(), *open_lap())
    notices = {result.notice for result in results if result.notice}
    assert notices == {"the loop stays open: the batch of the lap has not converged"}
    assert not mapper.closed and len(mapper.corrected_poses) == 0


def test_where_the_process_dies_the_next_batch_closes_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, results = open_lap()
    rest, died = islice(split_odometry(log()), len(results), None), ""
    monkeypatch.setattr(lap_solver, "solve_lap", _exit)
    for cycle in rest:
        result = replay(mapper, *cycle)
        if result.notice:
            died = result.notice
            monkeypatch.undo()
    assert died == f"{STAYS_OPEN}: the process of the batch has died"
    assert mapper.closed
    truth = log().truth
    assert truth is not None
    assert lap_metrics(mapper.map(), truth, 0).rmse < 0.1


def _unconverged(work: Callable[..., LapMarginal | None], *arguments: object) -> Future[LapMarginal | None]:
    """Solves a lap in this process, and says that it has not converged."""
    marginal, future = work(*arguments), Future[LapMarginal | None]()
    if marginal is not None:
        marginal = replace(marginal, convergence=replace(marginal.convergence, converged=False))
    future.set_result(marginal)
    return future


def _exit(lap: OpenLap) -> LapMarginal:
    os._exit(1)


def with_priors(sigma: float) -> FixedLagMapper:
    """A mapper after the drive with the true pose as a factor on each fifth pose."""
    mapper, noise = FixedLagMapper(), gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    for cycle, (odometry, detections) in enumerate(split_odometry(log())):
        pose = gtsam.Pose2(*true_poses(log())[cycle])
        given = [gtsam.PriorFactorPose2(mapper.next_pose_key, pose, noise)] if cycle % 5 == 3 else []
        mapper.wait()
        mapper.update(odometry, detections, given)
    assert mapper.closed
    return mapper


def test_the_batch_of_the_lap_has_the_users_factors_on_poses() -> None:
    known, poor = with_priors(0.003), with_priors(1e9)
    usual, _ = run()
    truth = true_poses(log())

    def error(mapper: FixedLagMapper) -> float:
        corrected = mapper.corrected_poses
        return float(np.hypot(*(corrected - truth[: len(corrected)])[:, :2].T).mean())

    assert error(known) < 0.006  # m; a batch without them has 0.03
    assert error(usual) > 0.02
    assert 0.02 < error(poor) < 0.05  # the loop closes some cycles later


ASIDE = 0.4  # of a surveyed point from the left curve (m)


@cache
def surveyed(cycle: int) -> tuple[Mapped, Array]:
    """A drive whose left curve is said, in a cycle, to pass a point aside of it, and that point."""
    mapper, results, point = FixedLagMapper(None, log().noise), list[CycleResult](), np.zeros(2)
    for k, (odometry, detections) in enumerate(split_odometry(log())):
        given = []
        if k == cycle:
            boundary, points = mapper.boundaries[LEFT], mapper.control_points(LEFT)
            u = np.array([0.5 * boundary.confirmed_end])
            tangent = boundary.evaluate(points, u, 1)
            point = boundary.evaluate(points, u) + ASIDE * left_of(tangent) / np.hypot(*tangent.T)
            sides = {"low": u - 4.0, "high": u + 4.0, "sigma": np.array([1e-3])}
            keys = mapper.control_keys(LEFT)
            given = [boundary_point_factor(keys, boundary.tables, points_map=point, **sides)]
        mapper.wait()
        results.append(mapper.update(odometry, detections, given))
    return (mapper, results), point


def off_left(mapper: FixedLagMapper, point: Array) -> float:
    """Distance (m) of the left curve from a point (1, 2)."""
    boundary, points = mapper.boundaries[LEFT], mapper.control_points(LEFT)
    return float(np.abs(boundary.find_anywhere(points, point).distance[0]))


@pytest.mark.parametrize("before", [60, 4])
def test_a_factor_on_control_points_is_in_the_map_of_the_closed_loop(before: int) -> None:
    """It is given so many cycles before the swap: the batch has the earlier one, the map the later one."""
    cycle = closing_cycle(run()[1]) - before
    (mapper, results), point = surveyed(cycle)
    assert mapper.closed and mapper.failures == 0
    assert {result.notice for result in results if result.notice} == {HELD}
    held = [one.cycle for one in mapper.drive.record.factors]
    assert held == [cycle] and mapper.road.smoother.user_factors.factors == []
    assert off_left(run()[0], point) > 0.5 * ASIDE
    assert off_left(mapper, point) < 0.2 * ASIDE  # few control points pass it by some centimetres


def test_a_factor_on_the_calibration_counts_once_after_the_loop_has_closed() -> None:
    """It stays a variable, so the factor could be in the window and in the marginal."""
    mapper, sigma = FixedLagMapper(None, log().noise), 1e-5
    noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    for k, (odometry, detections) in enumerate(split_odometry(log())):
        known = gtsam.PriorFactorPoint2(CALIBRATION_KEY, np.zeros(2), noise)
        mapper.wait()
        mapper.update(odometry, detections, [known] if k == 5 else [])
    assert mapper.closed
    sigmas = np.sqrt(np.diag(mapper.marginal_covariance([CALIBRATION_KEY])))
    np.testing.assert_allclose(sigmas, sigma, rtol=0.05)  # counted twice it would be 0.71 of that


def test_the_poses_of_the_lap_are_corrected_as_soon_as_the_loop_closes() -> None:
    """The odometry has turned the open map by then; the cycle's own pose was right only at its end."""
    drive = lap_log(bean_track(), overrun=40.0)
    drive = noisy(replace(drive, odometry_sigma=np.array([0.1, 0.1, 0.02])), seed=3)
    mapper, results = FixedLagMapper(MapperSettings(), drive.noise), []
    for cycle in split_odometry(drive):
        results.append(replay(mapper, *cycle))
        if mapper.closed:
            break
    assert len(mapper.corrected_poses) == len(results)
    online, truth = np.array([result.pose for result in results]), true_poses(drive)[: len(results)]
    before, after = (wrap_angle(poses[:, 2] - truth[:, 2]) for poses in (online, mapper.corrected_poses))
    assert np.abs(after).max() < 0.02
    assert np.square(after).mean() < np.square(before).mean()
    before, after = (np.hypot(*(poses - truth)[:, :2].T) for poses in (online, mapper.corrected_poses))
    assert np.square(after).mean() < 0.5 * np.square(before).mean()


def test_the_smoothed_trajectory_is_the_corrected_poses_by_their_stamps() -> None:
    mapper, results = run()
    t, corrected = np.array([result.t for result in results]), mapper.corrected_poses
    assert len(corrected) == closing_cycle(results) + 1
    smoothed = mapper.smoothed(t)
    np.testing.assert_array_equal(smoothed[: len(corrected)], corrected)
    assert np.isnan(smoothed[len(corrected) :]).all()
    np.testing.assert_array_equal(mapper.smoothed(t[3:5] + 1e-3), corrected[3:5])
    assert np.isnan(FixedLagMapper().smoothed(t)).all()
    whole = run_online(log(), FixedLagMapper(MapperSettings(), log().noise))
    assert whole.smoothed is not None
    np.testing.assert_array_equal(whole.smoothed[: len(corrected)], corrected)
    np.testing.assert_array_equal(whole.smoothed[len(corrected) :], whole.trajectory[len(corrected) :])


def test_the_worker_solves_the_lap_as_this_process_does() -> None:
    swap, lap = swapped()
    here = solve_lap(lap)
    assert (here.mean == swap.marginal.mean).all()
    assert (information_of(here) == information_of(swap.marginal)).all()
