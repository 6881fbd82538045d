"""Late detections: where they would be seen from the nearest pose, and what they do to a map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph import FixedLagMapper, ReadingError
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.factors.se2 import compose, se2_exp, to_map, to_vehicle
from pathspace_graph.front_end.front_end import at_nearest_pose
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.online import MotionSettings

from ..scenes.drives import ahead, bean_track, corridor, detections, exact_log, lap_log, map_log, noisy

Array = NDArray[np.float64]
NO_TWISTS = Odometry(np.zeros(0), np.zeros((0, 3)))
TWIST = np.array([8.0, 0.5, 0.4])


def mapper_in_a_bend() -> FixedLagMapper:
    """A mapper after four cycles of a constant twist, without any cone."""
    mapper, _ = map_log(exact_log(np.tile(TWIST, (20, 1)), np.zeros((0, 2)), np.zeros(0, np.intp)))
    return mapper


def seen_at(mapper: FixedLagMapper, t: float, points_map: Array) -> tuple[Detections, int, Array]:
    pose = compose(mapper.poses[0], se2_exp((t - mapper.smoother.times[0]) * TWIST[None])[0])
    local = to_vehicle(points_map, np.tile(pose, (len(points_map), 1)))
    late = detections(t, local, np.zeros(len(points_map), np.intp))
    return at_nearest_pose(mapper.smoother, late, mapper.settings.motion)


@pytest.mark.parametrize(("t", "cycle"), [(0.13, 1), (0.149, 1), (0.151, 2), (0.19, 2), (0.21, 2)])
def test_late_detections_are_where_they_are_in_the_map_from_the_nearest_pose(t: float, cycle: int) -> None:
    mapper, points = mapper_in_a_bend(), np.array([[9.0, 2.0], [12.0, -3.0]])
    late, nearest, twist = seen_at(mapper, t, points)
    assert nearest == cycle
    np.testing.assert_allclose(twist, TWIST, atol=1e-6)
    poses = np.tile(mapper.poses[cycle], (2, 1))
    np.testing.assert_allclose(to_map(late.points_vehicle, poses), points, atol=1e-6)


def test_the_motion_to_the_nearest_pose_adds_its_uncertainty() -> None:
    """The derivative of the moved point by the motion is numeric here."""
    mapper, t = mapper_in_a_bend(), 0.13
    z = np.array([[9.0, 2.0]])
    cycle = detections(t, z, np.zeros(1, np.intp))
    late, _, _ = at_nearest_pose(mapper.smoother, cycle, mapper.settings.motion)
    moved = se2_exp(0.03 * TWIST[None])[0]
    whitener = mapper.smoother.window.odometry.whiteners[1]
    bend = 0.5 * 0.03 * 0.07 * np.array([5.0, 5.0, 1.5])
    spread = 0.3 * np.linalg.inv(whitener.T @ whitener) + np.diag(bend**2)

    def point(step: Array) -> Array:
        return to_map(z, compose(moved, step)[None])[0]

    by = np.array([(point(1e-6 * e) - point(-1e-6 * e)) / 2e-6 for e in np.eye(3)]).T
    turn = se2_exp(0.03 * TWIST[None])[0, 2]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    expected = R @ (0.01 * np.eye(2)) @ R.T + by @ spread @ by.T
    np.testing.assert_allclose(late.covariances[0], expected, rtol=1e-5)
    assert MotionSettings().accelerations == (5.0, 5.0, 1.5)


def run_with_late_cycles(
    log: Log, mapper: FixedLagMapper | LandmarkFixedLag, every: int, seed: int = 0
) -> list[CycleResult]:
    """Hands over every so-many-th cycle 2 to 5 cycles late; returns the results of these."""
    rng, waiting, results, since = np.random.default_rng(seed), {}, [], float(log.odometry.t[0])
    for k, cycle in enumerate(log.cycles):
        if k % every == every // 2 and k > every:
            waiting.setdefault(k + int(rng.integers(2, 6)), []).append(cycle)
            continue
        mapper.update(log.odometry.between(since, cycle.t), cycle)
        since = cycle.t
        results += [mapper.update(NO_TWISTS, late) for late in waiting.pop(k, [])]
    return results


def distances(mapper: FixedLagMapper, log: Log) -> Array:
    """The distance of each true cone from the curve of its side."""
    assert log.truth is not None
    found = []
    for label, boundary in mapper.map().boundaries.items():
        curve = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, 2000))
        own = log.truth.cones[log.truth.cone_labels == label]
        found.append(np.hypot(*(own[:, None] - curve[None]).transpose(2, 0, 1)).min(axis=1))
    return np.concatenate(found)


def test_a_map_with_late_cycles_is_about_as_good_as_one_in_order() -> None:
    log = noisy(lap_log(bean_track()), seed=1)
    in_order, _ = map_log(log)
    with_late = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    late = run_with_late_cycles(log, with_late, every=10)
    assert len(late) >= len(log.cycles) // 10 - 3
    assert all(result.late for result in late)
    assert np.mean([result.readings for result in late]) > 2.0
    rms, rms_late = (np.sqrt(np.mean(distances(one, log) ** 2)) for one in (in_order, with_late))
    assert rms_late < rms + 0.05


def test_landmarks_take_late_cycles_too() -> None:
    log = noisy(exact_log(ahead(8.0, 6.0), *corridor(80.0)), seed=1)
    mapper = LandmarkFixedLag(odometry_sigma=log.odometry_sigma)
    late = run_with_late_cycles(log, mapper, every=10)
    assert late and all(result.late for result in late)
    assert np.mean([result.readings for result in late]) > 2.0
    for label, y in ((0, 2.0), (1, -2.0)):
        points = mapper.map().boundaries[label].points  # type: ignore[union-attr]
        assert np.abs(points[:, 1] - y).max() < 0.5


def test_a_late_cycle_adds_no_pose_and_moves_no_twist() -> None:
    """The next cycle in order goes on from the newest one in order."""
    log = exact_log(ahead(8.0, 4.0), *corridor(60.0))
    pairs, mapper = list(split_odometry(log)), FixedLagMapper(odometry_sigma=log.odometry_sigma)
    for odometry, cycle in pairs[:20]:
        mapper.update(odometry, cycle)
    number, newest = len(mapper.poses), mapper.poses[-1].copy()
    between = Detections(
        cycle.t - 0.25, cycle.points_vehicle + np.array([2.0, 0.0]), cycle.covariances, cycle.labels
    )
    result = mapper.update(NO_TWISTS, between)
    assert len(mapper.poses) == number
    assert result.readings > 0
    np.testing.assert_allclose(result.pose, newest, atol=1e-3)
    result = mapper.update(*pairs[20])
    np.testing.assert_allclose(result.pose, [8.0 * pairs[20][1].t, 0.0, 0.0], atol=1e-3)


def test_a_cycle_later_than_the_lag_is_refused_counted_and_changes_nothing() -> None:
    log = exact_log(ahead(8.0, 6.0), *corridor(80.0))
    pairs = list(split_odometry(log))
    alone, disturbed = (FixedLagMapper(odometry_sigma=log.odometry_sigma) for _ in range(2))
    for k, (odometry, cycle) in enumerate(pairs):
        mine = alone.update(odometry, cycle)
        other = disturbed.update(odometry, cycle)
        assert other.refused == (1 if k == 46 else 0)
        np.testing.assert_array_equal(mine.pose, other.pose)
        if k == 45:
            with pytest.raises(ReadingError, match=r"inside the window, from 1\.5 s on"):
                disturbed.update(NO_TWISTS, pairs[10][1])
