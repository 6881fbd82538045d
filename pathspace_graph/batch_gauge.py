"""Weak priors on what readings leave free, over a whole curve: where its points are along it, smoothness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import smoothness_matrix

from .boundary import Boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class PoseRows:
    """Whitened rows, each on one pose and on a few entries of the border."""

    slot: IntArray
    """(m,) poses."""
    by_pose: Array
    """(m, 3) derivatives by (x, y, theta), map frame."""
    columns: IntArray
    """(m, k) entries of the border, ..."""
    by_border: Array
    """(m, k) ... and the derivatives by them."""
    residual: Array
    """(m,)."""


@dataclass(frozen=True, eq=False)
class CurveGauge:
    """`(h_k . (c_j - p_k) - ahead_j) / sigma` and `D c / sigma'`, D of `smoothness_matrix`.

    h_k is the heading of the pose p_k that control point c_j began beside. Readings say nothing along a
    curve, so its control points would slide, by metres and for a hundred steps. Held beside a pose they
    can't, and the map is as free as before: wherever that pose turns out to have been, they come along.
    """

    slot: IntArray
    """(m,) the pose that each control point is held beside."""
    ahead: Array
    """(m,) how far ahead of it (m)."""
    sigma: float
    """Its standard deviation, m."""
    smoothness: Array
    """(2m, 2m) `D' D / sigma'^2`; zero along a straight line."""
    anchor: float
    """Information (1/m^2) that holds each control point where it is: no gradient, so not in the cost."""

    def beside(self, control_points: Array, poses: Array, offset: int) -> PoseRows:
        """Whitened rows; control points (m, 2) are the border's entries from `offset` on, poses (P, 3)."""
        pose = poses[self.slot]
        heading = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])]) / self.sigma
        arm = control_points - pose[:, :2]
        by_theta = heading[:, 0] * arm[:, 1] - heading[:, 1] * arm[:, 0]
        columns = offset + 2 * np.arange(len(pose))[:, None] + np.arange(2)
        residual = (heading * arm).sum(axis=1) - self.ahead / self.sigma
        return PoseRows(self.slot, np.column_stack([-heading, by_theta]), columns, heading, residual)

    def cost(self, control_points: Array, poses: Array) -> float:
        """Half the sum of squares."""
        residual, flat = self.beside(control_points, poses, 0).residual, control_points.ravel()
        return 0.5 * float(residual @ residual + flat @ self.smoothness @ flat)


def curve_gauge(boundary: Boundary, control_points: Array, poses: Array, sigma: float) -> CurveGauge:
    """The gauge of a curve that begins with control points (m, 2), beside a drive of poses (P, 3)."""
    slot = _beside(boundary, control_points, poses)
    heading = np.column_stack([np.cos(poses[slot, 2]), np.sin(poses[slot, 2])])
    ahead = (heading * (control_points - poses[slot, :2])).sum(axis=1)
    abscissae, mean = boundary.abscissae, boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    scaled = smoothness_matrix(abscissae, boundary.length if boundary.periodic else None)
    scaled = scaled / (boundary.gauge.sigma_smoothness * mean)
    smoothness = np.asarray(np.kron(scaled.T @ scaled, np.eye(2)), float)
    return CurveGauge(slot, ahead, sigma, smoothness, boundary.gauge.sigma_anchor**-2.0)


def _beside(boundary: Boundary, control_points: Array, poses: Array) -> IntArray:
    """(m,) the pose nearest to where each control point acts, of those that head the same way."""
    u = boundary.abscissae
    position, tangent = (boundary.evaluate(control_points, u, order) for order in (0, 1))
    dx, dy = position[:, :1] - poses[:, 0], position[:, 1:] - poses[:, 1]
    along = tangent[:, :1] * np.cos(poses[:, 2]) + tangent[:, 1:] * np.sin(poses[:, 2])
    away = dx**2 + dy**2
    away[along <= 0.0] += away.max(initial=0.0)
    return np.asarray(away.argmin(axis=1))
