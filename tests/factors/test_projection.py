"""The spline-projection kernel: Jacobians with re-found foot points metres off the curve, noise, weights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials, clamped_knots, periodic_knots, uniform_knots
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.residuals import project, sigma_across
from pathspace_graph.factors.se2 import to_map, to_vehicle

from ..scenes.jacobians import assert_jacobians

SPACING = 3.0
"""Knot interval of the test curves (m)."""
ROOM = 2.0
"""Stretch on either side of the parameter where a foot point is searched for (m)."""
SIGMA_MODEL = 0.08
SIDESTEPS = 1e-3 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""A foot point that jumps where its point moves by one of these (m) has a rival at the same distance."""
MAX_BEND = 0.8
"""This is the largest curvature times distance; at 1 the point is the centre of curvature."""


def control_columns(tables: SpanPolynomials, span: IntArray) -> IntArray:
    """Distinct control points (m, degree + 1) of each span."""
    count = len(tables.knots) - tables.degree - 1 - (tables.degree if tables.periodic else 0)
    return (span[:, None] + np.arange(-tables.degree, 1)) % count


def unwrapped(tables: SpanPolynomials, distinct: Array) -> Array:
    """Control points as the kernels take them."""
    return distinct[np.arange(len(tables.knots) - tables.degree - 1) % len(distinct)]


def random_curve(
    rng: np.random.Generator, degree: int, kind: str, size: int = 10
) -> tuple[SpanPolynomials, Array]:
    """A winding curve about `SPACING` a knot; open, clamped with a repeated knot, or periodic."""
    if kind == "periodic":
        angle = 2.0 * np.pi * np.arange(size) / size
        points = SPACING * size / (2.0 * np.pi) * np.column_stack([np.cos(angle), np.sin(angle)])
        knots = periodic_knots(SPACING * np.arange(size + 1, dtype=float), degree)
    else:
        heading = np.cumsum(rng.normal(0.0, 0.3, size))
        points = SPACING * np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
        breaks = SPACING * np.arange(size - degree + 1, dtype=float)
        if kind == "repeated" and degree > 2:
            breaks[2] = breaks[3]
        knots = uniform_knots(size, degree, SPACING) if kind == "open" else clamped_knots(breaks, degree)
    return SpanPolynomials(knots, degree, kind == "periodic"), points + rng.normal(0.0, 0.2, points.shape)


def find(tables: SpanPolynomials, distinct: Array, points: Array, u: Array) -> FootPoints:
    return foot_points(tables, unwrapped(tables, distinct), points, u - ROOM, u + ROOM, 0.25)


def well_posed(tables: SpanPolynomials, distinct: Array, points: Array, u: Array) -> BoolArray:
    """Interior foot points away from kinks and centres of curvature, where the nearest point jumps."""
    foot = find(tables, distinct, points, u)
    values, _ = tables.evaluate(foot.u, 2)
    columns = control_columns(tables, foot.span)
    _, first, second = np.einsum("rmj,mjd->rmd", values, distinct[columns])
    bend = np.sum(second * foot.normal_unit, axis=1) * foot.distance / np.sum(first**2, axis=1)
    low, high = tables.inside(foot.u - 1e-3), tables.inside(foot.u + 1e-3)
    same_side = tables.locate(low)[0] == tables.locate(high)[0]  # third derivatives jump at a knot
    near = np.abs(foot.u - tables.inside(u)) < 0.8 * ROOM
    at_kink = np.linalg.norm(points - foot.position, axis=1) - np.abs(foot.distance) > 1e-6
    stays = [np.abs(find(tables, distinct, points + step, u).u - foot.u) < 0.1 for step in SIDESTEPS]
    return np.asarray(foot.interior & (bend < MAX_BEND) & same_side & near & ~at_kink & np.all(stays, axis=0))


def projection_function(tables: SpanPolynomials, points_vehicle: Array, u: Array):
    """Returns a function of pose and control points that finds the foot points again in every call."""
    covariances = np.tile(0.01 * np.eye(2), (len(u), 1, 1))

    def function(pose: Array, control: Array) -> tuple[Array, Array, Array]:
        distinct, poses = control.reshape(-1, 2), np.tile(pose, (len(u), 1))
        points = to_map(points_vehicle, poses)
        foot = find(tables, distinct, points, u)
        rows = project(points, covariances, poses, foot, SIGMA_MODEL)
        by_control = np.zeros((len(u), len(distinct), 2))
        columns = control_columns(tables, foot.span)
        np.add.at(by_control, (np.arange(len(u))[:, None], columns), rows.by_control)
        return rows.residual, rows.by_pose, by_control.reshape(len(u), -1)

    return function


def points_beside(
    rng: np.random.Generator, tables: SpanPolynomials, distinct: Array, distance: Array
) -> tuple[Array, Array]:
    """Points (m, 2) at given signed distances from the curve and their parameters, the well posed ones."""
    margin = 0.0 if tables.periodic else 0.2
    u = rng.uniform(tables.low + margin, tables.high - margin, len(distance))
    values, span = tables.evaluate(u, 1)
    position, tangent = np.einsum("rmj,mjd->rmd", values, distinct[control_columns(tables, span)])
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
    points = position + distance[:, None] * normal
    keep = well_posed(tables, distinct, points, u)
    return points[keep], u[keep]


