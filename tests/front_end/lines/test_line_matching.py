"""Scan matching for points of a line, and the merging of dense ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import left_of, rotation, to_map, to_vehicle
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.front_end.scan_matching import (
    FARTHEST,
    LEAST_INSIDE,
    LEAST_POINTS,
    LEAST_SHAPE,
    LEAST_SPREAD,
    LINE_HELD,
    LINE_REACH,
    LINES_ALIKE,
    MOST_MISFIT,
    REACH_LAST,
    REACHES,
    SCAN_HUBER,
    SIGMA_CONE,
    ScanMatcher,
    Seen,
    merged,
)
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings, MotionSettings

from ...scenes.drives import detections
from ...scenes.lines import line_drive

Array = NDArray[np.float64]
AT = np.arange(0.0, 15.0, 0.4)
CORRIDOR = np.concatenate([np.column_stack([AT, np.full(len(AT), side)]) for side in (2.0, -2.0)])


def beside(points: Array) -> ScanMatcher:
    """Points of lines that were seen once, from the origin."""
    matcher = ScanMatcher(MotionSettings(), of_lines=True)
    for few in np.array_split(points, -(-len(points) // 20)):
        matcher.remember(detections(0.0, few, np.zeros(len(few), np.intp)), np.zeros(3), np.zeros(3))
    return matcher


def targets(placed: Array, recent: Array, reach: float) -> tuple[Array, Array, Array, Array]:
    """Offsets (m, 2) from the lines beside placed points, weights (m,), normals (m, 2), and which have one.

    The oracle of the kernels, from the weighted covariance of the recent points.
    """
    off, weights, normals, matched, reach = [], [], [], [], LINE_REACH * reach
    for point in placed:
        square = ((recent - point) ** 2).sum(axis=1) / reach**2
        weight = np.where(square < FARTHEST**2, np.exp(-0.5 * square), 0.0)
        total = max(weight.sum(), np.finfo(float).tiny)
        mean = weight @ recent / total
        spread = (recent - mean).T @ (weight[:, None] * (recent - mean)) / total
        (across, along), axes = np.linalg.eigh(spread)
        is_line = (
            total > LEAST_POINTS and along > (LEAST_SPREAD * reach) ** 2 and along > LEAST_SHAPE * across
        )
        off.append(point - mean)
        weights.append(total)
        normals.append(axes[:, 0])
        matched.append(is_line and abs((point - mean) @ axes[:, 1]) < LEAST_INSIDE * reach)
    return np.array(off), np.array(weights), np.array(normals), np.array(matched)


def test_the_match_is_that_of_the_formula() -> None:
    """One step from a pose beside the solution, and information and misfit there."""
    rng, start = np.random.default_rng(0), np.array([0.3, 0.1, 0.05])
    recent = CORRIDOR + 0.1 * rng.standard_normal(CORRIDOR.shape)
    seen = Seen(CORRIDOR[::3] + 0.2 * rng.standard_normal((26, 2)), rng.uniform(0.01, 0.04, 26))
    turn = np.eye(3)
    turn[:2, :2] = rotation(start[2])
    held = turn @ np.diag(1.0 / LINE_HELD) @ turn.T

    def system(pose: Array, reach: float) -> tuple[Array, Array, Array, Array]:
        placed = to_map(seen.points, pose[None])
        off, weights, normals, matched = targets(placed, recent, reach)
        across, variances = (
            (off * normals).sum(axis=1),
            seen.variances * (1.0 + 1.0 / weights) + SIGMA_CONE**2,
        )
        precision = matched * huber_weights(across / np.sqrt(variances), SCAN_HUBER) / variances
        rows = np.column_stack([normals, (normals * left_of(placed - pose[:2])).sum(axis=1)])
        hessian, gradient = rows.T @ (precision[:, None] * rows), rows.T @ (precision * across)
        return hessian, gradient, matched, across**2 / variances

    matcher = beside(recent)
    found = matcher.match(seen, start, [0.7])
    assert found is not None
    hessian, gradient, *_ = system(start, 0.7)
    np.testing.assert_allclose(found.pose, start - np.linalg.solve(hessian + held, gradient), atol=1e-10)
    hessian, _, matched, squares = system(found.pose, 0.7)
    assert 10 < matched.sum() < 26
    covariance = np.linalg.inv(hessian + held) + turn @ np.diag(LINES_ALIKE) @ turn.T
    np.testing.assert_array_equal(found.is_matched, matched)
    np.testing.assert_allclose(np.linalg.inv(found.information), covariance, rtol=1e-7, atol=1e-11)
    assert found.misfit == pytest.approx(squares[matched].mean())
    *_, matched, squares = system(start, REACH_LAST)
    squares = np.where(matched, squares, MOST_MISFIT)
    assert matcher.misfit(seen, start) == pytest.approx(np.minimum(squares, MOST_MISFIT).mean())


def test_a_point_is_drawn_across_the_line_beside_it_and_one_beyond_its_end_is_not() -> None:
    """Of points beside both walls, all are 0.3 m to the left, and one is beyond their end."""
    points = np.array([[3.1, 2.3], [7.0, 2.3], [11.2, 2.3], [5.0, -1.7], [9.1, -1.7], [16.2, 2.0]])
    found = beside(CORRIDOR).match(Seen(points, np.full(6, 0.01)), np.zeros(3), REACHES)
    assert found is not None
    assert found.is_matched.tolist() == [True] * 5 + [False]
    np.testing.assert_allclose(found.pose[1:], [-0.3, 0.0], atol=0.02)


def test_a_blob_of_points_is_no_line() -> None:
    blob = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.5, 0.5]])
    seen = Seen(np.full((4, 2), 0.25), np.full(4, 0.01))
    assert beside(blob).match(seen, np.zeros(3), [1.0]) is None
    assert beside(blob).misfit(seen, np.zeros(3)) == MOST_MISFIT


def test_walls_tell_the_way_across_and_the_turn_and_nothing_along() -> None:
    """The vehicle is 0.2 m to the left and turned by 0.02 rad; its points are at other places than before."""
    true = np.array([0.0, 0.2, 0.02])
    points = to_vehicle(CORRIDOR + np.array([0.17, 0.0]), np.tile(true, (len(CORRIDOR), 1)))
    found = beside(CORRIDOR).match(Seen(points, np.full(len(points), 0.01)), np.zeros(3), REACHES)
    assert found is not None
    np.testing.assert_allclose(found.pose, true, atol=2e-3)
    sigmas = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert sigmas[0] > 1.0
    assert sigmas[1] < 0.06
    assert sigmas[2] < 0.01
    assert found.matched >= len(points) - 4
    assert found.misfit < 1e-2


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
