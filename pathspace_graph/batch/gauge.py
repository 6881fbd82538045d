"""Weak priors on what readings leave free, over a whole curve: where its points are along it, smoothness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import smoothness_matrix
from pathspace_graph.graph.elimination import owners
from pathspace_graph.graph.keys import POINT, indices, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.mapping.state import State
from pathspace_graph.spline.boundary import Boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POINTS_A_FACTOR = 8
"""Neighbouring control points whose smoothness makes one factor: all in one would join the whole curve."""


@dataclass(frozen=True, eq=False)
class CurveGauge:
    """`(h_k . (c_j - p_k) - ahead_j) / sigma` and `D c / sigma'`, D of `smoothness_matrix`.

    h_k is the heading of the pose p_k that control point c_j began beside. Readings say nothing along a
    curve, so its control points would slide, by metres and for a hundred steps. Held beside a pose they
    can't, and the map is as free as before: wherever that pose turns out to have been, they come along.
    """

    label: int
    """The boundary."""
    keys: IntArray
    """(m,) its control points."""
    cycle: IntArray
    """(m,) perception cycle of the pose that each is held beside."""
    ahead: Array
    """(m,) how far ahead of it (m)."""
    sigma: float
    """Its standard deviation, m."""
    smoothness: Array
    """(r, m) D."""
    sigma_smoothness: float
    """sigma', m."""
    sigma_anchor: float
    """Standard deviation (m) that holds each control point where it is: no gradient, so not in the cost."""

    def terms(self, control_points: Array, beside: Array) -> tuple[Array, Array, Array]:
        """Whitened residuals (m,) of control points (m, 2), each beside its pose (m, 3), and derivatives.

        (m, 2) by the control point, (m, 3) by the pose.
        """
        heading = np.column_stack([np.cos(beside[:, 2]), np.sin(beside[:, 2])]) / self.sigma
        arm = control_points - beside[:, :2]
        by_theta = heading[:, 0] * arm[:, 1] - heading[:, 1] * arm[:, 0]
        residual = (heading * arm).sum(axis=1) - self.ahead / self.sigma
        return residual, heading, np.column_stack([-heading, by_theta])

    def beside(self, control_points: Array, poses: Array) -> Rows:
        """The same as rows on [control point | pose], from all poses (P, 3)."""
        residual, by_point, by_pose = self.terms(control_points, poses[self.cycle])
        return Rows(
            keys=np.column_stack([self.keys, pose_keys(self.cycle)]),
            jacobian=np.column_stack([by_point, by_pose]),
            residual=residual,
            owner=owners(self.cycle, self.label),
        )

    def smooth(self, control_points: Array) -> Rows:
        """Whitened second differences, one row for x and one for y: each is of three neighbours."""
        near = (np.arange(len(self.smoothness))[:, None] + np.arange(3)) % len(self.keys)
        weights = np.take_along_axis(self.smoothness, near, axis=1) / self.sigma_smoothness
        keys = np.repeat(self.keys[near], POINT, axis=0)
        jacobian = (weights[:, None, :, None] * np.eye(POINT)[:, None, :]).reshape(-1, 3 * POINT)
        residual = (self.smoothness @ control_points).ravel() / self.sigma_smoothness
        return Rows(keys, jacobian, residual, self._owners(keys[:, 0]))

    def anchor(self) -> Rows:
        """Rows that hold each control point where it is."""
        keys = np.repeat(self.keys, POINT)
        jacobian = np.tile(np.eye(POINT), (len(self.keys), 1)) / self.sigma_anchor
        return Rows(keys[:, None], jacobian, np.zeros(len(keys)), self._owners(keys))

    def _owners(self, keys: IntArray) -> IntArray:
        """The factor of rows on control points alone, by the first of each: numbers below those of cycles."""
        return np.asarray(-1 - self.label - 2 * (indices(keys) // POINTS_A_FACTOR))

    def cost(self, control_points: Array, poses: Array) -> float:
        """Half the sum of squares."""
        beside, _, _ = self.terms(control_points, poses[self.cycle])
        smooth = self.smoothness @ control_points / self.sigma_smoothness
        return 0.5 * float(beside @ beside + (smooth**2).sum())


def curve_gauge(state: State, label: int, sigma: float) -> CurveGauge:
    """The gauge of a boundary's curve as it is, beside the poses as they are."""
    boundary, control_points, poses = state.boundaries[label], state.control_points(label), state.poses
    cycle = _beside(boundary, control_points, poses)
    heading = np.column_stack([np.cos(poses[cycle, 2]), np.sin(poses[cycle, 2])])
    mean = boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    return CurveGauge(
        label=label,
        keys=state.keys(label),
        cycle=cycle,
        ahead=(heading * (control_points - poses[cycle, :2])).sum(axis=1),
        sigma=sigma,
        smoothness=smoothness_matrix(boundary.abscissae, boundary.length if boundary.periodic else None),
        sigma_smoothness=boundary.gauge.sigma_smoothness * mean,
        sigma_anchor=boundary.gauge.sigma_anchor,
    )


def _beside(boundary: Boundary, control_points: Array, poses: Array) -> IntArray:
    """(m,) the pose nearest to where each control point acts, of those that head the same way."""
    u = boundary.abscissae
    position, tangent = (boundary.evaluate(control_points, u, order) for order in (0, 1))
    dx, dy = position[:, :1] - poses[:, 0], position[:, 1:] - poses[:, 1]
    along = tangent[:, :1] * np.cos(poses[:, 2]) + tangent[:, 1:] * np.sin(poses[:, 2])
    away = dx**2 + dy**2
    away[along <= 0.0] += away.max(initial=0.0)
    return np.asarray(away.argmin(axis=1))
