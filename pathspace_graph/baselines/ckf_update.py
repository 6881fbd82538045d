"""Classification of the detections of a cycle, and its one Kalman update (paper: Expansion, Update).

`docs/paper.md`, "Decisions of the filter", lists our choices where the paper leaves them open.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.baselines.ckf_belief import SENSOR_COLUMNS, to_vehicle_rows, transform
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import scatter
from pathspace_graph.factors.residuals import project
from pathspace_graph.factors.se2 import in_vehicle, rotation, to_map, to_vehicle
from pathspace_graph.factors.sensor import SENSOR_SIZE
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.settings.mapper import CkfSettings

from .ckf_curves import CurveState

GAIN_RANK: Final = 1e-9  # least singular value of the gain that is not zero, relative to the largest one
LEAST_BASIS: Final = 1e-3  # least sum of a control point's basis values for its update


@dataclass(frozen=True, eq=False)
class OnCurve:
    """Detections of a cycle that update a curve."""

    rows: IntArray  # (m,) rows of the cycle's detections
    basis: Array  # (m, n) the curve's n basis functions at the foot points: the paper's B
    tangents: Array  # (m, 2) unit tangents at the foot points, map frame
    distances: Array  # (m,) squared Mahalanobis distances across the curve

    def where(self, chosen: BoolArray) -> "OnCurve":
        return OnCurve(self.rows[chosen], self.basis[chosen], self.tangents[chosen], self.distances[chosen])


def classify(state: CurveState, detections: Detections) -> dict[int, OnCurve]:
    """Assign detections to the curves that they update; an unknown label updates the nearer curve."""
    found = {label: on_curve(state, label, detections) for label in state.curves}
    nearest = np.full(len(detections.labels), np.inf)
    for on in found.values():
        nearest[on.rows] = np.minimum(nearest[on.rows], on.distances)
    return {label: on.where(on.distances <= nearest[on.rows]) for label, on in found.items()}


def on_curve(state: CurveState, label: int, detections: Detections) -> OnCurve:
    """Select the detections in the gate of a curve: `d^2 < chi^2 (n' K n + sigma^2 + g' Sigma g)`.

    d is the signed distance across the curve, n its normal, K the covariance of the detection, sigma^2 the
    variances of the settings, g the derivative of d by pose, calibration and control points, and Sigma their
    covariance. The foot point must be inside the stretch that the vehicle sees.
    """
    gate, curve = state.settings.gate, state.curves[label]
    rows = np.flatnonzero((detections.labels == label) | (detections.labels == UNKNOWN))
    poses = np.tile(state.pose, (len(rows), 1))
    points = to_map(detections.points_vehicle[rows], poses)
    foot = state.foot_points(label, points, *state.visible_range(label, len(rows)))
    projected = project(points, detections.covariances[rows], poses, foot, state.settings.ckf.sigma_model)
    control, width = foot.span[:, None] + np.arange(-curve.degree, 1), POINT * (curve.degree + 1)
    control = control % curve.size if curve.periodic else control
    expected = to_vehicle(foot.position, poses)
    normals = in_vehicle(foot.normal_unit, poses)
    by_calibration = np.einsum("mi,mik->mk", normals, state.belief.by_sensor(expected))
    by_control = projected.by_control.reshape(len(rows), width)
    gradient = np.concatenate([projected.by_pose, by_calibration, by_control], axis=1)
    head = np.tile(np.append(np.arange(POSE), SENSOR_COLUMNS), (len(rows), 1))
    own = state.columns(label, control.ravel()).reshape(len(rows), width)
    columns = np.concatenate([head, own], axis=1)
    joint = state.belief.covariance[columns[:, :, None], columns[:, None, :]]
    variance = projected.sigma**2 + gate.sigma_floor**2
    variance = variance + np.einsum("mi,mij,mj->m", gradient, joint, gradient)
    squared = foot.distance**2 / variance
    passes = foot.interior & (np.abs(foot.distance) < gate.rough) & (squared < gate.chi**2)
    basis = scatter(foot.basis, foot.span - curve.degree, curve.size, curve.periodic)
    return OnCurve(rows, basis, foot.tangent_unit, squared).where(passes)


@dataclass(frozen=True, eq=False)
class SplineMeasurement:
    """The measurement S_z on r control points, in the frame of the detections."""

    points: Array  # (r, 2) control points of S_z, in m
    covariance: Array  # (2 r, 2 r) their covariance over x0, y0, x1, y1 and so on, in m^2
    gain: Array  # (r, m) G, derivative of S_z by the detections
    taken: Array  # (r, r) G B, derivative of S_z by the control points of a curve through the detections
    known: Array  # (r, 2) control points C_mu before the fit

    def refitted(self, points: Array) -> Array:
        """S_z of detections on curves with control points C (k, r, 2): `C_mu + G B (C - C_mu)`."""
        return np.asarray(self.known + np.einsum("ij,kjd->kid", self.taken, points - self.known))

    def range_basis(self) -> Array:
        """Orthonormal basis (r, q) of the range of G, which the detections can change."""
        vectors, values, _ = np.linalg.svd(self.gain, full_matrices=False)
        return np.asarray(vectors[:, values > GAIN_RANK * values[0]])


def regularization(basis: Array, settings: CkfSettings) -> Array:
    """Regularization `L = lambda diag(1 - B' 1 / m)` (r, r) for a basis B (m, r)."""
    return np.diag(settings.ridge * (1.0 - basis.mean(axis=0)))


def ridge_gain(basis: Array, settings: CkfSettings) -> Array:
    """Gain `G = (B' B + L)^-1 B'` (r, m) of the ridge regression `C = C_mu + G (y - B C_mu)`."""
    gram = basis.T @ basis + regularization(basis, settings)
    return np.asarray(np.linalg.lstsq(gram, basis.T, rcond=None)[0])


def fit_detections(
    basis: Array, detections: Array, covariances: Array, known: Array, settings: CkfSettings
) -> SplineMeasurement:
    """Fit S_z to detections (m, 2) with covariances (m, 2, 2), by a cubature transform of ridge regression.

    basis (m, r) is evaluated at their foot points; known (r, 2) are the control points in their frame.
    """
    m, r = basis.shape
    gain = ridge_gain(basis, settings)
    joint = np.zeros((m, 2, m, 2))
    joint[np.arange(m), :, np.arange(m), :] = covariances
    kept = known - gain @ (basis @ known)

    def fit(samples: Array) -> Array:
        fitted = kept + np.einsum("rm,kmd->krd", gain, samples.reshape(-1, m, 2))
        return np.asarray(fitted.reshape(len(samples), -1))

    fitted = transform(fit, detections.ravel(), joint.reshape(2 * m, 2 * m))
    return SplineMeasurement(fitted.mean.reshape(r, 2), fitted.covariance, gain, gain @ basis, known)


@dataclass(frozen=True, eq=False)
class CurveBlock:
    """Block of the measurement for one curve."""

    columns: IntArray  # (2 r,) entries of the state that are the measured control points
    fitted: SplineMeasurement  # S_z in the vehicle frame
    combinations: Array  # (2 r, q) linear combinations of the coordinates of S_z that are measured
    by_sensor: Array  # (2 r, 5) derivative of S_z by the calibration of the sensor


def update(state: CurveState, detections: Detections, found: dict[int, OnCurve]) -> None:
    """Fit S_z of each curve, and update pose and map by all of them at once."""
    blocks = [_fit(state, label, detections, on) for label, on in found.items() if len(on.rows)]
    if not blocks:
        return
    ends = np.cumsum([len(block.columns) for block in blocks])
    head, now = POSE + SENSOR_SIZE, state.belief.sensor.copy()

    def predict(x: Array) -> Array:
        control_vehicle, predicted = to_vehicle_rows(x[:, :POSE], x[:, head:]), []
        for block, own in zip(blocks, np.split(control_vehicle, ends[:-1], axis=1), strict=True):
            fitted = block.fitted.refitted(own.reshape(len(x), -1, POINT)).reshape(len(x), -1)
            predicted.append((fitted - (x[:, POSE:head] - now) @ block.by_sensor.T) @ block.combinations)
        return np.concatenate(predicted, axis=1)

    columns = state.belief.measuring_columns(np.concatenate([block.columns for block in blocks]))
    measured = np.concatenate([block.fitted.points.ravel() @ block.combinations for block in blocks])
    noise = block_diag(*(b.combinations.T @ b.fitted.covariance @ b.combinations for b in blocks))
    state.belief.update(columns, predict, measured, noise)


def _fit(state: CurveState, label: int, detections: Detections, on: OnCurve) -> CurveBlock:
    """Fit S_z of one curve, on the control points that the detections reach.

    Their covariances are `K + sigma_model^2 I + sigma_along^2 t t'`, vehicle frame, with unit tangents t.
    """
    control = np.flatnonzero(on.basis.sum(axis=0) > LEAST_BASIS)
    known = to_vehicle_rows(state.pose[None], state.control_points(label)[control].reshape(1, -1))
    ckf, points = state.settings.ckf, detections.points_vehicle[on.rows]
    t = on.tangents @ rotation(state.pose[2])
    along = ckf.sigma_along**2 * t[:, :, None] * t[:, None, :]
    covariances = detections.covariances[on.rows] + ckf.sigma_model**2 * np.eye(POINT) + along
    fitted = fit_detections(on.basis[:, control], points, covariances, known.reshape(-1, POINT), ckf)
    combinations: Array = np.asarray(np.kron(fitted.range_basis(), np.eye(POINT)), float)
    expected = state.belief.by_sensor(on.basis[:, control] @ fitted.known)
    by_calibration = np.einsum("rm,mik->rik", fitted.gain, expected).reshape(-1, SENSOR_SIZE)
    return CurveBlock(state.columns(label, control), fitted, combinations, by_calibration)
