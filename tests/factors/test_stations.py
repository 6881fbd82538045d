"""Rows of detections at stations of a curve: their Jacobians, their noise, and the same rows as GTSAM's."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors._kernels import station_rows
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.bspline import SpanPolynomials, periodic_knots
from pathspace_graph.factors.gtsam_factors import pose_array, station_factors
from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.factors.sensor import corrected
from pathspace_graph.graph.variables import SENSOR_KEY, control_keys, pose_key

from ..scenes.jacobians import assert_jacobians

TABLES = SpanPolynomials(periodic_knots(np.arange(13) * 3.0, 3), 3, True)
"""A closed curve of twelve control points."""
TWIST = np.array([[6.0, 0.3, 0.4]])
K = np.array([[[0.09, 0.02], [0.02, 0.04]]])
"""Covariance of a detection (m^2), vehicle frame."""


def ring(rng: np.random.Generator) -> Array:
    """Return twelve control points about a circle of 6 m."""
    phi = 2.0 * np.pi * np.arange(12) / 12
    return 6.0 * np.column_stack([np.cos(phi), np.sin(phi)]) + 0.3 * rng.normal(size=(12, 2))


def row(
    control: Array, pose: Array, sensor: Array, u: float, measured: Array, sigma: float
) -> tuple[Array, ...]:
    """Return residual, sigma and Jacobian by [pose | sensor | four control points] of one detection."""
    (value, slope), _ = TABLES.evaluate(np.array([u]), 1)
    points = to_map(corrected(measured[None], TWIST, sensor), pose[None])
    basis = np.ascontiguousarray(value), np.ascontiguousarray(slope), control[None]
    seen = measured[None], TWIST, sensor
    return station_rows(points, K, pose[None], *basis, *seen, np.array([sigma]))


@pytest.mark.parametrize("aside", [0.0, 0.5, 3.0])
def test_jacobians(aside: float) -> None:
    """At any distance across the curve, since the tangent turns with the control points.

    At no calibration: its factor depends on pose and curve, which is of second order.
    """
    rng = np.random.default_rng(int(10 * aside))
    measured, u = np.array([4.0, 2.0 + aside]), 10.7
    pose, sensor, control = rng.normal(size=3), np.zeros(5), ring(rng)[3:7]

    def rows(pose: Array, sensor: Array, control: Array) -> tuple[Array, ...]:
        r, _, J = row(control.reshape(4, 2), pose, sensor, u, measured, 0.1)
        return r, J[:, :3], J[:, 3:8], J[:, 8:]

    assert_jacobians(rows, [pose, sensor, control.ravel()])


def test_a_detection_ahead_of_its_station_is_positive() -> None:
    """A straight curve along x, a station at its origin: a cone 0.4 m ahead, whatever is across."""
    control = np.array([[-3.0, 0.0], [0.0, 0.0], [3.0, 0.0], [6.0, 0.0]])
    r, sigma, J = row(control, np.zeros(3), np.zeros(0), 9.0, np.array([0.4, 1.0]), 0.4)
    assert r[0] == pytest.approx(0.4)
    assert sigma[0] == pytest.approx(np.sqrt(0.09 + 0.16))  # that of the detection along x, and the station's
    np.testing.assert_allclose(J[0, :3], [1.0, 0.0, -1.0], atol=1e-12)  # d/dtheta of the x of (0.4, 1)


@pytest.mark.parametrize("with_sensor", [False, True])
def test_the_factor_has_the_kernel_s_rows(with_sensor: bool) -> None:
    """Two detections of one pose and one of the next; in GTSAM's tangents of the poses."""
    rng = np.random.default_rng(4)
    control, u = ring(rng), np.array([10.7, 13.2, 35.5])
    poses = rng.normal(size=(2, 3))
    sensor = 0.02 * rng.normal(size=5) if with_sensor else np.zeros(0)
    keys, of_pose = control_keys(0, np.arange(12)), np.array([0, 0, 1])
    measured, sigma = rng.normal(size=(3, 2)) * 3.0, np.array([0.1, 0.2, 0.3])
    values = gtsam.Values()
    for key, point in zip(keys.tolist(), control, strict=True):
        values.insert(key, point)
    for k, pose in enumerate(poses):
        values.insert(pose_key(k), gtsam.Pose2(*pose))
    if with_sensor:
        values.insert(SENSOR_KEY, sensor)
    factors = station_factors(
        np.array([pose_key(0), pose_key(0), pose_key(1)]),
        keys.tolist(),
        TABLES,
        u=u,
        sigma_station=sigma,
        points_vehicle=measured,
        covariances=np.tile(K, (3, 1, 1)),
        twists=np.tile(TWIST, (3, 1)),
        huber=1.5,
        sensor_key=SENSOR_KEY if with_sensor else None,
    )
    assert [factor.dim() for factor in factors] == [2, 1]
    for i, (factor, number) in enumerate(zip([factors[0], factors[0], factors[1]], [0, 1, 0], strict=True)):
        own = control[(TABLES.evaluate(u[i : i + 1])[1][0] - 3 + np.arange(4)) % 12]
        r, s, J = row(own, poses[of_pose[i]], sensor, float(u[i]), measured[i], float(sigma[i]))
        weight = np.sqrt(1.0 / max(abs(r[0] / s[0]) / 1.5, 1.0)) / s[0]
        linear = factor.linearize(values)
        A, b = linear.jacobian()
        assert b[number] == pytest.approx(-weight * r[0])
        by_pose = J[0, :3].copy()
        by_pose[:2] = by_pose[:2] @ rotation(pose_array(values.atPose2(pose_key(int(of_pose[i]))))[2])
        np.testing.assert_allclose(A[number, :3], weight * by_pose, atol=1e-12)
        assert np.linalg.norm(A[number]) == pytest.approx(np.linalg.norm(weight * J[0]))
