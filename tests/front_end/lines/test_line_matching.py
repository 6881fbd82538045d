"""Scan matching for points of a line, and the merging of dense ones."""

from __future__ import annotations

import numpy as np

from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.front_end.scan_matching import (
    MATCH_LIMITS,
    REACHES,
    LineMatch,
    Seen,
    merged,
    targets_on_lines,
)
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.lines import line_drive

AT = np.arange(0.0, 15.0, 0.4)
CORRIDOR = np.concatenate([np.column_stack([AT, np.full(len(AT), side)]) for side in (2.0, -2.0)])


def test_a_point_is_drawn_across_the_line_beside_it() -> None:
    """Of three points beside y = 2, one is 0.3 m off, one lies on it, and one is beyond its end."""
    placed = np.array([[6.1, 2.3], [7.0, 2.0], [16.2, 2.0]])
    found = targets_on_lines(placed, CORRIDOR[CORRIDOR[:, 1] > 0.0], 1.0, 3.0)
    assert found.matched.tolist() == [True, True, False]
    np.testing.assert_allclose(np.abs(found.normals[:2]), [[0.0, 1.0], [0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(
        (found.off * found.normals).sum(axis=1)[:2] * found.normals[:2, 1], [0.3, 0.0], atol=1e-9
    )


def test_a_blob_of_points_is_no_line() -> None:
    blob = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.5, 0.5]])
    assert not targets_on_lines(np.array([[0.25, 0.25]]), blob, 1.0, 3.0).matched.any()


def test_walls_tell_the_way_across_and_the_turn_and_nothing_along() -> None:
    """The vehicle is 0.2 m to the left and turned by 0.02 rad; its points are at other places than before."""
    true = np.array([0.0, 0.2, 0.02])
    points = to_vehicle(CORRIDOR + np.array([0.17, 0.0]), np.tile(true, (len(CORRIDOR), 1)))
    seen = Seen(points, np.full(len(points), 0.01))
    match = LineMatch(CORRIDOR, seen, MATCH_LIMITS)
    pose, information, matched, square = match.found(np.zeros(3), REACHES)
    np.testing.assert_allclose(pose, true, atol=2e-3)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    assert sigmas[0] > 1.0
    assert sigmas[1] < 0.06
    assert sigmas[2] < 0.01
    assert matched.sum() >= len(points) - 4
    assert square / matched.sum() < 1e-2


def test_points_of_a_line_in_one_cell_become_their_mean() -> None:
    points = np.array([[3.1, 2.0], [3.3, 2.2], [3.5, 2.4], [4.5, 2.0], [3.2, 2.1]])
    labels = np.array([LEFT, LEFT, LEFT, LEFT, RIGHT])
    found = merged(Detections(1.0, points, np.tile(0.04 * np.eye(2), (5, 1, 1)), labels))
    by_x = np.argsort(found.points_vehicle[:, 0], kind="stable")
    np.testing.assert_allclose(found.points_vehicle[by_x], [[3.2, 2.1], [3.3, 2.2], [4.5, 2.0]])
    assert found.labels[by_x].tolist() == [RIGHT, LEFT, LEFT]
    variances = found.covariances[by_x][:, 0, 0]
    np.testing.assert_allclose(variances, [0.04, 0.04 / 3.0, 0.04])


def test_cells_double_with_the_range() -> None:
    x = np.array([10.2, 11.2, 12.2, 13.8, 14.2, 24.2, 27.8, 28.2])
    points = np.column_stack([x, np.full(8, 0.5)])
    cycle = Detections(1.0, points, np.tile(0.04 * np.eye(2), (8, 1, 1)), np.full(8, LEFT))
    found = np.sort(merged(cycle).points_vehicle[:, 0])
    np.testing.assert_allclose(found, [10.2, 11.2, 13.0, 14.2, 26.0, 28.2])


def test_good_odometry_along_lines_is_not_doubted() -> None:
    log = line_drive(2, 0.5)
    front_end = FrontEnd(MapperSettings(kind="line"), log.noise)
    readings = [front_end.update(*cycle) for cycle in split_odometry(log)]
    assert not any(reading.motion.fault for reading in readings)
    assert not readings[-1].sensor_doubted
    assert np.mean([reading.seen_again.mean() for reading in readings[10:]]) > 0.7