@given(
    seed=st.integers(0, 2**32 - 1),
    degree=st.integers(1, 4),
    kind=st.sampled_from(["open", "clamped", "repeated", "periodic"]),
)
def test_jacobians_are_exact_metres_away_from_the_curve(seed: int, degree: int, kind: str) -> None:
    """Every term through the foot point vanishes, though it moves with pose and control points."""
    rng = np.random.default_rng(seed)
    tables, distinct = random_curve(rng, degree, kind)
    points, u = points_beside(rng, tables, distinct, rng.uniform(-5.0, 5.0, 25))
    pose = np.append(rng.uniform(-20.0, 20.0, 2), rng.uniform(-np.pi, np.pi))
    function = projection_function(tables, to_vehicle(points, pose[None]), u)
    assert_jacobians(function, [pose, distinct.ravel()])


def test_the_samples_are_far_from_zero_and_their_foot_points_move() -> None:
    """The test above is about residuals of metres and parameters that depend on the pose."""
    rng = np.random.default_rng(1)
    tables, distinct = random_curve(rng, 3, "open")
    points, u = points_beside(rng, tables, distinct, rng.uniform(-5.0, 5.0, 200))
    foot = find(tables, distinct, points, u)
    assert np.abs(foot.distance).max() > 4.0
    assert (np.abs(foot.distance) > 1.0).sum() > 50
    moved = find(tables, distinct, points + np.array([0.01, 0.0]), u)
    assert np.abs(moved.u - foot.u).max() > 0.005


@pytest.mark.parametrize(
    "pose",
    [
        [0.0, 0.0, 0.0],
        [1e-9, -1e-9, 1e-9],
        [3.0, 1.0, np.pi],
        [3.0, 1.0, -np.pi + 1e-7],
        [500.0, -300.0, 40.0],
    ],
)
@pytest.mark.parametrize("distance", [0.0, 1e-9, 0.3])
def test_jacobians_at_degenerate_states(pose: list[float], distance: float) -> None:
    """Near identity, at the seam of the angle, many turns on; on the curve itself."""
    rng = np.random.default_rng(3)
    tables, distinct = random_curve(rng, 3, "open")
    distinct = distinct + np.array(pose[:2])
    points, u = points_beside(rng, tables, distinct, np.full(10, distance))
    assert len(u) > 3
    function = projection_function(tables, to_vehicle(points, np.array([pose])), u)
    assert_jacobians(function, [np.array(pose), distinct.ravel()])


def test_a_detection_at_the_vehicle_itself_does_not_turn() -> None:
    rng = np.random.default_rng(4)
    tables, distinct = random_curve(rng, 3, "periodic")
    points, u = points_beside(rng, tables, distinct, np.array([1.0, 1.0]))
    pose = np.append(points[0], 0.7)
    function = projection_function(tables, np.zeros((1, 2)), u[:1])
    assert_jacobians(function, [pose, distinct.ravel()])
    assert function(pose, distinct.ravel())[1][0, 2] == 0.0


def test_coinciding_control_points_keep_the_jacobians() -> None:
    rng = np.random.default_rng(5)
    tables, distinct = random_curve(rng, 3, "open")
    distinct[5] = distinct[4]
    points, u = points_beside(rng, tables, distinct, rng.uniform(-0.5, 0.5, 20))
    assert_jacobians(projection_function(tables, points, u), [np.zeros(3), distinct.ravel()])


def test_at_the_end_of_the_curve_the_row_is_marked() -> None:
    """Beyond the end the residual is not the distance, the Jacobians not exact: `interior` is False."""
    tables = SpanPolynomials(uniform_knots(6, 3, SPACING), 3)
    distinct = SPACING * np.column_stack([np.arange(6.0), np.zeros(6)])
    end = SPACING * 4.0
    foot = find(tables, distinct, np.array([[end + 1.0, 0.5], [end - 1.0, 0.5]]), np.array([tables.high] * 2))
    assert foot.interior.tolist() == [False, True]


def test_the_residual_is_positive_on_the_left_of_travel() -> None:
    tables = SpanPolynomials(uniform_knots(6, 3, SPACING), 3)
    distinct = SPACING * np.column_stack([np.arange(6.0), np.zeros(6)])
    pose = np.array([6.0, 0.0, np.pi])
    function = projection_function(tables, np.array([[0.0, -2.0], [0.0, 1.5]]), np.array([3.0, 3.0]))
    residual, by_pose, _ = function(pose, distinct.ravel())
    np.testing.assert_allclose(residual, [2.0, -1.5], atol=1e-12)
    np.testing.assert_allclose(by_pose[:, :2], [[0.0, 1.0], [0.0, 1.0]], atol=1e-12)


def test_sigma_across_against_monte_carlo() -> None:
    """A sample deviation has a relative standard error of 1 / sqrt(2 n); five are allowed."""
    rng = np.random.default_rng(6)
    count, theta, angle = 100_000, 2.1, 0.4
    covariance = np.array([[0.04, 0.015], [0.015, 0.01]])
    noise = rng.multivariate_normal(np.zeros(2), covariance, count)
    normal = np.array([np.cos(angle), np.sin(angle)])
    turned = to_map(noise, np.tile([5.0, -3.0, theta], (count, 1))) - np.array([5.0, -3.0])
    samples = turned @ normal + rng.normal(0.0, SIGMA_MODEL, count)
    sigma = sigma_across(normal[None], covariance[None], np.array([[5.0, -3.0, theta]]), SIGMA_MODEL)
    assert abs(samples.std() / sigma[0] - 1.0) < 5.0 / np.sqrt(2.0 * count)
