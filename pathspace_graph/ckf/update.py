"""Classifies the detections of a cycle and makes its one Kalman update (paper: Expansion, Update)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.factors.bspline import scatter
from pathspace_graph.factors.projection import project
from pathspace_graph.factors.se2 import rotation, to_map, to_vehicle
from pathspace_graph.factors.sensor import SENSOR_SIZE, in_vehicle
from pathspace_graph.graph.keys import POINT, POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.belief import SENSOR_COLUMNS, point_columns, to_vehicle_rows

from .fit import SplineMeasurement, fit_detections
from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class OnCurve:
    """Holds the detections of a cycle that update a curve."""

    rows: IntArray
    """(m,) These are the rows of the cycle's detections."""
    basis: Array
    """(m, n) Each row holds the curve's n basis functions at a foot point: the paper's B."""
    tangents: Array
    """(m, 2) Each row is the unit tangent at a foot point, map frame."""
    distances: Array
    """(m,) These are the squared Mahalanobis distances across the curve."""

    def where(self, chosen: NDArray[np.bool_]) -> OnCurve:
        """Returns the detections whose entry in `chosen` (m,) is set."""
        return OnCurve(self.rows[chosen], self.basis[chosen], self.tangents[chosen], self.distances[chosen])


@dataclass(frozen=True, eq=False)
class CurveBlock:
    """Holds the block of the measurement that is the S_z of one curve."""

    columns: IntArray
    """(2 r,) These are the entries of the state that are the measured control points."""
    fitted: SplineMeasurement
    """This is S_z in the vehicle frame."""
    combinations: Array
    """(2 r, q) Each column is a linear combination of the coordinates of S_z that is measured."""
    by_sensor: Array
    """(2 r, 5) This is the derivative of S_z by the calibration of the sensor, as it corrects detections."""


# --- classification --------------------------------------------------------------------------------------


def classify(state: CurveState, detections: Detections) -> dict[int, OnCurve]:
    """Returns the detections that update each curve; one with an unknown label updates the nearer curve."""
    found = {label: on_curve(state, label, detections) for label in state.curves}
    nearest = np.full(len(detections.labels), np.inf)
    for on in found.values():
        nearest[on.rows] = np.minimum(nearest[on.rows], on.distances)
    return {label: on.where(on.distances <= nearest[on.rows]) for label, on in found.items()}


def on_curve(state: CurveState, label: int, detections: Detections) -> OnCurve:
    """Returns the detections within the gate of a curve: `d^2 < chi^2 (n' K n + sigma^2 + g' Sigma g)`.

    d is the signed distance across the curve, n its normal, K the covariance of the detection, sigma^2 the
    variances of the settings, and g the derivative of d by pose and control points. Sigma is their joint
    covariance. The foot point is in the stretch that the vehicle sees, and is not at an end of it.
    """
    gate, curve = state.settings.gate, state.curves[label]
    rows = np.flatnonzero((detections.labels == label) | (detections.labels == UNKNOWN))
    poses = np.tile(state.pose, (len(rows), 1))
    points = to_map(detections.points_vehicle[rows], poses)
    foot = state.foot_points(label, points, *state.visible_range(label, len(rows)))
    projected = project(points, detections.covariances[rows], poses, foot, state.settings.ckf.sigma_model)
    control = foot.span[:, None] + np.arange(-curve.degree, 1)
    control = control % curve.size if curve.periodic else control
    by_control = projected.by_control.reshape(len(rows), control.shape[1] * POINT)
    expected = to_vehicle(foot.position, poses)
    normals = in_vehicle(foot.normal_unit, poses)
    by_calibration = np.einsum("mi,mik->mk", normals, state.belief.by_sensor(expected))
    gradient = np.concatenate([projected.by_pose, by_calibration, by_control], axis=1)
    variance = projected.sigma**2 + gate.sigma_floor**2 + _joint_variance(state, label, control, gradient)
    squared = foot.distance**2 / variance
    passes = foot.interior & (np.abs(foot.distance) < gate.rough) & (squared < gate.chi**2)
    basis = scatter(foot.basis, foot.span - curve.degree, curve.size, curve.periodic)
    return OnCurve(rows, basis, foot.tangent_unit, squared).where(passes)


