"""Cones as clusters of detections, including those that the curve cuts off."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pathspace_graph.batch.association import (
    Cones,
    along_drive,
    associate,
    cluster,
    cones_of_curve,
    without_folds,
)
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import state_of, straight

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


def detected(u: Array, each: int, noise: float) -> tuple[Array, Array]:
    """Returns detections (m, 2) of cones at u (k,) on the x axis, and their parameters (m,) along it."""
    rng = np.random.default_rng(1)
    x = np.repeat(u, each) + rng.normal(0.0, noise, len(u) * each)
    return np.column_stack([x, rng.normal(0.0, noise, len(x))]), x


def round_covariances(information: ArrayLike) -> Array:
    """Return covariances (m, 2, 2) that are the same in every direction, of an information (m,)."""
    return np.eye(2) / np.asarray(information)[:, None, None]


def test_every_cluster_is_a_cone() -> None:
    true = np.arange(2.0, 60.0, 4.0)
    points, u = detected(true, 30, 0.1)
    cones = cluster(points, u, round_covariances(np.ones(len(u))), 62.0, False, SETTINGS)
    np.testing.assert_allclose(cones.points, np.column_stack([true, np.zeros(len(true))]), atol=0.1)
    np.testing.assert_array_equal(cones.count, np.full(len(true), 30))


def test_detections_on_both_sides_of_the_beginning_of_a_closed_curve_are_of_one_cone() -> None:
    u = np.array([0.2, 19.9, 19.9, 8.0, 8.4, 8.4])
    points = np.column_stack([np.mod(u + 10.0, 20.0), np.zeros(6)])
    cones = cluster(points, u, round_covariances([2.0, 1.0, 1.0, 3.0, 0.5, 0.5]), 20.0, True, SETTINGS)
    np.testing.assert_array_equal(cones.count, [3, 3])
    np.testing.assert_allclose(np.sort(cones.points[:, 0]), [10.05, 18.1])


def test_a_cone_stands_where_smeared_rays_meet() -> None:
    """Far detections from one side lie along their ray; those along another ray say where on it."""
    cone, along = np.array([10.0, 0.5]), np.array([[1.0, 0.0], [0.6, 0.8]])
    off = np.array([-1.0, -0.6, 0.2, 0.9])
    points = cone + np.concatenate([off[:, None] * ray for ray in along])
    of_ray = [0.01 * np.eye(2) + 4.0 * np.outer(ray, ray) for ray in along]
    cones = cluster(points, points[:, 0], np.repeat(of_ray, len(off), axis=0), 20.0, False, SETTINGS)
    np.testing.assert_allclose(cones.points, [cone], atol=0.02)


def test_a_cluster_of_few_detections_is_no_cone() -> None:
    true = np.arange(2.0, 60.0, 4.0)
    points, u = detected(true, 60, 0.1)
    others, others_u = detected(np.array([4.0, 24.0]), 4, 0.05)
    points, u = np.concatenate([points, others]), np.append(u, others_u)
    cones = cluster(points, u, round_covariances(np.ones(len(u))), 62.0, False, SETTINGS)
    assert len(cones.u) == len(true)


def test_a_cone_at_which_the_row_folds_back_is_a_duplicate() -> None:
    x = np.array([0.0, 4.0, 8.0, 7.4, 12.0, 16.0])
    cones = Cones(np.column_stack([x, np.zeros(6)]), np.arange(6.0), np.full(6, 9))
    assert (np.diff(without_folds(cones, False).points[:, 0]) > 0.0).all()


def test_a_cone_that_the_curve_cuts_off_is_found_as_well() -> None:
    """Its detections are too far away to be used, but are clustered all the same."""
    system, state = straight()
    detections = system.detections
    before = cones_of_curve(state, detections, LEFT, system.settings)
    k = len(before.u) // 2
    own = np.flatnonzero((detections.label == LEFT) & (np.abs(detections.u - before.u[k]) < 1.0))
    detections.measured[own] += np.array([0.0, 1.8])
    detections.release(own)
    after = cones_of_curve(state, detections, LEFT, system.settings)
    assert len(after.u) == len(before.u)
    np.testing.assert_allclose(after.points[k] - before.points[k], [0.0, 1.8], atol=0.05)


def test_cones_are_passed_in_the_order_of_the_drive() -> None:
    """The curve of a hairpin had two of its cones in the wrong order."""
    phi = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 20)
    bend = np.column_stack([10.0 + 4.0 * np.cos(phi), 4.0 * np.sin(phi), phi + 0.5 * np.pi])
    out = np.column_stack([np.arange(0.0, 10.0), np.full(10, -4.0), np.zeros(10)])
    back = np.column_stack([np.arange(9.0, -1.0, -1.0), np.full(10, 4.0), np.full(10, np.pi)])
    lap = np.concatenate([out, bend, back])
    true = np.array(
        [[1.2, -1.5], [5.0, -1.5], [10.0, -1.5], [11.5, 0.2], [10.0, 1.5], [5.3, 1.5], [1.0, 1.5]]
    )
    wrong = np.array([0, 1, 4, 3, 2, 5, 6])
    cones = Cones(true[wrong], np.arange(7.0), wrong)
    passed = along_drive(cones, lap, lambda i, j: 0 * (i + j) > 0, LEFT)
    np.testing.assert_array_equal(passed.points, true)
    np.testing.assert_array_equal(passed.count, np.arange(7))


def test_a_cone_behind_the_row_is_none_of_it() -> None:
    """Far detections of two parallel rows, smeared along their rays, have their mean between the rows."""
    x = np.arange(0.0, 20.0)
    lap = np.column_stack([x, np.zeros(20), np.zeros(20)])
    row = np.column_stack([np.arange(1.0, 18.0, 4.0), [-2.0, -2.6, -3.2, -2.6, -2.0]])
    cones = Cones(np.concatenate([row, [[10.0, -4.4]]]), np.arange(6.0), np.full(6, 9))
    np.testing.assert_array_equal(along_drive(cones, lap, lambda i, j: 0 * (i + j) > 0, RIGHT).points, row)


def test_a_row_between_two_lanes_is_the_cones_of_both() -> None:
    """The left row runs out along y = 0 and back along it, and the way back is nearer to its cones.

    Each of the six cones between the lanes is on the curve twice, and the drive passes them in order.
    """
    x, there = np.arange(4.0, 25.0, 4.0), np.column_stack([np.arange(29.0), np.zeros(29)])
    row = np.column_stack([x, np.zeros(6)])
    phi = np.linspace(0.0, 2.0 * np.pi, 38)[1:-1]
    turn = np.column_stack([28.0 + 12.0 * np.sin(0.5 * phi), 6.0 * np.sin(phi)])
    curve = np.concatenate([there, turn, there[::-1], np.array([28.0, 0.0]) - turn])
    along = np.arange(0.0, 29.0, 1.0)
    out = np.column_stack([along, np.full(29, -2.4), np.zeros(29)])
    back = np.column_stack([along[::-1], np.full(29, 1.6), np.full(29, np.pi)])
    state = state_of({LEFT: curve}, np.concatenate([out, back]), periodic=True)
    table = DetectionTable()
    for cycle, pose in enumerate(state.poses):
        local = to_vehicle(row, np.tile(pose, (len(row), 1)))
        local = local[(local[:, 0] > -3.0) & (local[:, 0] < 14.0)]
        covariances = np.tile(0.01 * np.eye(2), (len(local), 1, 1))
        table.append(Detections(float(cycle), local, covariances, np.full(len(local), LEFT)), cycle)
    associate(state, table, SETTINGS, 4.0, strict=True)
    cones = cones_of_curve(state, table, LEFT, SETTINGS)
    np.testing.assert_allclose(cones.points[:, 0], [*x, *x[::-1]], atol=1e-6)
