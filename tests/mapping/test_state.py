"""The state and its curves side by side: keys, views, the active stretch, and foot points on both."""

from __future__ import annotations

import pickle

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.graph.rows import at_values
from pathspace_graph.graph.variables import CALIBRATION_KEY, control_keys, pose_key, pose_keys, sizes
from pathspace_graph.graph.window import user_rows
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.state import GivenFactor, State
from pathspace_graph.settings.mapper import MapperSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary, open_boundary

from ..scenes.maps import boundary_through

Array = NDArray[np.float64]


def straight_row(y: float, length: float = 40.0) -> Array:
    """Returns cones (k, 2) 4 m apart along x."""
    x = np.arange(0.0, length + 0.1, 4.0)
    return np.column_stack([x, np.full(len(x), y)])


@pytest.fixture
def state() -> State:
    """Two straight boundaries, the right one added first, and three poses between them."""
    found = State()
    found.variables.insert(np.array([CALIBRATION_KEY]), np.zeros(2))
    found.variables.insert(pose_keys(np.arange(3)), np.array([[k, 0.0, 0.0] for k in range(3)]).ravel())
    for label, y in ((RIGHT, -2.0), (LEFT, 2.0)):
        found.add_boundary(label, *boundary_through(straight_row(y)))
        found.pose_u[label] = np.arange(3.0)
    return found


def test_boundaries_lie_in_the_order_of_their_labels(state: State) -> None:
    assert list(state.boundaries) == [LEFT, RIGHT]
    left, right = state.control_points(LEFT), state.control_points(RIGHT)
    np.testing.assert_array_equal(state.map_points, np.concatenate([left, right]))
    keys = [state.control_keys(label) for label in (LEFT, RIGHT)]
    np.testing.assert_array_equal(state.map_keys, np.concatenate(keys))
    np.testing.assert_allclose(left[:, 1], 2.0, atol=1e-6)


def test_control_points_and_poses_are_views(state: State) -> None:
    state.control_points(RIGHT)[0] = [7.0, 8.0]
    np.testing.assert_array_equal(state.map_points[len(state.control_points(LEFT))], [7.0, 8.0])
    state.poses[1] = [4.0, 5.0, 6.0]
    np.testing.assert_array_equal(state.variables.of(pose_keys(np.array([1]))), [4.0, 5.0, 6.0])


def test_a_copy_changes_alone(state: State) -> None:
    other, known = state.copy(), state.pose_u[RIGHT].copy()
    other.control_points(LEFT)[:] = 0.0
    other.replace_boundary(RIGHT, *boundary_through(straight_row(-3.0, 12.0)))
    other.locate(RIGHT, known + 1.0)
    other.drop_oldest_pose_u()
    np.testing.assert_array_equal(state.pose_u[RIGHT], known)
    assert state.control_points(LEFT)[0, 1] == pytest.approx(2.0, abs=1e-6)
    assert state.boundaries[RIGHT].size > other.boundaries[RIGHT].size
    assert (len(state.pose_u[LEFT]), len(other.pose_u[LEFT])) == (3, 2)


def test_a_boundary_that_has_grown_gets_active_control_points_at_its_end(state: State) -> None:
    boundary, size = state.boundaries[LEFT], state.boundaries[LEFT].size
    state.active_stretch = {LEFT: np.arange(4, size)}
    points = boundary.grow(state.control_points(LEFT).copy(), np.array([48.0]), np.array([[48.0, 2.0]]))
    state.extend(LEFT, points[size:])
    assert len(state.control_points(LEFT)) == boundary.size > size
    assert state.active(LEFT).tolist() == list(range(4, boundary.size))
    np.testing.assert_array_equal(state.control_keys(LEFT), control_keys(LEFT, np.arange(boundary.size)))
    assert state.active(RIGHT) is state.boundaries[RIGHT].everything


def test_the_curves_are_laid_out_anew_only_when_they_change(state: State) -> None:
    first = state.curves
    assert state.curves is first
    state.active_stretch = {LEFT: np.arange(4, state.boundaries[LEFT].size)}
    assert state.curves is not first and not state.whole
    state.active_stretch = {}
    assert state.whole and state.curves is not first


def test_foot_points_on_both_curves_are_those_on_each_alone(state: State) -> None:
    rng = np.random.default_rng(0)
    curve, u = rng.integers(0, 2, 20), rng.uniform(3.0, 35.0, 20)
    points = np.column_stack([u, rng.normal(size=20)])
    found = state.find(points, curve, u - 3.0, u + 3.0)
    room = SplineSettings().refine_room
    stretch = u, u - room, np.minimum(u + room, state.trusted[curve])
    refined = FootPoints(*state.curves.searched.refine(state.map_points, points, curve, *stretch, 1))
    for index, label in enumerate((LEFT, RIGHT)):
        own, boundary = curve == index, state.boundaries[label]
        control = state.control_points(label)
        alone = boundary.find(control, points[own], u[own] - 3.0, u[own] + 3.0)
        np.testing.assert_allclose(found.u[own], alone.u, atol=1e-12)
        np.testing.assert_allclose(found.distance[own], points[own, 1] - (2.0, -2.0)[index], atol=1e-6)
        np.testing.assert_allclose(
            refined.u[own], boundary.refine(control, points[own], u[own]).u, atol=1e-12
        )
        keys = state.curves.keys[found.columns[own]]
        np.testing.assert_array_equal(keys, state.control_keys(label)[boundary.columns(alone.span)])


