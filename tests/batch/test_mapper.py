"""The batch from end to end: both starts, open tracks, logs that break off, logs without detections."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch import mapper as batch_mapper
from pathspace_graph.batch.lap import unmapped
from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.system import Convergence, Effort, Evaluation, Optimizer
from pathspace_graph.cli import main
from pathspace_graph.errors import SolveError
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.graph.variables import CALIBRATION_KEY
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import SplineBoundary, read_map
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import Start

from ..scenes.drives import ahead, bean_track, corridor, exact_log, lap_log, noisy, true_poses

Array = NDArray[np.float64]


@cache
def bean() -> Log:
    """Returns a lap and a half of a small closed track."""
    return noisy(lap_log(bean_track(), overrun=50.0), seed=1)


@cache
def solved(start: Start) -> BatchResult:
    return BatchMapper(None, bean().noise, FixedLagMapper).solve(bean(), start)


def broken_off(log: Log, share: float) -> Log:
    """Returns the log with only the first share of its cycles."""
    cycles = log.cycles[: int(share * len(log.cycles))]
    return replace(log, cycles=cycles)


@pytest.mark.parametrize("start", ["online", "odometry"])
def test_a_closed_track_is_mapped_within_the_noise(start: Start) -> None:
    result, truth = solved(start), bean().truth
    assert truth is not None
    assert result.convergence.converged
    assert result.map.closed
    metrics = lap_metrics(result.map, truth, 1)
    assert metrics.missed == 0.0
    assert metrics.rmse < 0.1
    errors = result.trajectory - true_poses(bean())
    assert np.abs(errors[:, :2]).max() < 0.25


def cost_of_a_row(result: BatchResult) -> float:
    """Returns the cost over the number of rows across and along the curves."""
    at = result.optimum
    return result.convergence.cost / (len(at.across.rows) + len(at.along.rows))


def test_both_starts_come_to_one_optimum() -> None:
    """Cones at the edge of being a station may differ, and with them the number of rows."""
    first, second = solved("online"), solved("odometry")
    assert first.map.size == second.map.size
    np.testing.assert_allclose(cost_of_a_row(first), cost_of_a_row(second), rtol=0.01)
    assert aligned_distance(first.map, second.map) < 0.02
    assert np.abs(first.trajectory[:, :2] - second.trajectory[:, :2]).max() < 0.1


def test_a_drive_of_more_than_a_lap_needs_no_online_run() -> None:
    """The optimum is that from odometry, to the bit."""
    result = BatchMapper(None, bean().noise).solve(bean())
    assert result.online is None and result.map.closed
    np.testing.assert_array_equal(result.trajectory, solved("odometry").trajectory)


@pytest.mark.parametrize("why", ["no cone is met again", "the search fails", "the map is objected to"])
def test_the_batch_begins_online_where_odometry_leads_to_no_loop(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has searched from the cones that were met again."""
    log = broken_off(bean(), 0.5) if why == "no cone is met again" else bean()
    find, searches = Optimizer.find, list[State]()

    def fails_once(self: Optimizer, state: State) -> tuple[Evaluation, Convergence]:
        searches.append(state)
        if len(searches) == 1 and why == "the search fails":
            raise SolveError("no optimum")
        return find(self, state)

    monkeypatch.setattr(Optimizer, "find", fails_once)
    if why == "the map is objected to":
        monkeypatch.setattr(batch_mapper, "evidence_against", lambda *_: "its boundaries cross")
    result = BatchMapper(None, log.noise, FixedLagMapper).solve(log)
    assert result.online is not None
    assert len(searches) == (1 if why == "no cone is met again" else 2)
    monkeypatch.undo()
    online = solved("online")
    if why == "no cone is met again":
        online = BatchMapper(None, log.noise, FixedLagMapper).solve(log, "online")
    np.testing.assert_allclose(result.trajectory, online.trajectory, atol=1e-9)


def test_the_size_keeps_to_its_budget() -> None:
    result, truth = solved("odometry"), bean().truth
    assert truth is not None
    assert result.map.size <= 0.44 * len(truth.cones)


def test_an_open_track_has_open_curves() -> None:
    cones, labels = corridor(80.0)
    log = noisy(exact_log(ahead(6.0, 10.0), cones, labels), seed=2)
    for start in ("online", "odometry"):
        result = BatchMapper(None, log.noise, FixedLagMapper).solve(log, start)  # type: ignore[arg-type]
        assert result.convergence.converged
        assert not result.map.closed
        for boundary in result.map.boundaries.values():
            assert isinstance(boundary, SplineBoundary)
            assert not boundary.spline.periodic
            assert 50.0 < boundary.spline.length() < 80.0
        assert np.abs(result.trajectory[:, 1]).max() < 0.2


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_log_that_stops_in_the_middle_of_a_lap(share: float) -> None:
    log = broken_off(bean(), share)
    result = BatchMapper(None, log.noise, FixedLagMapper).solve(log, "odometry")
    assert result.convergence.converged
    assert not result.map.closed
    assert len(result.map.boundaries) == 2
    errors = result.trajectory - true_poses(log)
    assert np.abs(errors[:, :2]).max() < 0.3


