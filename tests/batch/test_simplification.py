"""The map's curves on few knots with their covariance, and the scatter of cones about them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.association import cones_of_curve, points_along
from pathspace_graph.batch.simplification import Scatter, cross_validated, fit_line, reknot, simplified
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import sampled

from ..scenes.batch import settled, straight

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


def dense_scene() -> tuple[State, DetectionTable, MapperSettings]:
    """Returns a straight drive beside curves with about one control point for each cone."""
    system, state = straight()
    state = reknot(state, system.detections, system.settings)
    system.begin(state)
    return settled(system, state), system.detections, system.settings


def by_shift(state: State, axis: int) -> Array:
    """Returns the derivative (n,) of all control points by a shift of the map."""
    return np.tile(np.eye(2)[axis], len(state.map_points))


def by_turn(state: State) -> Array:
    """Returns the derivative (n,) of all control points by a turn of the map about the origin."""
    return np.column_stack([-state.map_points[:, 1], state.map_points[:, 0]]).ravel()


def test_the_poses_stay_and_the_curves_have_fewer_control_points_on_the_same_lines() -> None:
    state, detections, settings = dense_scene()
    few = simplified(state, detections, settings).state
    np.testing.assert_array_equal(few.poses, state.poses)
    np.testing.assert_array_equal(few.variables.calibration, state.variables.calibration)
    for label, boundary in few.boundaries.items():
        assert boundary.size < state.boundaries[label].size
        u = np.linspace(boundary.tables.low, boundary.tables.high, 50)
        y = boundary.evaluate(few.control_points(label), u)[:, 1]
        np.testing.assert_allclose(np.abs(y), 2.0, atol=1e-3)


def test_a_stray_cone_beside_a_curve_does_not_bend_it() -> None:
    """The optimum has left its detections out, which are as many as those of other cones."""
    state, detections, settings = dense_scene()
    along = detections.points_map(slice(None), state.variables)[:, 0]
    own = np.flatnonzero((detections.label == LEFT) & (np.abs(along - 24.0) < 1.0))
    detections.measured[own] += [0.0, 1.2]
    detections.release(own)
    assert (np.abs(cones_of_curve(state, detections, LEFT, settings).points[:, 1] - 3.2) < 0.1).sum() == 1
    few = simplified(state, detections, settings).state
    boundary = few.boundaries[LEFT]
    u = np.linspace(boundary.tables.low, boundary.tables.high, 80)
    np.testing.assert_allclose(boundary.evaluate(few.control_points(LEFT), u)[:, 1], 2.0, atol=0.01)


def test_a_map_that_is_uncertain_as_a_whole_stays_so() -> None:
    """`F 1 = 1`, and F maps the control points of a line to those of the same line."""
    for direction in (lambda s: by_shift(s, 0), lambda s: by_shift(s, 1), by_turn):
        state, detections, settings = dense_scene()
        dense = direction(state)
        simple = simplified(state, detections, settings)
        few, change = simple.state, simple.change
        covariance, expected = change @ np.outer(dense, dense) @ change.T, direction(few)
        across = np.arange(1, few.map_points.size, 2)
        np.testing.assert_allclose(
            covariance[np.ix_(across, across)],
            np.outer(expected, expected)[np.ix_(across, across)],
            atol=0.05,
        )


def test_the_new_control_points_are_linear_in_the_old_ones() -> None:
    """`C_new = F C_old`, and the new curve moves with the old one where that is pushed aside."""
    state, detections, settings = dense_scene()
    simple = simplified(state, detections, settings)
    few, change = simple.state, simple.change
    np.testing.assert_allclose(change @ state.map_points.ravel(), few.map_points.ravel(), atol=1e-6)
    bump = np.zeros_like(state.map_points)
    bump[:, 1] = np.sin(state.map_points[:, 0] / 8.0)
    moved = (change @ bump.ravel()).reshape(-1, 2)[:, 1]
    np.testing.assert_allclose(moved, np.sin(few.map_points[:, 0] / 8.0), atol=0.2)


def test_scatter_grows_from_seen_to_unseen() -> None:
    scatter = Scatter(0.1, 0.4, {LEFT: np.arange(0.0, 40.0, 4.0)}, {LEFT: 40.0})
    sigma = scatter.sigma(LEFT, np.array([8.0, 10.0, 39.0, 36.0]))
    np.testing.assert_allclose(sigma[[0, 3]], 0.1)
    np.testing.assert_allclose(sigma[1] ** 2, 0.01 + 0.25 * 0.15)
    np.testing.assert_allclose(sigma[2] ** 2, 0.01 + 0.0625 * 0.15)
    gap = Scatter(0.1, 0.4, {LEFT: np.array([0.0, 4.0, 8.0, 16.0, 20.0])}, {LEFT: np.inf})
    np.testing.assert_allclose(gap.sigma(LEFT, np.array([12.0])), 0.4)


def test_a_cone_that_is_left_out_shows_how_far_unseen_cones_lie() -> None:
    """That is hardly anything on a circle of exact cones, and far more where they zigzag."""
    phi = 2.0 * np.pi * np.arange(40) / 40
    circle = 20.0 * np.column_stack([np.cos(phi), np.sin(phi)])
    zigzag = circle * (1.0 + 0.02 * (-1.0) ** np.arange(40))[:, None]
    assert len(cross_validated(circle, True, SETTINGS, 0.43)) == 40
    assert np.abs(cross_validated(circle, True, SETTINGS, 0.43)).max() < 0.05
    assert np.sqrt(np.mean(cross_validated(zigzag, True, SETTINGS, 0.43) ** 2)) > 0.3


def test_the_places_of_a_line_are_as_far_apart_as_its_length_allows() -> None:
    """On 9 m there are three places, at 1.5, 4.5 and 7.5 m, each the mean of the points about it."""
    u = np.array([0.1, 1.0, 2.9, 3.2, 5.8, 4.5, 6.2, 8.8, 7.5])
    points = np.column_stack([u, np.tile([0.0, 0.3, -0.3], 3)])
    found = points_along(points, u, np.tile(np.eye(2), (9, 1, 1)), 9.0, True, SETTINGS)
    assert found.u.tolist() == [1.5, 4.5, 7.5]
    assert found.count.tolist() == [3, 3, 3]
    np.testing.assert_allclose(found.points, [[4.0 / 3.0, 0.0], [4.5, 0.0], [7.5, 0.0]], atol=1e-12)


def test_a_line_has_as_few_control_points_as_its_shape_needs() -> None:
    """A circle of 20 m radius on 60 control points needs far fewer within 0.05 m."""
    phi = 2.0 * np.pi * np.arange(120) / 120.0
    circle = 20.0 * np.column_stack([np.cos(phi), np.sin(phi)])
    few, u = fit_line(circle, True, SETTINGS.spline)
    assert 8 <= few.size <= 16
    np.testing.assert_allclose(few.evaluate(u), circle, atol=0.1)
    radii = np.hypot(*sampled(few, 0.5).T)
    assert np.sqrt(np.mean((radii - 20.0) ** 2)) < 0.05
