"""Scan matching for points of a line, and the merging of dense ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import left_of, rotation, to_map, to_vehicle
from pathspace_graph.front_end.front_end import FrontEnd, merged
from pathspace_graph.front_end.motion import MATCHING
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.lines import line_drive

Array = NDArray[np.float64]
AT = np.arange(0.0, 15.0, 0.4)
LINES = replace(MATCHING, of_lines=True)
REACHES = [1.0, 0.8, 0.6, 0.5, 0.4]
CORRIDOR = np.concatenate([np.column_stack([AT, np.full(len(AT), side)]) for side in (2.0, -2.0)])


def targets(placed: Array, recent: Array, reach: float) -> tuple[Array, Array, Array, Array]:
    """Offsets (m, 2) from the lines beside placed points, weights (m,), normals (m, 2), and which have one.

    The oracle of the kernels, from the weighted covariance of the recent points.
    """
    off, weights, normals, matched, reach = [], [], [], [], LINES.line_reach * reach
    for point in placed:
        square = ((recent - point) ** 2).sum(axis=1) / reach**2
        weight = np.where(square < LINES.farthest**2, np.exp(-0.5 * square), 0.0)
        total = max(weight.sum(), np.finfo(float).tiny)
        mean = weight @ recent / total
        spread = (recent - mean).T @ (weight[:, None] * (recent - mean)) / total
        (across, along), axes = np.linalg.eigh(spread)
        is_line = (
            total > LINES.least_points
            and along > (LINES.least_spread * reach) ** 2
            and along > LINES.least_shape * across
        )
        off.append(point - mean)
        weights.append(total)
        normals.append(axes[:, 0])
        matched.append(is_line and abs((point - mean) @ axes[:, 1]) < LINES.least_inside * reach)
    return np.array(off), np.array(weights), np.array(normals), np.array(matched)


def test_the_match_is_that_of_the_formula() -> None:
    """One step from a pose beside the solution, and information and misfit there."""
    rng, start = np.random.default_rng(0), np.array([0.3, 0.1, 0.05])
    recent = CORRIDOR + 0.1 * rng.standard_normal(CORRIDOR.shape)
    points, variances = CORRIDOR[::3] + 0.2 * rng.standard_normal((26, 2)), rng.uniform(0.01, 0.04, 26)
    turn = np.eye(3)
    turn[:2, :2] = rotation(start[2])
    held = turn @ np.diag(np.square(LINES.line_held) ** -1.0) @ turn.T

    def system(pose: Array, reach: float) -> tuple[Array, Array, Array, Array]:
        placed = to_map(points, pose[None])
        off, weights, normals, matched = targets(placed, recent, reach)
        across, spread = (off * normals).sum(axis=1), variances * (1.0 + 1.0 / weights) + LINES.sigma_cone**2
        precision = matched * huber_weights(across / np.sqrt(spread), LINES.huber) / spread
        rows = np.column_stack([normals, (normals * left_of(placed - pose[:2])).sum(axis=1)])
        hessian, gradient = rows.T @ (precision[:, None] * rows), rows.T @ (precision * across)
        return hessian, gradient, matched, across**2 / spread

    pose, information, is_matched, misfit, is_certain = kernels.matched(
        recent, points, variances, start, [0.7], LINES
    )
    assert is_certain
    hessian, gradient, *_ = system(start, 0.7)
    np.testing.assert_allclose(pose, start - np.linalg.solve(hessian + held, gradient), atol=1e-10)
    hessian, _, matched, squares = system(pose, 0.7)
    assert 10 < matched.sum() < 26
    covariance = np.linalg.inv(hessian + held) + turn @ np.diag(np.square(LINES.lines_alike)) @ turn.T
    np.testing.assert_array_equal(is_matched, matched)
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-7, atol=1e-11)
    assert misfit == pytest.approx(squares[matched].mean())
    *_, matched, squares = system(start, 0.4)
    squares = np.where(matched, squares, LINES.most_misfit)
    found = kernels.misfit(recent, points, variances, start, 0.4, LINES)
    assert found == pytest.approx(np.minimum(squares, LINES.most_misfit).mean())


def test_a_point_is_drawn_across_the_line_beside_it_and_one_beyond_its_end_is_not() -> None:
    """Of points beside both walls, all are 0.3 m to the left, and one is beyond their end."""
    points = np.array([[3.1, 2.3], [7.0, 2.3], [11.2, 2.3], [5.0, -1.7], [9.1, -1.7], [16.2, 2.0]])
    pose, _, matched, *_ = kernels.matched(CORRIDOR, points, np.full(6, 0.01), np.zeros(3), REACHES, LINES)
    assert matched.tolist() == [True] * 5 + [False]
    np.testing.assert_allclose(pose[1:], [-0.3, 0.0], atol=0.02)


def test_a_blob_of_points_is_no_line() -> None:
    blob = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.5, 0.5]])
    seen, variances, pose = np.full((4, 2), 0.25), np.full(4, 0.01), np.zeros(3)
    assert not kernels.matched(blob, seen, variances, pose, [1.0], LINES)[-1]
    assert kernels.misfit(blob, seen, variances, pose, 0.4, LINES) == LINES.most_misfit


def test_walls_tell_the_way_across_and_the_turn_and_nothing_along() -> None:
    """The vehicle is 0.2 m to the left and turned by 0.02 rad; its points are at other places than before."""
    true = np.array([0.0, 0.2, 0.02])
    points = to_vehicle(CORRIDOR + np.array([0.17, 0.0]), np.tile(true, (len(CORRIDOR), 1)))
    pose, information, matched, misfit, is_certain = kernels.matched(
        CORRIDOR, points, np.full(len(points), 0.01), np.zeros(3), REACHES, LINES
    )
    assert is_certain
    np.testing.assert_allclose(pose, true, atol=2e-3)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    assert sigmas[0] > 1.0
    assert sigmas[1] < 0.06
    assert sigmas[2] < 0.01
    assert matched.sum() >= len(points) - 4
    assert misfit < 1e-2


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