def test_several_laps_that_stop_in_the_middle_of_one() -> None:
    """After two laps and a half the map is closed, and the poses of every lap are beside the same curves."""
    log = noisy(lap_log(bean_track(), overrun=160.0), seed=4)
    result = BatchMapper(None, log.noise, FixedLagMapper).solve(log, "odometry")
    assert result.convergence.converged
    assert result.map.closed
    assert result.laps == 2
    assert log.truth is not None
    assert result.map.size <= 0.44 * len(log.truth.cones)
    errors = result.trajectory - true_poses(log)
    assert np.abs(errors[:, :2]).max() < 0.25


def test_the_map_of_a_log_without_detections_is_its_odometry() -> None:
    log = bean()
    empty = replace(
        log,
        cycles=tuple(
            replace(
                c, points_vehicle=np.zeros((0, 2)), covariances=np.zeros((0, 2, 2)), labels=np.zeros(0, int)
            )
            for c in log.cycles
        ),
    )
    result = BatchMapper(None, log.noise, FixedLagMapper).solve(empty, "odometry")
    assert result.convergence.converged
    assert not result.map.boundaries
    np.testing.assert_allclose(result.trajectory, true_poses(log), atol=1e-3)


def test_the_covariances_are_of_the_right_shape_and_positive() -> None:
    result = solved("odometry")
    assert result.map_covariance.shape == (2 * result.map.size, 2 * result.map.size)
    assert result.pose_covariances.shape == (len(bean().cycles), 3, 3)
    assert np.linalg.eigvalsh(result.pose_covariances).min() > 0.0
    assert np.linalg.eigvalsh(result.map_covariance).min() > 0.0


@pytest.mark.slow
def test_the_command_writes_its_result(tmp_path: Path) -> None:
    write_log(bean(), tmp_path / "log")
    arguments = ["batch", str(tmp_path / "log"), "--out", str(tmp_path / "map"), "--start", "online"]
    assert main(arguments) == 0
    summary = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert summary["convergence"]["converged"]
    assert summary["start"] == "online"
    assert read_map(tmp_path / "map").closed


def test_a_run_that_did_not_converge_is_written_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_log(broken_off(bean(), 0.3), tmp_path / "log")
    arguments = ["batch", str(tmp_path / "log"), "--out", str(tmp_path / "map"), "--start", "odometry"]
    monkeypatch.setattr("pathspace_graph.batch.system.Effort", lambda: Effort(rounds=1))
    assert main(arguments) == 3
    summary = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert not summary["convergence"]["converged"]
    assert summary["convergence"]["reason"] == "no round left"
    assert summary["start"] == "odometry"
    assert read_map(tmp_path / "map").size > 0


def test_a_map_that_lacks_the_cones_of_a_part_of_the_drive_is_objected_to() -> None:
    result = solved("odometry")
    detections, poses = deepcopy(result.system.detections), result.optimum.state.poses
    assert result.objection == "" == unmapped(detections, poses)
    late = detections.cycle > 0.5 * len(poses)
    detections.release(np.flatnonzero(late)[::4])
    assert unmapped(detections, poses) == ""  # false detections are everywhere
    detections.release(np.flatnonzero(late))
    said, driven = unmapped(detections, poses), path_lengths(poses)
    assert "% of the detections near the drive lie on no boundary" in said
    assert 40 <= int(said.split()[0]) <= 60
    begin, end = map(float, re.findall(r"\((\S+) to (\S+) m of the drive\)", said)[0])
    assert begin == pytest.approx(driven[len(poses) // 2], abs=25.0)  # where the first stretch begins
    assert end == pytest.approx(driven[-1], rel=0.01)
    assert unmapped(DetectionTable(), poses) == ""


def test_a_map_that_is_objected_to_is_written_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pathspace_graph.batch.lap.MISS_SHARE", 0.0)
    write_log(bean(), tmp_path / "log")
    arguments = ["batch", str(tmp_path / "log"), "--out", str(tmp_path / "map"), "--start", "odometry"]
    assert main(arguments) == 3
    said = capsys.readouterr().err
    assert re.search(r"not a map of the drive: \d % of the detections near the drive .* \(0 to \d+ m", said)
    assert read_map(tmp_path / "map").size > 0


def test_the_vehicle_at_the_end_is_known_as_well_as_its_pose() -> None:
    result = solved("odometry")
    state = result.vehicle
    assert state is not None
    np.testing.assert_array_equal(state.pose, result.trajectory[-1])
    np.testing.assert_array_equal(state.calibration, result.calibration)
    np.testing.assert_allclose(state.covariance[:3, :3], result.pose_covariances[-1], rtol=1e-6, atol=1e-12)
    known = result.system.eliminated(result.optimum).joint(np.array([CALIBRATION_KEY], np.intp))
    np.testing.assert_allclose(state.covariance[3:, 3:], known, rtol=1e-6)
