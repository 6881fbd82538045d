"""The poses of before the loop closure in the final map: rigid motions that are known by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.start import unwrap
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.drive_record import Place, curve_poses, in_final_map
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import state_of

Array = NDArray[np.float64]

SETTINGS = MapperSettings()
CLOSED_AT = 8
POSES = np.column_stack([np.arange(2.0, 22.0, 2.0), np.zeros(10), np.full(10, 0.05)])
"""The vehicle drives along x, and turns a little to the left of it. The loop closes in its ninth cycle."""
TURN, SHIFT = 0.3, np.array([4.0, -7.0])
"""The loop closure turns the map by this (rad), and then shifts it by this (m)."""


def turned(points: Array) -> Array:
    """Returns points (m, 2) of the map before the closure in the map after it."""
    c, s = np.cos(TURN), np.sin(TURN)
    return points @ np.array([[c, s], [-s, c]]) + SHIFT


def final_state() -> State:
    """Returns lines 2 m to the left and to the right of the x axis, moved by the closure."""
    x = np.arange(0.0, 41.0, 2.0)
    lines = {label: np.column_stack([x, np.full(len(x), y)]) for label, y in ((LEFT, 2.0), (RIGHT, -2.0))}
    return state_of({label: turned(points) for label, points in lines.items()}, POSES)


def places_of(y: float, cycles: range = range(10), heading: float = 0.0) -> list[Place]:
    """Returns the places of the poses along a line at y, as it was before the closure.

    The parameter of the final curve is the distance from its beginning.
    """
    return [Place(k, float(POSES[k, 0]), np.array([POSES[k, 0], y, heading])) for k in cycles]


def test_earlier_poses_move_rigidly_with_the_curves_beside_them() -> None:
    places = {LEFT: places_of(2.0), RIGHT: places_of(-2.0)}
    poses = in_final_map(POSES, CLOSED_AT, places, final_state(), SETTINGS)
    np.testing.assert_allclose(poses[:CLOSED_AT, :2], turned(POSES[:CLOSED_AT, :2]), atol=1e-6)
    np.testing.assert_allclose(poses[:CLOSED_AT, 2], POSES[:CLOSED_AT, 2] + TURN, atol=1e-6)
    np.testing.assert_array_equal(poses[CLOSED_AT:], POSES[CLOSED_AT:])


def test_the_two_boundaries_have_equal_weight() -> None:
    """The left curve was 0.5 m nearer to the vehicle then, so that the mean is 0.25 m farther left."""
    places = {LEFT: places_of(1.5), RIGHT: places_of(-2.0)}
    poses = in_final_map(POSES, CLOSED_AT, places, final_state(), SETTINGS)
    expected = turned(POSES[:CLOSED_AT, :2] + [0.0, 0.25])
    np.testing.assert_allclose(poses[:CLOSED_AT, :2], expected, atol=1e-6)


def test_a_pose_beside_no_curve_is_corrected_as_its_neighbours_are() -> None:
    places = {LEFT: places_of(2.0, range(2, 4)) + places_of(2.0, range(6, 8)), RIGHT: []}
    poses = in_final_map(POSES, CLOSED_AT, places, final_state(), SETTINGS)
    correction = poses - POSES
    np.testing.assert_allclose(correction[[0, 1]], correction[[2, 2]], atol=1e-9)
    np.testing.assert_allclose(correction[4], (2.0 * correction[3] + correction[6]) / 3.0, atol=1e-9)


def test_a_curve_that_is_far_or_runs_the_other_way_is_not_beside_the_vehicle() -> None:
    far = SETTINGS.growth.max_lateral + 0.1
    for places in (places_of(far), places_of(2.0, heading=np.pi)):
        poses = in_final_map(POSES, CLOSED_AT, {LEFT: places, RIGHT: []}, final_state(), SETTINGS)
        np.testing.assert_array_equal(poses, POSES)


def test_the_turn_is_the_shorter_one() -> None:
    """A curve that ran along -x before may have a direction of pi or -pi."""
    places = {LEFT: [], RIGHT: places_of(-2.0, heading=2.0 * np.pi)}
    poses = in_final_map(POSES, CLOSED_AT, places, final_state(), SETTINGS)
    np.testing.assert_allclose(poses[:CLOSED_AT, 2], POSES[:CLOSED_AT, 2] + TURN, atol=1e-6)


def test_the_pose_of_a_curve_is_its_point_and_its_direction() -> None:
    state = final_state()
    (pose,) = curve_poses(state.boundaries[LEFT], state.control_points(LEFT), np.array([10.0]))
    np.testing.assert_allclose(pose, [*turned(np.array([[10.0, 2.0]]))[0], TURN], atol=1e-6)


def test_unwrapped_headings_have_no_jump() -> None:
    poses = np.column_stack([np.zeros((3, 2)), [3.0, -3.0, -2.9]])
    np.testing.assert_allclose(unwrap(poses)[:, 2], [3.0, 2.0 * np.pi - 3.0, 2.0 * np.pi - 2.9])
    assert unwrap(np.zeros((0, 3))).shape == (0, 3)
