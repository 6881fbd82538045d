"""Mistakes: what each does to a log, by hand."""

from __future__ import annotations

import numpy as np

from ..plausibility.mistakes import MISTAKES, dead_reckoned, detections_in_the_map, in_frame, late
from ..scenes.batch import course_log

LOG = course_log(0.5)


def test_a_sensor_frame_moves_points_and_turns_covariances() -> None:
    turned = in_frame(LOG, turn=0.5 * np.pi, ahead=1.0, left=2.0)
    before, after = LOG.cycles[3], turned.cycles[3]
    x, y = (before.points_vehicle - [1.0, 2.0]).T
    np.testing.assert_allclose(after.points_vehicle, np.column_stack([y, -x]), atol=1e-12)
    np.testing.assert_allclose(after.covariances[:, 0, 0], before.covariances[:, 1, 1])


def test_dead_reckoning_is_the_true_path_of_an_exact_log() -> None:
    assert LOG.truth is not None
    np.testing.assert_allclose(dead_reckoned(LOG), LOG.truth.poses, atol=1e-3)


def test_detections_in_the_map_lie_on_the_cones() -> None:
    assert LOG.truth is not None
    points = np.concatenate([cycle.points_vehicle for cycle in detections_in_the_map(LOG).cycles])
    off = np.linalg.norm(points[:, None] - LOG.truth.cones, axis=2).min(axis=1)
    assert off.max() < 1e-2


def test_late_detections_stay_within_the_log() -> None:
    spoiled = late(LOG, 1.0)
    assert spoiled.cycles[0].t == LOG.cycles[0].t + 1.0
    assert spoiled.cycles[-1].t <= LOG.odometry.t[-1]


def test_no_mistake_changes_the_log_that_it_is_given() -> None:
    before = [cycle.points_vehicle.copy() for cycle in LOG.cycles], LOG.odometry.twist.copy()
    for mistake in MISTAKES.values():
        mistake(LOG)
    for cycle, points in zip(LOG.cycles, before[0], strict=True):
        np.testing.assert_array_equal(cycle.points_vehicle, points)
    np.testing.assert_array_equal(LOG.odometry.twist, before[1])
