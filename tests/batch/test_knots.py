"""Knots of the batch's curves: how many there are, and what follows from the settings."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.simplification import MIN_SIZE_SHARE, boundary_of, fit_through, reknot
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import ring, straight

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


def zigzag_ring(count: int) -> Array:
    """Returns cones (count, 2) that lie in turn 0.2 m outside and inside of a circle."""
    return ring(20.0, count) * (1.0 + 0.01 * (-1.0) ** np.arange(count))[:, None]


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_fit_has_at_most_its_share_of_control_points(share: float) -> None:
    """It has at least the settings' share of that number."""
    spline, _ = fit_through(zigzag_ring(60), True, SETTINGS, share)
    assert int(MIN_SIZE_SHARE * int(share * 60)) <= spline.size <= int(share * 60)
    assert spline.periodic


def test_a_fit_has_the_least_size_where_there_are_few_cones() -> None:
    assert fit_through(ring(8.0, 12), True, SETTINGS, 0.3)[0].size == SETTINGS.spline.min_size


def test_a_dense_fit_meets_its_cones() -> None:
    cones = zigzag_ring(40)
    spline, _ = fit_through(cones, True, SETTINGS, SETTINGS.batch.dense_share, 1.0)
    assert spline.size == 40
    assert np.abs(spline.foot_points(cones).distance).max() < 0.02


def test_a_closed_curve_begins_at_the_cone_nearest_to_the_start() -> None:
    """So it doesn't matter with which cone the row begins."""
    cones = zigzag_ring(40) + np.array([20.0, 0.0])
    one, other = (
        fit_through(np.roll(cones, k, axis=0), True, SETTINGS, SETTINGS.batch.dense_share, 1.0)[0]
        for k in (0, 7)
    )
    np.testing.assert_allclose(one.knots, other.knots)
    np.testing.assert_allclose(one.control_points, other.control_points)


def test_a_boundary_of_a_curve_is_that_curve_all_of_it_confirmed() -> None:
    """Its foot points are more exact than online."""
    spline, _ = fit_through(np.column_stack([np.arange(0.0, 40.0, 2.0), np.zeros(20)]), False, SETTINGS, 0.5)
    boundary, points = boundary_of(spline, SETTINGS)
    u = np.linspace(*spline.domain, 30)
    np.testing.assert_allclose(boundary.evaluate(points, u), spline.evaluate(u), atol=1e-9)
    assert boundary.confirmed_end == boundary.tables.high
    assert boundary.settings.refine_room > SETTINGS.spline.refine_room
    assert boundary.settings.search_iterations > SETTINGS.spline.search_iterations


def test_new_knots_leave_the_poses_and_the_given_state_as_they_are() -> None:
    system, state = straight()
    sizes = {label: boundary.size for label, boundary in state.boundaries.items()}
    dense = reknot(state, system.detections, system.settings)
    np.testing.assert_array_equal(dense.poses, state.poses)
    for label, boundary in dense.boundaries.items():
        assert boundary.size > sizes[label] == state.boundaries[label].size