def _joint_variance(state: CurveState, label: int, control: IntArray, gradient: Array) -> Array:
    """Returns `g' Sigma g` (m,) of gradients (m, 8 + 2 (p + 1)) by pose, sensor and control points.

    The control points (m, p + 1) are given by their indices.
    """
    own = point_columns(state.offset(label) + control.ravel()).reshape(len(control), POINT * control.shape[1])
    head = np.append(np.arange(POSE), SENSOR_COLUMNS)
    columns = np.concatenate([np.tile(head, (len(control), 1)), own], axis=1)
    block = state.belief.covariance[columns[:, :, None], columns[:, None, :]]
    return np.asarray(np.einsum("mi,mij,mj->m", gradient, block, gradient))


# --- the update ------------------------------------------------------------------------------------------


def update(state: CurveState, detections: Detections, found: dict[int, OnCurve]) -> None:
    """Fits S_z of each curve, and makes one Kalman update of pose and map with all of them."""
    blocks = [_fit(state, label, detections, on) for label, on in found.items() if len(on.rows)]
    if not blocks:
        return
    direct = state.settings.ckf.prediction == "direct"
    bounds = np.cumsum([0] + [len(block.columns) for block in blocks])

    head, now = POSE + SENSOR_SIZE, state.belief.sensor.copy()

    def predict(x: Array) -> Array:
        control_vehicle, predicted = to_vehicle_rows(x[:, :POSE], x[:, head:]), []
        for block, start, stop in zip(blocks, bounds[:-1], bounds[1:], strict=True):
            own = control_vehicle[:, start:stop]
            if not direct:
                own = block.fitted.refitted(own.reshape(len(x), -1, POINT)).reshape(len(x), -1)
            own = own - (x[:, POSE:head] - now) @ block.by_sensor.T
            predicted.append(own @ block.combinations)
        return np.concatenate(predicted, axis=1)

    columns = state.belief.measuring_columns(np.concatenate([block.columns for block in blocks]))
    measured = np.concatenate([block.fitted.points.ravel() @ block.combinations for block in blocks])
    noise = block_diag(*(b.combinations.T @ b.fitted.covariance @ b.combinations for b in blocks))
    if direct:
        noise += state.settings.ckf.sigma_kept**2 * np.eye(len(noise))
    state.belief.update(columns, predict, measured, noise)


def _fit(state: CurveState, label: int, detections: Detections, on: OnCurve) -> CurveBlock:
    """Returns S_z of one curve, on the control points that the detections reach."""
    settings = state.settings.ckf
    control = np.flatnonzero(on.basis.sum(axis=0) > settings.least_basis)
    known = to_vehicle_rows(state.pose[None], state.control_points(label)[control].reshape(1, -1))
    fitted = fit_detections(
        on.basis[:, control],
        detections.points_vehicle[on.rows],
        _widened(state, detections.covariances[on.rows], on.tangents),
        known.reshape(-1, POINT),
        settings,
    )
    measured = np.eye(len(control)) if settings.prediction == "direct" else fitted.range_basis()
    combinations: Array = np.asarray(np.kron(measured, np.eye(POINT)), float)
    expected = state.belief.by_sensor(on.basis[:, control] @ fitted.known)
    by_calibration = np.einsum("rm,mik->rik", fitted.gain, expected).reshape(-1, SENSOR_SIZE)
    return CurveBlock(state.columns(label, control), fitted, combinations, by_calibration)


def _widened(state: CurveState, covariances: Array, tangents: Array) -> Array:
    """Returns `K + sigma_model^2 I + sigma_along^2 t t'` (m, 2, 2), vehicle frame, of map tangents (m, 2)."""
    t = tangents @ rotation(state.pose[2])
    along = state.settings.ckf.sigma_along**2 * t[:, :, None] * t[:, None, :]
    return np.asarray(covariances + state.settings.ckf.sigma_model**2 * np.eye(POINT) + along)
