"""Cones found in heaps of readings: also those that the curve cuts off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.cones import Cones, cluster, cones_of_curve, in_order_of_drive, without_folds
from pathspace_graph.batch.simplification import Scatter, cross_validated
from pathspace_graph.labels import LEFT
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import straight

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


def heaps(u: Array, each: int, noise: float) -> tuple[Array, Array]:
    """Readings about cones on the x axis: points (m, 2), and their places along it (m,)."""
    rng = np.random.default_rng(1)
    x = np.repeat(u, each) + rng.normal(0.0, noise, len(u) * each)
    return np.column_stack([x, rng.normal(0.0, noise, len(x))]), x


def test_every_heap_is_a_cone() -> None:
    true = np.arange(2.0, 60.0, 4.0)
    points, u = heaps(true, 30, 0.1)
    cones = cluster(points, u, np.ones(len(u)), 62.0, False, SETTINGS)
    np.testing.assert_allclose(cones.points, np.column_stack([true, np.zeros(len(true))]), atol=0.1)
    np.testing.assert_array_equal(cones.count, np.full(len(true), 30))


def test_what_is_seen_seldom_is_none() -> None:
    true = np.arange(2.0, 60.0, 4.0)
    points, u = heaps(true, 60, 0.1)
    more, where = heaps(np.array([4.0, 24.0]), 4, 0.05)
    cones = cluster(
        np.concatenate([points, more]), np.append(u, where), np.ones(len(u) + 8), 62.0, False, SETTINGS
    )
    assert len(cones.u) == len(true)


def test_a_cone_put_down_twice_is_one() -> None:
    x = np.array([0.0, 4.0, 8.0, 7.4, 12.0, 16.0])
    cones = Cones(np.column_stack([x, np.zeros(6)]), np.arange(6.0), np.full(6, 9))
    assert (np.diff(without_folds(cones, False, SETTINGS.batch.cones).points[:, 0]) > 0.0).all()


def test_a_cone_that_the_curve_cuts_off_is_one_as_well() -> None:
    """Its readings are too far off to be used, and heaped all the same."""
    system, state = straight()
    detections = system.detections
    one = cones_of_curve(state, detections, LEFT, system.settings)
    k = len(one.u) // 2
    mine = np.flatnonzero((detections.label == LEFT) & (np.abs(detections.u - one.u[k]) < 1.0))
    detections.point[mine] += np.array([0.0, 1.8])
    detections.used[mine] = False
    two = cones_of_curve(state, detections, LEFT, system.settings)
    assert len(two.u) == len(one.u)
    np.testing.assert_allclose(two.points[k] - one.points[k], [0.0, 1.8], atol=0.05)


def test_scatter_grows_from_seen_to_unseen() -> None:
    scatter = Scatter(0.1, 0.4, {LEFT: np.arange(0.0, 40.0, 4.0)}, {LEFT: 40.0})
    sigma = scatter.sigma(LEFT, np.array([8.0, 10.0, 39.0, 36.0]))
    np.testing.assert_allclose(sigma[[0, 3]], 0.1)
    np.testing.assert_allclose(sigma[1] ** 2, 0.01 + 0.25 * 0.15)
    np.testing.assert_allclose(sigma[2] ** 2, 0.01 + 0.0625 * 0.15)
    gap = Scatter(0.1, 0.4, {LEFT: np.array([0.0, 4.0, 8.0, 16.0, 20.0])}, {LEFT: np.inf})
    np.testing.assert_allclose(gap.sigma(LEFT, np.array([12.0])), 0.4)


def test_left_out_is_what_a_missing_cone_is_missed_by() -> None:
    """Hardly anything on a circle of exact cones; far more where they zigzag."""
    phi = 2.0 * np.pi * np.arange(40) / 40
    circle = 20.0 * np.column_stack([np.cos(phi), np.sin(phi)])
    zigzag = circle * (1.0 + 0.02 * (-1.0) ** np.arange(40))[:, None]
    assert len(cross_validated(circle, True, SETTINGS, 0.43)) == 40
    assert np.abs(cross_validated(circle, True, SETTINGS, 0.43)).max() < 0.05
    assert np.sqrt(np.mean(cross_validated(zigzag, True, SETTINGS, 0.43) ** 2)) > 0.3


def test_cones_are_passed_in_the_order_of_the_drive() -> None:
    """Around a hairpin whose curve had taken its cones in another order."""
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
    passed = in_order_of_drive(cones, lap)
    np.testing.assert_array_equal(passed.points, true)
    np.testing.assert_array_equal(passed.count, np.arange(7))
