"""The one Kalman update of a cycle, on the control points that its readings reach (paper: Update)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.keys import POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.belief import PLANE, to_vehicle_rows

from .association import OnCurve
from .fit import SplineMeasurement, fit_detections
from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Part:
    """S_z of one curve, as a measurement."""

    columns: IntArray
    """(2 r,) entries of the state of the control points that it is of."""
    fitted: SplineMeasurement
    """S_z, vehicle frame."""
    combine: Array
    """(2 r, q) the combinations of its entries that are measured."""


def update(state: CurveState, detections: Detections, found: dict[int, OnCurve]) -> None:
    """S_z of each curve, then one Kalman update of pose and map with both of them."""
    parts = [_part(state, label, detections, on) for label, on in found.items() if len(on.rows)]
    if not parts:
        return
    direct = state.settings.ckf.prediction == "direct"
    stops = POSE + np.cumsum([0] + [len(part.columns) for part in parts])

    def predicted(x: Array) -> Array:
        seen = to_vehicle_rows(x[:, :POSE], x[:, POSE:])
        blocks = []
        for part, start, stop in zip(parts, stops[:-1] - POSE, stops[1:] - POSE, strict=True):
            own = seen[:, start:stop]
            if not direct:
                own = part.fitted.refitted(own.reshape(len(x), -1, PLANE)).reshape(len(x), -1)
            blocks.append(own @ part.combine)
        return np.concatenate(blocks, axis=1)

    columns = np.concatenate([np.arange(POSE), *(part.columns for part in parts)])
    measured = np.concatenate([part.fitted.points.ravel() @ part.combine for part in parts])
    noise = block_diag(*(part.combine.T @ part.fitted.covariance @ part.combine for part in parts))
    if direct:
        noise += state.settings.ckf.sigma_kept**2 * np.eye(len(noise))
    state.belief.update(columns, predicted, measured, noise)


def _part(state: CurveState, label: int, detections: Detections, on: OnCurve) -> _Part:
    """S_z of one curve from the readings on it."""
    settings = state.settings.ckf
    control = np.flatnonzero(on.basis.sum(axis=0) > settings.least_basis)
    known = to_vehicle_rows(state.pose[None], state.control_points(label)[control].reshape(1, -1))
    fitted = fit_detections(
        on.basis[:, control],
        detections.points_vehicle[on.rows],
        _widened(state, detections.covariances[on.rows], on.tangents),
        known.reshape(-1, PLANE),
        settings,
    )
    measured = np.eye(len(control)) if settings.prediction == "direct" else fitted.basis()
    combine: Array = np.asarray(np.kron(measured, np.eye(PLANE)), float)
    return _Part(state.columns(label, control), fitted, combine)


def _widened(state: CurveState, covariances: Array, tangents: Array) -> Array:
    """`K + sigma_model^2 I + sigma_along^2 t t'` (m, 2, 2), vehicle frame; tangents (m, 2) in the map."""
    t = tangents @ rotation(state.pose[2])
    along = state.settings.ckf.sigma_along**2 * t[:, :, None] * t[:, None, :]
    return np.asarray(covariances + state.settings.ckf.sigma_model**2 * np.eye(PLANE) + along)
