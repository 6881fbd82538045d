"""S_z: the ridge regression, its cubature transform, and the choices that the paper leaves open."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines import ckf
from pathspace_graph.baselines.ckf import fit_detections
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


def curve() -> BSpline:
    """Returns a clamped curve of 10 spans along x."""
    u = np.linspace(0.0, 40.0, 13)
    return BSpline.clamped_from(np.linspace(0.0, 40.0, 11), np.column_stack([u, np.sin(0.1 * u)]))


def points_beside(spline: BSpline, u: Array, offset: float) -> Array:
    return spline.evaluate(u) + np.array([0.0, offset])


def test_the_fit_minimizes_the_cost_of_its_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradient of |y - B C|^2 + (C - C_mu)' L (C - C_mu) is zero, with the paper's L."""
    monkeypatch.setattr(ckf, "RIDGE", 0.2)
    spline = curve()
    u = np.array([9.0, 14.0, 15.5])
    basis, known = spline.basis_matrix(u), spline.control_points
    detections = points_beside(spline, u, 0.8)
    fitted = fit_detections(basis, detections, np.tile(COVARIANCE, (3, 1, 1)), known).points
    penalty = np.diag(0.2 * (1.0 - basis.sum(axis=0) / 3))
    slope = basis.T @ (basis @ fitted - detections) + penalty @ (fitted - known)
    np.testing.assert_allclose(slope, 0.0, atol=1e-10)


def test_the_covariance_of_the_detections_goes_through_the_fit() -> None:
    """cov C = (G x I) K (G x I)', which is zero for control points that no detection reaches."""
    spline, u = curve(), np.array([10.0, 13.0])
    basis = spline.basis_matrix(u)
    covariances = np.stack([COVARIANCE, 2.0 * COVARIANCE])
    fitted = fit_detections(basis, spline.evaluate(u), covariances, spline.control_points)
    gain = np.kron(fitted.gain, np.eye(2))
    joint = np.block([[covariances[0], np.zeros((2, 2))], [np.zeros((2, 2)), covariances[1]]])
    np.testing.assert_allclose(fitted.covariance, gain @ joint @ gain.T, atol=1e-12)
    assert np.abs(fitted.covariance[-6:]).max() < 1e-20


def test_the_prediction_is_the_fit_of_detections_on_the_curve() -> None:
    """This holds for detections on any curve."""
    spline, u, rng = curve(), np.array([10.0, 13.0, 14.0]), np.random.default_rng(0)
    basis, covariances = spline.basis_matrix(u), np.tile(COVARIANCE, (3, 1, 1))
    other = spline.with_points(spline.control_points + rng.normal(size=spline.control_points.shape))
    fitted = fit_detections(basis, other.evaluate(u), covariances, spline.control_points)
    np.testing.assert_allclose(fitted.refitted(other.control_points[None])[0], fitted.points, atol=1e-9)
    vectors = fitted.range_basis()
    assert vectors.shape == (13, 3)
    np.testing.assert_allclose(vectors @ vectors.T @ fitted.gain, fitted.gain, atol=1e-9)
