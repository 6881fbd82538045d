"""Which curve each detection belongs to, and where each pose is along it, on curves made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.association import associate
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import detections_of, ring, state_of

Array = NDArray[np.float64]

SETTINGS = replace(MapperSettings(), spline=replace(MapperSettings().spline, sigma_model=0.3))
SIGMA = 0.4
"""This is the standard deviation of a detection (m). Across a curve it is 0.5 m with `sigma_model`."""
GATE = 4.0


def line(y: float, length: float = 60.0) -> Array:
    """Returns points on a line along x."""
    x = np.arange(0.0, length + 1.0, 2.0)
    return np.column_stack([x, np.full(len(x), y)])


def corridor_state() -> State:
    """Returns lines 2 m to both sides of a single pose at (20, 0) that heads along x."""
    return state_of({LEFT: line(2.0), RIGHT: line(-2.0)}, np.array([[20.0, 0.0, 0.0]]))


def associated(points_map: list[list[float]], labels: list[int], strict: bool) -> DetectionTable:
    """Returns detections of the pose at (20, 0), after the association."""
    points_vehicle = np.array(points_map) - [20.0, 0.0]
    table = detections_of(points_vehicle, np.array(labels), SIGMA)
    associate(corridor_state(), table, SETTINGS, GATE, strict)
    return table


# --- places of the poses ---------------------------------------------------------------------------------


def test_a_pose_is_beside_the_nearest_point_of_each_curve() -> None:
    state = corridor_state()
    for label, boundary in state.boundaries.items():
        beside = boundary.evaluate(state.control_points(label), state.pose_u[label])
        np.testing.assert_allclose(beside[0, 0], 20.0, atol=0.5)


def test_on_a_closed_curve_the_parameter_goes_on_from_lap_to_lap() -> None:
    phi = np.linspace(0.1, 0.1 + 5.0 * np.pi, 200)
    poses = np.column_stack([10.0 * np.cos(phi), 10.0 * np.sin(phi), phi + 0.5 * np.pi])
    state = state_of({LEFT: ring(8.0)}, poses, periodic=True)
    driven = state.pose_u[LEFT] - state.pose_u[LEFT][0]
    np.testing.assert_allclose(driven, 8.0 * (phi - phi[0]), atol=1.1)


@pytest.mark.parametrize(("heading", "y"), [(0.0, 0.0), (np.pi, 3.0)])
def test_in_a_hairpin_a_pose_is_beside_the_leg_of_its_own_direction(heading: float, y: float) -> None:
    """The pose is nearer to the leg at y = 3 that runs back, or to that at y = 0."""
    phi = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 12)[1:-1]
    bend = np.column_stack([40.0 + 1.5 * np.cos(phi), 1.5 + 1.5 * np.sin(phi)])
    hairpin = np.concatenate([line(0.0, 40.0), bend, line(3.0, 40.0)[::-1]])
    poses = np.array([[20.0, 3.0 - y, heading]])
    state = state_of({LEFT: hairpin}, poses)
    beside = state.boundaries[LEFT].evaluate(state.control_points(LEFT), state.pose_u[LEFT])
    np.testing.assert_allclose(beside[0], [20.0, y], atol=0.5)


def test_an_open_curve_that_lies_over_itself_is_followed_in_the_order_of_the_drive() -> None:
    """It turns by a whole turn and a quarter; the second time the poses are nearer to the first stretch."""
    phi = np.linspace(0.0, 2.5 * np.pi, 120)
    radius = 20.0 + 0.5 * phi / phi[-1]
    spiral = radius[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    poses = np.column_stack([17.0 * np.column_stack([np.cos(phi), np.sin(phi)]), phi + 0.5 * np.pi])
    state = state_of({LEFT: spiral}, poses)
    expected = np.append(0.0, np.cumsum(np.hypot(*np.diff(spiral, axis=0).T)))
    np.testing.assert_allclose(state.pose_u[LEFT], expected, atol=1.5)


def test_a_foot_point_is_found_anywhere_on_a_curve() -> None:
    state = corridor_state()
    points = np.array([[3.0, 5.0], [57.0, -1.0]])
    foot = state.boundaries[LEFT].find_anywhere(state.control_points(LEFT), points)
    np.testing.assert_allclose(foot.position, [[3.0, 2.0], [57.0, 2.0]], atol=1e-6)
    np.testing.assert_allclose(foot.distance, [3.0, -3.0], atol=1e-6)


# --- detections ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strict", [False, True])
def test_a_detection_within_the_gate_is_used_at_its_foot_point(strict: bool) -> None:
    """The gate is 4 sigmas of 0.5 m."""
    table = associated([[25.0, 3.9], [25.0, 4.1], [30.0, -3.9]], [LEFT, LEFT, RIGHT], strict)
    np.testing.assert_array_equal(table.used, [True, False, True])
    np.testing.assert_array_equal(table.boundary, [LEFT, LEFT, RIGHT])
    state = corridor_state()
    for row, x in ((0, 25.0), (2, 30.0)):
        label = int(table.boundary[row])
        foot = state.boundaries[label].evaluate(state.control_points(label), table.u[[row]])
        np.testing.assert_allclose(foot[0, 0], x, atol=1e-4)


def test_a_colour_is_believed() -> None:
    """A left detection on the right curve isn't used."""
    table = associated([[25.0, -2.0]], [LEFT], strict=True)
    assert not table.used.any()