def test_a_foot_point_before_the_active_stretch_is_noticed(state: State) -> None:
    first = 5
    state.active_stretch = {LEFT: np.arange(first, state.boundaries[LEFT].size)}
    begins = state.boundaries[LEFT].knots[first + SplineSettings().degree]
    for left, reaches in ((begins + 1.0, False), (begins - 1.0, True)):
        track, u, labels = CurveMap(MapperSettings(), state), np.array([left, 1.0]), np.array([LEFT, RIGHT])
        points, covariances = np.column_stack([u, [2.0, -2.0]]), np.tile(0.01 * np.eye(2), (2, 1, 1))
        track.detections.append(Detections(0.0, points, covariances, labels), 0)
        track.detections.take(np.arange(2), labels, u)
        track.rows(np.zeros(1, np.intp))
        assert track.reached_inactive == reaches


def test_the_extrapolated_end_is_no_part_of_a_stretch(state: State) -> None:
    trusted = state.boundaries[RIGHT].trusted
    assert trusted == 40.5
    points, curve, low = np.array([[20.0, -2.0], [99.0, -2.0]]), np.array([1, 1]), np.zeros(2)
    foot = state.find(points, curve, low, np.array([20.0, 99.0]))
    np.testing.assert_allclose(foot.u, [20.0, trusted], atol=1e-9)


def test_a_side_that_only_a_batch_has_found_closes_as_well() -> None:
    """Curves stay in the order of their labels, as their control points are."""
    settings, state = MapperSettings(), State()
    knots = np.arange(-3.0, 14.0)
    closed = open_boundary(settings.spline).closed(knots)
    state.replace_curves({RIGHT: closed, LEFT: closed})
    assert [*state.boundaries] == [LEFT, RIGHT]
    assert state.closed


# --- the user's factors on other curves ------------------------------------------------------------------


def refined(state: State) -> State:
    """The same curves on twice as many spans."""
    finer = state.copy()
    for label, old in state.boundaries.items():
        knots = np.union1d(old.knots, 0.5 * (old.knots[1:] + old.knots[:-1]))[old.degree : -old.degree]
        boundary = Boundary(knots, False, old.settings)
        boundary.confirmed_end = boundary.tables.high
        u = np.linspace(boundary.tables.low, boundary.tables.high, 4 * boundary.size)
        curve = old.evaluate(state.control_points(label), u)
        finer.replace_boundary(label, boundary, np.linalg.lstsq(boundary.basis(u), curve, rcond=None)[0])
    return finer


def test_a_factor_on_control_points_is_the_same_on_finer_knots(state: State) -> None:
    """A curve of the coarse knots is one of the fine knots, so its error is exact for any such curve."""
    rng, noise = np.random.default_rng(0), gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    left, right = int(state.control_keys(LEFT)[2]), int(state.control_keys(RIGHT)[4])
    factor = gtsam.BetweenFactorPoint2(left, right, np.array([3.0, 0.4]), noise)
    given = GivenFactor.of(factor, state, 7)
    [rows] = given.on(refined(state))
    assert given.cycle == 7 and len(rows.keys[0]) > 4
    state.map_points[:] += 0.1 * rng.normal(size=state.map_points.shape)
    values = state.variables.gtsam_values(np.array([left, right]))
    expected = factor.noiseModel().whiten(factor.unwhitenedError(values))
    np.testing.assert_allclose(at_values(rows, refined(state).variables).residual, expected, atol=1e-6)


def test_a_factor_that_came_with_its_pose_is_of_the_cycle_of_the_pose(state: State) -> None:
    noise, key = gtsam.noiseModel.Isotropic.Sigma(2, 0.1), int(state.control_keys(LEFT)[1])
    given = GivenFactor.of(gtsam.BearingRangeFactor2D(pose_key(1), key, gtsam.Rot2(), 5.0, noise), state, 7)
    assert given.cycle == 1
    [rows] = given.on(state)
    here = at_values(rows, state.variables)
    [own] = [at_values(one, state.variables) for one in user_rows([given.factor], state.variables)]
    np.testing.assert_allclose(here.residual, own.residual, atol=1e-9)
    by_key = np.isin(here.keys[0], own.keys[0])
    np.testing.assert_allclose(here.jacobian[:, np.repeat(~by_key, sizes(here.keys[0]))], 0.0, atol=1e-4)


def test_a_factor_travels_to_another_process_without_itself(state: State) -> None:
    """One in Python cannot be pickled."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        if H is not None:
            H[0] = np.eye(2, order="F")
        return np.asarray(values.atPoint2(key))

    key, noise = int(state.control_keys(LEFT)[1]), gtsam.noiseModel.Unit.Create(2)
    given = GivenFactor.of(gtsam.CustomFactor(noise, [key], error), state, 0)
    there = pickle.loads(pickle.dumps(given))
    assert there.factor is None and given.factor is not None
    np.testing.assert_array_equal(there.on(state)[0].jacobian, given.on(state)[0].jacobian)
    del state.boundaries[LEFT]
    assert there.on(state) == []


def test_a_factor_without_information_has_no_rows(state: State) -> None:
    """As that of a surveyed point beyond the end of the curve: its Jacobian is zero."""
    key, noise = int(state.control_keys(LEFT)[1]), gtsam.noiseModel.Unit.Create(2)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        if H is not None:
            H[0] = np.zeros((2, 2), order="F")
        return np.zeros(2)

    assert GivenFactor.of(gtsam.CustomFactor(noise, [key], error), state, 0).on(state) == []
