"""Which readings update a curve: those of its colour that lie on what the vehicle sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import scatter
from pathspace_graph.factors.projection import project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.belief import point_columns

from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class OnCurve:
    """Readings of one cycle that lie on a curve."""

    rows: IntArray
    """(m,) which of the cycle's readings."""
    basis: Array
    """(m, n) values of the curve's n basis functions at their foot points: the paper's B."""
    tangents: Array
    """(m, 2) unit tangents there, map frame."""
    distances: Array
    """(m,) squared Mahalanobis distance across the curve."""

    def where(self, chosen: NDArray[np.bool_]) -> OnCurve:
        """Some of them."""
        return OnCurve(self.rows[chosen], self.basis[chosen], self.tangents[chosen], self.distances[chosen])


def classify(state: CurveState, detections: Detections) -> dict[int, OnCurve]:
    """Readings by the curve that they update; one of unknown colour goes to the nearer curve."""
    found = {label: on_curve(state, label, detections) for label in state.curves}
    nearest = np.full(len(detections.labels), np.inf)
    for on in found.values():
        nearest[on.rows] = np.minimum(nearest[on.rows], on.distances)
    return {label: on.where(on.distances <= nearest[on.rows]) for label, on in found.items()}


def on_curve(state: CurveState, label: int, detections: Detections) -> OnCurve:
    """Readings within the gate, `d^2 < chi^2 (n' K n + g' Sigma g)` with the joint covariance Sigma."""
    gate, curve = state.settings.gate, state.curves[label]
    rows = np.flatnonzero((detections.labels == label) | (detections.labels == UNKNOWN))
    poses = np.tile(state.pose, (len(rows), 1))
    points = to_map(detections.points_vehicle[rows], poses)
    foot = state.find(label, points, *state.visible(label, len(rows)))
    projected = project(points, detections.covariances[rows], poses, foot, state.settings.ckf.sigma_model)
    control = foot.span[:, None] + np.arange(-curve.degree, 1)
    control = control % curve.size if curve.periodic else control
    gradient = np.concatenate(
        [projected.by_pose, projected.by_control.reshape(len(rows), control.shape[1] * 2)], axis=1
    )
    variance = projected.sigma**2 + gate.sigma_floor**2 + _joint_variance(state, label, control, gradient)
    squared = foot.distance**2 / variance
    passes = foot.interior & (np.abs(foot.distance) < gate.rough) & (squared < gate.chi**2)
    basis = scatter(foot.basis, foot.span - curve.degree, curve.size, curve.periodic)
    return OnCurve(rows, basis, foot.tangent_unit, squared).where(passes)


def _joint_variance(state: CurveState, label: int, control: IntArray, gradient: Array) -> Array:
    """`g' Sigma g` (m,) of gradients (m, 3 + 2 (p + 1)) by the pose and the control points (m, p + 1)."""
    own = point_columns(state.offset(label) + control.ravel()).reshape(len(control), 2 * control.shape[1])
    columns = np.concatenate([np.tile(np.arange(POSE), (len(control), 1)), own], axis=1)
    block = state.belief.covariance[columns[:, :, None], columns[:, None, :]]
    return np.asarray(np.einsum("mi,mij,mj->m", gradient, block, gradient))
