"""The swap: after closing, the map goes on from the batch of the open lap, and nothing is counted twice."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import ClosedMap, LapMarginal, OpenLap, solve_lap
from pathspace_graph.eval.metrics.table1 import lap_metrics
from pathspace_graph.graph.gaussian import factorize, graph_of
from pathspace_graph.io.log import Log
from pathspace_graph.loop import drive_record
from pathspace_graph.loop.drive_record import DriveRecord, LapBatch
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import bean_track, lap_log, map_log, noisy, replay

Array = NDArray[np.float64]


@cache
def log() -> Log:
    return noisy(lap_log(bean_track(), overrun=60.0), seed=3)


@cache
def run() -> tuple[FixedLagMapper, list[CycleResult]]:
    return map_log(log())


def with_settings(**changes: object) -> MapperSettings:
    settings = MapperSettings()
    return replace(settings, open_lap=replace(settings.open_lap, **changes))  # type: ignore[arg-type]


def closing_cycle(results: list[CycleResult]) -> int:
    return [result.closed for result in results].index(True)


def test_the_swap_comes_the_set_number_of_cycles_after_closing_and_is_reported() -> None:
    mapper, results = run()
    swaps = [cycle for cycle, result in enumerate(results) if result.jump is not None]
    assert swaps == [closing_cycle(results) + mapper.settings.open_lap.cycles]
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


def test_the_same_log_gives_the_same_map_to_the_bit() -> None:
    again, mapper = map_log(log())[0], run()[0]
    for label in mapper.boundaries:
        assert (again.control_points(label) == mapper.control_points(label)).all()
    assert (again.poses == mapper.poses).all()


def caught(monkeypatch: pytest.MonkeyPatch, drive: Log) -> tuple[FixedLagMapper, list[LapMarginal]]:
    """Returns a mapper right after the swap, and the marginal that it went on from."""
    marginals: list[LapMarginal] = []

    def marginal(self: LapBatch, timeout: float) -> LapMarginal | str | None:
        solved = waits(self, timeout)
        assert isinstance(solved, LapMarginal)
        marginals.append(solved)
        return solved

    waits = LapBatch.marginal
    monkeypatch.setattr(LapBatch, "marginal", marginal)
    mapper = FixedLagMapper()
    for odometry, detections in split_odometry(drive):
        replay(mapper, odometry, detections)
        if marginals:
            break
    return mapper, marginals


def test_the_window_has_every_measurement_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The information after the swap is the marginal's, and that of the window's odometry and detections."""
    mapper, (marginal,) = caught(monkeypatch, log())
    smoother = mapper.smoother
    assert smoother.first_cycle >= marginal.first_kept
    keys = smoother.map.state.map_keys
    measured = [factor.linear for factor in smoother.window.of_cycle.values()]
    anchors = smoother.map.linear_gauge(True)
    assert smoother.map.gauge(True) == []
    assert [rows.jacobian.max() for rows in anchors] == [1.0 / mapper.settings.gauge.sigma_anchor]
    found = factorize(graph_of(smoother.prior, *measured), smoother.layout).covariance(keys)
    scale = np.sqrt(np.diagonal(found))
    off = (found - smoother.covariance(keys)) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.02  # the window's factors may be linearized a little elsewhere


def test_without_measurements_after_the_lap_the_map_is_the_marginals(monkeypatch: pytest.MonkeyPatch) -> None:
    """The marginal's own mean and covariance are those of the prior, to round-off."""
    mapper, (marginal,) = caught(monkeypatch, log())
    prior_keys = mapper.smoother.map.state.map_keys
    assert len(marginal.mean) == 7 + 2 * len(prior_keys) + 3
    claimed = np.sqrt(np.diagonal(np.linalg.inv(marginal.information))[7:-3])
    now = np.sqrt(np.diagonal(mapper.smoother.covariance(prior_keys)))
    assert (now < 1.001 * claimed).all()
    assert np.median(now / claimed) > 0.8


def test_poses_are_held_until_the_swap_where_the_window_empties_faster() -> None:
    """After closing, cycles come at half the rate; the marginal has none of the poses it must not have."""
    drive, results = log(), run()[1]
    closes = closing_cycle(results)
    cycles = [c for k, c in enumerate(drive.cycles) if k <= closes or (k - closes) % 2 == 0]
    slow = replace(drive, cycles=tuple(cycles))
    mapper, slower = map_log(slow)
    assert sum(result.jump is not None for result in slower) == 1
    truth = drive.truth
    assert truth is not None
    assert lap_metrics(mapper.map(), truth, 0).rmse < 0.15


def test_a_lap_that_is_too_long_keeps_the_prior_and_says_so() -> None:
    mapper, results = map_log(log(), FixedLagMapper(with_settings(max_cycles=50)))
    assert mapper.closed
    assert [result.notice for result in results if result.notice] == [
        "the map goes on from the window's own prior: the lap is too long for a batch"
    ]
    assert all(result.jump is None for result in results)


def test_a_lap_with_too_many_cones_keeps_the_prior_and_says_so() -> None:
    _, results = map_log(log(), FixedLagMapper(with_settings(max_cones=20)))
    assert [result.notice for result in results if result.notice] == [
        "the map goes on from the window's own prior: the lap has too many cones for a batch"
    ]


def test_a_batch_that_does_not_converge_keeps_the_prior_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its optimum is farther away than nothing at all, so it is never near enough."""
    monkeypatch.setattr(drive_record, "SOLVED", 0.0)
    monkeypatch.setattr(drive_record, "solve_lap", _unconverged)
    _, results = map_log(log(), FixedLagMapper())
    assert [result.notice for result in results if result.notice] == [
        "the map goes on from the window's own prior: the batch of the lap has not converged"
    ]


def test_a_process_that_dies_keeps_the_prior_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_record, "solve_lap", _exit)
    _, results = map_log(log())
    assert [result.notice for result in results if result.notice] == [
        "the map goes on from the window's own prior: the process of the batch has died"
    ]


def _unconverged(lap: OpenLap) -> LapMarginal:
    marginal = solve_lap(lap)
    assert marginal is not None
    return replace(marginal, convergence=replace(marginal.convergence, converged=False))


def _exit(lap: OpenLap) -> LapMarginal:
    os._exit(1)


def test_a_users_factors_keep_the_prior() -> None:
    mapper, notices = FixedLagMapper(), []
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.5)
    for odometry, detections in split_odometry(log()):
        factors = []
        if not notices and mapper.smoother.next_cycle == 3:
            factors = [gtsam.PriorFactorPose2(mapper.next_pose_key, gtsam.Pose2(0.5, 0.0, 0.0), noise)]
        notices.append(mapper.update(odometry, detections, factors).notice)
    assert mapper.closed


def test_the_record_gives_the_poses_of_the_lap_in_the_closed_map() -> None:
    mapper, results = run()
    closes = closing_cycle(results)
    assert len(mapper.corrected_poses) == closes + 1
    assert isinstance(mapper.loop.record, DriveRecord)


def test_the_worker_solves_the_lap_as_this_process_does(monkeypatch: pytest.MonkeyPatch) -> None:
    laps: list[OpenLap] = []
    record = DriveRecord.lap

    def keep(self: DriveRecord, first_kept: int, start: ClosedMap, settings: MapperSettings) -> OpenLap:
        laps.append(record(self, first_kept, start, settings))
        return laps[-1]

    monkeypatch.setattr(DriveRecord, "lap", keep)
    _, (marginal,) = caught(monkeypatch, log())
    here = solve_lap(laps[0])
    assert (here.mean == marginal.mean).all()
    assert (here.information == marginal.information).all()
