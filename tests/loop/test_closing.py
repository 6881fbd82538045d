"""Loop closing: where it must happen, where it mustn't, and what it may change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import cone_distances
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.labels import LEFT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import ClosingSettings, MapperSettings
from pathspace_graph.spline.boundary import relocate

from ..scenes.drives import (
    ODOMETRY_SIGMA,
    ahead,
    bean_track,
    corridor,
    exact_lap,
    exact_log,
    map_log,
    mapped,
    true_poses,
)
from ..shared.copied import copied

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def log() -> Log:
    return exact_lap()


@pytest.fixture(scope="module")
def run(log: Log) -> tuple[FixedLagMapper, list[CycleResult]]:
    """The whole drive."""
    return mapped(log)


@pytest.fixture(scope="module")
def open_lap(log: Log) -> FixedLagMapper:
    """The mapper some metres after its curves are met again, which it does not notice."""
    cycle = next(k for k, result in enumerate(mapped(log)[1]) if result.closed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pathspace_graph.loop.open.return_to_beginning", lambda *_: None)
        mapper, results = map_log(replace(log, cycles=log.cycles[:cycle]))
    assert not results[-1].closed
    return mapper


@pytest.fixture
def before(open_lap: FixedLagMapper) -> FixedLagMapper:
    """The mapper a cycle before its curves are met again; each test has its own."""
    return copied(open_lap)


def test_the_loop_closes_once_the_beginning_is_driven_again(
    log: Log, run: tuple[FixedLagMapper, list[CycleResult]]
) -> None:
    mapper, results = run
    assert mapper.closed
    assert mapper.map().closed
    closed = [result.closed for result in results]
    assert closed == sorted(closed)
    lap = bean_track().centre_line.length
    driven = np.cumsum(np.hypot(*np.diff(true_poses(log)[:, :2], axis=0).T))
    assert driven[closed.index(True) - 1] > lap


def test_closed_boundaries_are_periodic_and_of_their_final_size(
    log: Log, run: tuple[FixedLagMapper, list[CycleResult]], before: FixedLagMapper
) -> None:
    mapper, results = run
    track = mapper.map()
    assert log.truth is not None
    assert track.size <= 0.44 * len(log.truth.cones)
    assert track.size < before.map().size
    assert len({result.sizes for result in results if result.closed}) == 1
    for boundary in track.boundaries.values():
        assert isinstance(boundary, SplineBoundary)
        assert boundary.spline.periodic
        assert boundary.covariance.shape == (2 * boundary.size, 2 * boundary.size)
        assert np.linalg.eigvalsh(boundary.covariance)[0] > 0.0


def test_a_closed_curve_has_no_seam(run: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    """Position, direction and curvature go on where the ends met."""
    for boundary in run[0].map().boundaries.values():
        assert isinstance(boundary, SplineBoundary)
        low, high = boundary.spline.domain
        for derivative in range(3):
            ends = [boundary.spline.evaluate(np.array([u]), derivative) for u in (low, high - 1e-9)]
            np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_the_closed_curves_pass_the_cones(log: Log, run: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    mapper = run[0]
    assert log.truth is not None
    distances = cone_distances(mapper.map(), log.truth)
    assert np.sqrt(np.mean(distances**2)) < 0.15
    assert distances.max() < 0.5


def test_closing_leaves_the_pose_where_it_is(log: Log, run: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    """Nothing had drifted."""
    poses = np.array([result.pose for result in run[1]])
    error = poses - true_poses(log)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.3
    assert np.abs(error[:, 2]).max() < 0.03


def test_readings_in_use_lie_on_the_closed_curve(run: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    mapper = run[0]
    detections = mapper.road.smoother.map.detections
    for label, boundary in mapper.boundaries.items():
        rows = detections.used_on(label)
        assert len(rows) > 20
        points = detections.points_map(rows, mapper.road.smoother.variables)
        on_curve = boundary.evaluate(mapper.control_points(label), detections.u[rows])
        distances = np.hypot(*(points - on_curve).T)
        assert np.median(distances) < 0.15
        assert distances.max() < 0.6
        foot = boundary.refine(mapper.control_points(label), points, detections.u[rows])
        assert foot.interior.all()
        assert np.median(np.abs(foot.distance)) < 0.02
        assert np.abs(foot.distance).max() < 0.1


# --- where it mustn't ------------------------------------------------------------------------------------


def test_an_open_track_stays_open() -> None:
    log = exact_log(ahead(10.0, 9.0), *corridor(110.0))
    mapper, results = map_log(log)
    assert mapper.road.path.length > mapper.settings.closing.min_path
    assert not any(result.closed for result in results)
    assert not mapper.map().closed


def test_no_loop_is_shorter_than_the_shortest(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = FixedLagMapper(None, ODOMETRY_SIGMA)
    monkeypatch.setattr(ClosingSettings, "min_path", 1000.0)
    for odometry, cycle in split_odometry(replace(log, cycles=log.cycles[:175])):
        mapper.update(odometry, cycle)
    assert not mapper.closed
    assert not mapper.road.path.near_beginning(mapper.poses[-1], ClosingSettings())
    monkeypatch.undo()
    assert mapper.road.path.near_beginning(mapper.poses[-1], MapperSettings().closing)


def test_standing_on_the_start_line_closes_nothing() -> None:
    log = exact_log(ahead(0.0, 4.0), *corridor(60.0))
    mapper, _ = map_log(log)
    assert not mapper.road.path.near_beginning(mapper.poses[-1], mapper.settings.closing)
    assert not mapper.closed


def test_another_way_past_the_beginning_is_no_loop() -> None:
    """There and back again on the same straight: the place is the same, the direction is not."""
    turning = np.tile([6.0, 0.0, np.pi / 3.0], (150, 1))
    twists = np.concatenate([ahead(10.0, 6.0), turning, ahead(10.0, 7.0)])
    mapper, _ = map_log(exact_log(twists, *corridor(80.0)))
    assert mapper.road.path.length > mapper.settings.closing.min_path
    assert not mapper.closed


@pytest.mark.parametrize("turned", [False, True])
def test_a_lost_place_is_found_by_position_and_heading(
    run: tuple[FixedLagMapper, list[CycleResult]], turned: bool
) -> None:
    """Where the vehicle faces the other way it can't be beside the nearest stretch."""
    mapper = run[0]
    boundary, points = mapper.boundaries[LEFT], mapper.control_points(LEFT)
    for u in np.linspace(boundary.tables.low, boundary.tables.high, 7)[:-1]:
        at = np.array([u])
        position, tangent = boundary.evaluate(points, at)[0], boundary.evaluate(points, at, 1)[0]
        heading = np.arctan2(tangent[1], tangent[0]) + np.pi * turned
        pose = np.array([position[0] + 0.5 * tangent[1], position[1] - 0.5 * tangent[0], heading])
        found = relocate(boundary, points, pose, 40.0)
        direction = boundary.evaluate(points, np.array([found]), 1)[0]
        assert direction @ [np.cos(heading), np.sin(heading)] > 0.0
        if not turned:
            away = (found - u + 0.5 * boundary.length) % boundary.length - 0.5 * boundary.length
            assert abs(away) < 0.1