def test_an_unknown_colour_goes_to_the_better_fit_but_only_in_the_end() -> None:
    points, labels = [[25.0, 0.4], [25.0, -0.4]], [UNKNOWN, UNKNOWN]
    assert not associated(points, labels, strict=False).used.any()
    table = associated(points, labels, strict=True)
    assert table.used.all()
    np.testing.assert_array_equal(table.boundary, [LEFT, RIGHT])


@pytest.mark.parametrize("periodic", [False, True])
def test_what_lies_out_of_view_is_searched_for_only_in_the_end_and_on_closed_curves(periodic: bool) -> None:
    """The pose sees 4 m behind it and 25 m ahead along a circle, and some metres of room. Its detections of
    the far side are on the curve, but an open curve may have drifted there by any distance."""
    points = ring(30.0) if periodic else ring(30.0)[:-4]
    state = state_of({LEFT: points}, np.array([[28.0, 0.0, 0.5 * np.pi]]), periodic)
    table = detections_of(np.array([[5.0, -2.0], [0.0, 58.0]]), np.array([LEFT, LEFT]), 0.5)
    for strict in (False, True):
        associate(state, table, SETTINGS, GATE, strict)
        np.testing.assert_array_equal(table.used, [True, strict and periodic])


@pytest.mark.parametrize(("y", "own"), [(1.2, True), (1.9, True), (2.1, False)])
@pytest.mark.parametrize("strict", [False, True])
def test_a_detection_belongs_to_the_nearer_of_two_lanes(y: float, own: bool, strict: bool) -> None:
    """The row runs out along y = 0 and back along y = 3, and the gate is wide enough for both.

    A detection beyond the middle may be the nearer one's by errors of a merge radius.
    """
    phi = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)[1:-1]
    bend = np.column_stack([60.0 + 1.5 * np.cos(phi), 1.5 + 1.5 * np.sin(phi)])
    back = np.array([60.0, 3.0]) - bend
    lanes = np.concatenate([line(0.0), bend, line(3.0)[::-1], back])
    state = state_of({LEFT: lanes}, np.array([[20.0, -2.0, 0.0]]), periodic=True)
    table = detections_of(np.array([[5.0, y + 2.0]]), np.array([LEFT]), SIGMA)
    associate(state, table, SETTINGS, 9.0, strict)
    assert bool(table.used[0]) is (own or strict)
    if table.used[0]:
        foot = state.boundaries[LEFT].evaluate(state.control_points(LEFT), table.u)
        np.testing.assert_allclose(foot[0], [25.0, 0.0 if own else 3.0], atol=0.1)


def test_a_detection_beyond_the_end_of_a_curve_is_not_used() -> None:
    assert not associated([[62.0, 2.0]], [LEFT], strict=True).used.any()


def test_what_was_used_before_is_associated_anew() -> None:
    table = detections_of(np.array([[5.0, 9.0]]), np.array([LEFT]), SIGMA)
    table.take(np.array([0]), LEFT, np.array([25.0]))
    associate(corridor_state(), table, SETTINGS, GATE, strict=True)
    assert not table.used.any()
