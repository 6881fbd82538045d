"""The map's curves of few knots, and their covariance, from those of the optimum."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.knots import reknot
from pathspace_graph.batch.simplification import new_from_old, simplify
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import settled, straight

Array = NDArray[np.float64]


def dense_scene() -> tuple[State, DetectionTable, MapperSettings]:
    """A straight drive beside curves of nearly a control point for each cone."""
    system, state = straight()
    state = reknot(state, system.detections, system.settings, dense=True)
    system.begin(state)
    return settled(system, state), system.detections, system.settings


def by_shift(state: State, axis: int) -> Array:
    """(n,) derivative of all control points by a shift of the map."""
    return np.tile(np.eye(2)[axis], len(state.map_points))


def by_turn(state: State) -> Array:
    """(n,) the same by a turn about the origin."""
    return np.column_stack([-state.map_points[:, 1], state.map_points[:, 0]]).ravel()


def test_the_drive_stays_and_the_curves_have_fewer_control_points_on_the_same_lines() -> None:
    state, detections, settings = dense_scene()
    thin, _ = simplify(state, np.eye(state.map_points.size), detections, settings)
    np.testing.assert_array_equal(thin.poses, state.poses)
    np.testing.assert_array_equal(thin.calibration, state.calibration)
    for label, boundary in thin.boundaries.items():
        assert boundary.size < state.boundaries[label].size
        u = np.linspace(boundary.tables.low, boundary.tables.high, 50)
        y = boundary.evaluate(thin.control_points(label), u)[:, 1]
        np.testing.assert_allclose(np.abs(y), 2.0, atol=1e-3)


def test_a_map_that_is_uncertain_as_a_whole_stays_so() -> None:
    """`F 1 = 1`, and F takes the control points of a line to those of the same line."""
    state, detections, settings = dense_scene()
    for direction in (lambda s: by_shift(s, 0), lambda s: by_shift(s, 1), by_turn):
        dense = direction(state)
        thin, covariance = simplify(state, np.outer(dense, dense), detections, settings)
        expected = direction(thin)
        across = np.arange(1, thin.map_points.size, 2)
        np.testing.assert_allclose(
            covariance[np.ix_(across, across)],
            np.outer(expected, expected)[np.ix_(across, across)],
            atol=0.05,
        )


def test_a_curve_on_its_own_knots_is_itself() -> None:
    state, _, _ = dense_scene()
    for label, boundary in state.boundaries.items():
        points = state.control_points(label)
        np.testing.assert_allclose(
            new_from_old(boundary, points, boundary, points), np.eye(boundary.size), atol=1e-6
        )
