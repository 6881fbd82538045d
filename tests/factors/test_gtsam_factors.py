"""The GTSAM factors: their Jacobians, their keys, and what they refuse."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.bspline import SpanPolynomials, periodic_knots, uniform_knots
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.gtsam_factors import (
    boundary_point_factor,
    calibrated_odometry_factor,
    pose_array,
    smoothness_factors,
    spline_projection_factors,
)
from pathspace_graph.factors.linear import linear_factor
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.residuals import greville, smoothness_matrix

from ..scenes.jacobians import assert_jacobians

DEGREE, SIZE = 3, 11
SIGMA_MODEL, HUBER = 0.08, 1.5
TABLES = SpanPolynomials(uniform_knots(SIZE, DEGREE, 3.5), DEGREE)


def integrate_noisy(rng: np.random.Generator) -> IntegratedOdometry:
    """Returns nine samples of 0.02 s at 10 m/s in the bend."""
    sigma = np.array([0.25, 0.12, 0.035])
    return integrate_twists(np.full(9, 0.02), [10.0, 0.0, 0.4] + rng.normal(size=(9, 3)) * sigma, sigma)


def test_error_is_hubers_loss_and_its_derivative_is_the_linearizations_gradient() -> None:
    """So that an optimizer that judges its steps by the error judges the rows that it was given."""
    points = np.array([[9.5, 0.4], [10.0, 0.05], [10.5, -0.5]])
    factor, values = straight_factor(np.array([9.5, 10.0, 10.5]), points, HUBER)
    graph, rng = gtsam.NonlinearFactorGraph(), np.random.default_rng(2)
    graph.add(factor)
    values.update(99, gtsam.Pose2(0.1, -0.05, 0.02))
    for j in range(SIZE):
        values.update(j, values.atPoint2(j) + rng.normal(0.0, 0.05, 2))
    assert np.abs(factor.unwhitenedError(values)).max() > HUBER
    gradient = graph.linearize(values).gradientAtZero()
    for key in list(factor.keys()):
        expected = gradient.at(key)
        numeric = [error_slope(graph, values, key, e) for e in np.eye(len(expected))]
        np.testing.assert_allclose(numeric, expected, atol=1e-5 * (1.0 + np.abs(expected).max()))


def error_slope(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, key: int, along: Array) -> float:
    """Central difference of the error along a tangent of one key."""
    errors = []
    for step in (1e-5, -1e-5):
        delta = values.zeroVectors()
        delta.update(single(key, step * along))
        errors.append(graph.error(values.retract(delta)))
    return float((errors[0] - errors[1]) / 2e-5)


def single(key: int, vector: Array) -> gtsam.VectorValues:
    values = gtsam.VectorValues()
    values.insert(key, vector)
    return values


def pose_plus(pose: Array, delta: Array) -> Array:
    return pose_array(gtsam.Pose2(*pose).retract(delta))


def test_calibrated_odometry_jacobians_in_pose2s_tangent() -> None:
    """Residuals are metres large; the noise model whitens them outside this function."""
    odometry = integrate_noisy(np.random.default_rng(3))
    unit = IntegratedOdometry(odometry.delta, np.eye(3), odometry.calibration_jacobian, np.eye(3))
    factor = calibrated_odometry_factor(0, 1, 2, unit)

    def function(start: Array, end: Array, calibration: Array) -> tuple[Array, ...]:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose2(*start))
        values.insert(1, gtsam.Pose2(*end))
        values.insert(2, calibration)
        linear = gtsam.JacobianFactor(factor.linearize(values))
        assert linear.keys() == [0, 1, 2]
        A = linear.getA()
        return -linear.getb(), A[:, :3].copy(), A[:, 3:6].copy(), A[:, 6:].copy()

    inputs = [np.array([1.0, -2.0, 2.5]), np.array([4.0, 1.0, -2.9]), np.array([0.01, -0.02])]
    assert_jacobians(function, inputs, [pose_plus, pose_plus, lambda x, d: x + d])


def test_without_calibration_both_odometry_factors_agree() -> None:
    odometry = integrate_noisy(np.random.default_rng(4))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, 3.0))
    values.insert(1, gtsam.Pose2(2.0, 2.5, -3.0))
    values.insert(2, np.zeros(2))
    noise = gtsam.noiseModel.Gaussian.Information(odometry.whitener.T @ odometry.whitener)
    between = gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(*odometry.delta), noise)
    native = gtsam.JacobianFactor(between.linearize(values))
    own = gtsam.JacobianFactor(calibrated_odometry_factor(0, 1, 2, odometry).linearize(values))
    scale = np.abs(native.getA()).max()
    np.testing.assert_allclose(own.getA()[:, :6], native.getA(), atol=1e-9 * scale)
    np.testing.assert_allclose(own.getb(), native.getb(), atol=1e-9 * np.abs(native.getb()).max())


def test_periodic_stretch_across_the_seam_holds_only_its_own_keys() -> None:
    """Readings at the seam of a closed curve: keys of both of its ends, and the Jacobians are right."""
    size = 12
    angle = 2.0 * np.pi * np.arange(size) / size
    points = 6.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    tables = SpanPolynomials(periodic_knots(3.0 * np.arange(size + 1.0), DEGREE), DEGREE, True)
    u = whole_period_search(tables, points, np.array([[7.0, 1.0], [7.2, 1.3]]))
    (factor,) = spline_projection_factors(
        np.full(2, 99),
        list(range(size)),
        tables,
        points_vehicle=np.array([[2.0, 0.0], [2.2, 0.3]]),
        covariances=np.tile(0.01 * np.eye(2), (2, 1, 1)),
        low=u - 1.0,
        high=u + 1.0,
        sigma_model=SIGMA_MODEL,
        huber=np.inf,
    )
    keys = factor.keys()[1:]
    assert {0, size - 1} < set(keys)
    assert len(keys) < size

    def function(pose: Array, control: Array) -> tuple[Array, ...]:
        values = gtsam.Values()
        values.insert(99, gtsam.Pose2(*pose))
        for key, point in zip(keys, control.reshape(-1, 2), strict=True):
            values.insert(key, point)
        linear = gtsam.JacobianFactor(factor.linearize(values))
        return -linear.getb(), linear.getA()[:, :3].copy(), linear.getA()[:, 3:].copy()

    inputs = [np.array([5.0, 1.0, 0.0]), points[keys].ravel()]
    residual = function(*inputs)[0]
    assert np.abs(residual).min() > 1.0
    assert_jacobians(function, inputs, [pose_plus, lambda x, d: x + d])


def whole_period_search(tables: SpanPolynomials, distinct: Array, points: Array) -> Array:
    unwrapped = np.concatenate([distinct, distinct[:DEGREE]])
    ends = np.full(len(points), tables.low), np.full(len(points), tables.high)
    return foot_points(tables, unwrapped, points, *ends, 0.5).u


def straight_factor(
    u: Array, points: Array, huber: float = np.inf
) -> tuple[gtsam.CustomFactor, gtsam.Values]:
    """Readings beside a straight boundary along the x axis, from a pose at the origin."""
    (factor,) = spline_projection_factors(
        np.full(len(u), 99),
        list(range(SIZE)),
        TABLES,
        points_vehicle=points,
        covariances=np.tile(0.01 * np.eye(2), (len(u), 1, 1)),
        low=u - 1.0,
        high=u + 1.0,
        sigma_model=SIGMA_MODEL,
        huber=huber,
    )
    values = gtsam.Values()
    values.insert(99, gtsam.Pose2())
    for j, x in enumerate(greville(TABLES.knots, DEGREE)):
        values.insert(j, np.array([x, 0.0]))
    return factor, values


def test_a_row_whose_foot_point_leaves_its_stretch_contributes_zero() -> None:
    """So does a row beyond the end of the curve."""
    end = TABLES.high
    points = np.array([[10.5, 0.4], [13.0, 0.4], [end + 0.5, 0.4]])
    factor, values = straight_factor(np.array([10.0, 10.0, end]), points)
    linear = gtsam.JacobianFactor(factor.linearize(values))
    sigma = np.hypot(0.1, SIGMA_MODEL)
    np.testing.assert_allclose(linear.getb(), [-0.4 / sigma, 0.0, 0.0], atol=1e-9)
    assert np.abs(linear.getA()[0]).max() > 1.0
    np.testing.assert_array_equal(linear.getA()[1:], 0.0)
    assert factor.error(values) == pytest.approx(0.5 * (0.4 / sigma) ** 2, rel=1e-9)


def test_a_factor_holds_only_the_keys_of_its_stretch() -> None:
    """Foot points between 9 and 11: spans 2 and 3 (7 to 14), so control points 2 to 6."""
    factor, _ = straight_factor(np.array([10.0]), np.array([[10.0, 0.4]]))
    assert factor.keys() == [99, 2, 3, 4, 5, 6]


def test_what_does_not_fit_is_refused() -> None:
    none = np.zeros(0)
    with pytest.raises(ValueError, match="at least one"):
        boundary_point_factor(
            list(range(SIZE)), TABLES, points_map=np.zeros((0, 2)), sigma=none, low=none, high=none
        )
    with pytest.raises(ValueError, match="expected as many"):
        straight_factor(np.zeros(2), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="expected a key for each of 4 columns"):
        smoothness_factors([1, 2, 3], smoothness_matrix(np.arange(4.0), None), 1.0)


@pytest.mark.parametrize("period", [None, 9.0])
def test_smoothness_factors_are_the_matrix_far_from_zero(period: float | None) -> None:
    """Their error is 1/2 |D c / sigma|^2 at any control points, not only where they were created."""
    matrix = smoothness_matrix(np.array([0.0, 1.0, 3.0, 4.0, 7.0]), period)
    points = np.random.default_rng(5).normal(size=(5, 2)) * 10.0
    values = gtsam.Values()
    for j, point in enumerate(points):
        values.insert(j, point)
    factors = smoothness_factors(list(range(5)), matrix, 0.5)
    assert all(len(f.keys()) <= 3 for f in factors)
    expected = 0.5 * np.sum((matrix @ points / 0.5) ** 2)
    assert sum(f.error(values) for f in factors) == pytest.approx(expected, rel=1e-12)


def test_a_linear_factor_over_many_keys() -> None:
    rng = np.random.default_rng(0)
    keys, dims = [9, 4, 7, 1, 30], [2, 3, 2, 1, 3]
    A, b, x = rng.normal(size=(4, 11)), rng.normal(size=4), rng.normal(size=11)
    factor = gtsam.JacobianFactor(linear_factor(np.array(keys), np.array(dims), A, b))
    delta = gtsam.VectorValues()
    for key, part in zip(keys, np.split(x, np.cumsum(dims)[:-1]), strict=True):
        delta.insert(key, part)
    np.testing.assert_array_equal(factor.getA(), A)
    assert factor.error(delta) == pytest.approx(0.5 * np.sum((A @ x - b) ** 2), rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "dims", "shape", "rows"),
    [
        ([1, 2], [2], (3, 2), 3),
        ([1, 1], [2, 2], (3, 4), 3),
        ([1, 2], [2, 2], (3, 5), 3),
        ([1], [2], (3, 2), 2),
    ],
)
def test_a_linear_factor_that_does_not_fit_is_refused(
    keys: list[int], dims: list[int], shape: tuple[int, int], rows: int
) -> None:
    with pytest.raises(ValueError, match="expected"):
        linear_factor(np.array(keys), np.array(dims), np.zeros(shape), np.zeros(rows))
