"""Weak priors on what detections leave free of a whole curve: the place of control points along it, shape."""

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
"""The smoothness of this number of neighbouring control points makes one factor. One factor for all of them
would join the whole curve in the elimination. The number changes the speed, not the result."""


@dataclass(frozen=True, eq=False)
class CurveGauge:
    """Holds the residuals `(h_k . (c_j - p_k) - ahead_j) / sigma` and `D c / sigma_smoothness` of a curve.

    p_k is the position of the pose that control point c_j began beside, and h_k is its heading. D is
    `smoothness_matrix`. A detection constrains nothing along a curve, so control points would slide along it,
    by metres in a hundred steps. Held beside a pose they don't, and the map is as free as before: wherever
    that pose goes, they go with it.
    """

    label: int
    """This is the label of the boundary."""
    keys: IntArray
    """These are the keys (m,) of its control points."""
    cycle: IntArray
    """Each entry (m,) is the perception cycle of the pose beside a control point."""
    ahead: Array
    """Each entry (m,) is the distance of a control point ahead of its pose (m)."""
    sigma: float
    """This is the standard deviation of that distance (m)."""
    smoothness: Array
    """This is D (r, m)."""
    sigma_smoothness: float
    """This is the standard deviation of a second difference (m)."""
    sigma_anchor: float
    """This standard deviation (m) holds each control point where it is linearized. The anchor has no
    gradient, so it isn't part of the cost."""

    def terms(self, control_points: Array, beside: Array) -> tuple[Array, Array, Array]:
        """Returns whitened residuals (m,) of control points (m, 2), each beside its pose (m, 3).

        Also returns their derivatives by the control point (m, 2) and by the pose (m, 3).
        """
        heading = np.column_stack([np.cos(beside[:, 2]), np.sin(beside[:, 2])]) / self.sigma
        arm = control_points - beside[:, :2]
        by_theta = heading[:, 0] * arm[:, 1] - heading[:, 1] * arm[:, 0]
        residual = (heading * arm).sum(axis=1) - self.ahead / self.sigma
        return residual, heading, np.column_stack([-heading, by_theta])

    def beside(self, control_points: Array, poses: Array) -> Rows:
        """Returns the same as rows on [control point | pose], from all poses (P, 3)."""
        residual, by_point, by_pose = self.terms(control_points, poses[self.cycle])
        return Rows(
            keys=np.column_stack([self.keys, pose_keys(self.cycle)]),
            jacobian=np.column_stack([by_point, by_pose]),
            residual=residual,
            owner=owners(self.cycle, self.label),
        )

    def smooth(self, control_points: Array) -> Rows:
        """Returns whitened second differences of three neighbours each, one row for x and one for y."""
        neighbours = (np.arange(len(self.smoothness))[:, None] + np.arange(3)) % len(self.keys)
        weights = np.take_along_axis(self.smoothness, neighbours, axis=1) / self.sigma_smoothness
        keys = np.repeat(self.keys[neighbours], POINT, axis=0)
        jacobian = (weights[:, None, :, None] * np.eye(POINT)[:, None, :]).reshape(-1, 3 * POINT)
        residual = (self.smoothness @ control_points).ravel() / self.sigma_smoothness
        return Rows(keys, jacobian, residual, self._owners(keys[:, 0]))

    def anchor(self) -> Rows:
        """Returns rows that hold each control point where it is."""
        keys = np.repeat(self.keys, POINT)
        jacobian = np.tile(np.eye(POINT), (len(self.keys), 1)) / self.sigma_anchor
        return Rows(keys[:, None], jacobian, np.zeros(len(keys)), self._owners(keys))

    def _owners(self, keys: IntArray) -> IntArray:
        """Returns the factor of each row on control points alone, by its first key.

        The numbers are negative, so that they differ from those of cycles.
        """
        return np.asarray(-1 - self.label - 2 * (indices(keys) // POINTS_A_FACTOR))

    def cost(self, control_points: Array, poses: Array) -> float:
        """Returns half the sum of the squared residuals at control points (m, 2) and all poses (P, 3)."""
        beside, _, _ = self.terms(control_points, poses[self.cycle])
        smooth = self.smoothness @ control_points / self.sigma_smoothness
        return 0.5 * float(beside @ beside + (smooth**2).sum())


def curve_gauge(state: State, label: int, sigma: float, until: int | None = None) -> CurveGauge:
    """Returns the gauge of a curve that holds each control point where it is now beside its pose.

    Only poses of the cycles before `until` hold control points.
    """
    boundary, control_points, poses = state.boundaries[label], state.control_points(label), state.poses
    poses = poses[:until]
    cycle = _nearest_poses(boundary, control_points, poses)
    heading = np.column_stack([np.cos(poses[cycle, 2]), np.sin(poses[cycle, 2])])
    mean_spacing = boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    return CurveGauge(
        label=label,
        keys=state.keys(label),
        cycle=cycle,
        ahead=(heading * (control_points - poses[cycle, :2])).sum(axis=1),
        sigma=sigma,
        smoothness=smoothness_matrix(boundary.abscissae, boundary.length if boundary.periodic else None),
        sigma_smoothness=boundary.gauge.sigma_smoothness * mean_spacing,
        sigma_anchor=boundary.gauge.sigma_anchor,
    )


def _nearest_poses(boundary: Boundary, control_points: Array, poses: Array) -> IntArray:
    """Returns (m,) the pose nearest to where each control point acts, of those with the curve's direction."""
    u = boundary.abscissae
    position, tangent = (boundary.evaluate(control_points, u, order) for order in (0, 1))
    dx, dy = position[:, :1] - poses[:, 0], position[:, 1:] - poses[:, 1]
    along = tangent[:, :1] * np.cos(poses[:, 2]) + tangent[:, 1:] * np.sin(poses[:, 2])
    square = dx**2 + dy**2
    square[along <= 0.0] += square.max(initial=0.0)
    return np.asarray(square.argmin(axis=1))
