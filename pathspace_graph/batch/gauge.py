"""Weak priors on what detections leave free of a whole curve: the place of control points along it, shape."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.residuals import smoothness_matrix
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.elimination import owners
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POINT, POSE, indices, pose_keys
from pathspace_graph.mapping.state import State

POINTS_A_FACTOR: Final = 8
"""Neighbouring control points in one factor of their anchors. One factor for all of them would join the whole
curve in the elimination. The number changes the speed, not the result."""


@dataclass(frozen=True, eq=False)
class CurveGauge:
    """The residuals `(h_k . (c_j - p_k) - ahead_j) / sigma` and `R_k' D c / sigma_smoothness` of a curve.

    p_k is the position of the pose that control point c_j of the curve began beside, h_k is its heading, and
    R_k its rotation. D is `smoothness_matrix`. A detection constrains nothing along a curve, so control
    points would slide along it, by metres in a hundred steps. Held beside a pose they don't, and the map is
    as free as before: wherever that pose goes, they go with it.
    """

    label: int
    keys: IntArray
    """Keys (m,) of the control points."""
    cycle: IntArray
    """Perception cycles (m,) of the poses beside them."""
    ahead: Array
    """Distances (m,) of the control points ahead of their poses (m)."""
    sigma: float
    """Standard deviation of that distance (m)."""
    smoothness: Array
    """D (r, m)."""
    sigma_smoothness: float
    """Standard deviation of a second difference (m)."""
    sigma_anchor: float
    """Standard deviation (m) that holds each control point where it is linearized. The anchor has no
    gradient, so it isn't part of the cost."""

    def terms(self, control_points: Array, beside: Array) -> tuple[Array, Array, Array]:
        """Return whitened residuals (m,) of control points (m, 2) beside poses (m, 3), and derivatives."""
        heading = _headings(beside) / self.sigma
        arm = control_points - beside[:, :2]
        by_theta = heading[:, 0] * arm[:, 1] - heading[:, 1] * arm[:, 0]
        residual = (heading * arm).sum(axis=1) - self.ahead / self.sigma
        return residual, heading, np.column_stack([-heading, by_theta])

    def beside(self, control_points: Array, poses: Array) -> Rows:
        """Return `terms` as rows on [control point | pose], from all poses (P, 3)."""
        residual, by_point, by_pose = self.terms(control_points, poses[self.cycle])
        jacobian = np.column_stack([by_point, by_pose])
        return Rows(self._keys_beside, jacobian, residual, owners(self.cycle, self.label))

    def bending(self, control_points: Array, poses: Array) -> tuple[Array, Array, Array]:
        """Return the second differences as the poses beside their middles see them, whitened (r, 2).

        Also return their derivatives by the three control points (r, 2, 6) and by the pose (r, 2, 3). In the
        map frame a second difference turns with the map, and Gauss-Newton would take that turn for a change
        of shape. It would know the heading at the end of a winding road better than any measurement does.
        """
        neighbours, theta = self.neighbours, poses[self.middle_cycle, 2]
        c, s = np.cos(theta), np.sin(theta)
        turned = np.moveaxis(np.array([[c, s], [-s, c]]), 2, 0)
        weights = np.take_along_axis(self.smoothness, neighbours, axis=1) / self.sigma_smoothness
        in_map = (weights[:, :, None] * control_points[neighbours]).sum(axis=1)
        residual = (turned @ in_map[:, :, None])[:, :, 0]
        by_control = weights[:, None, :, None] * turned[:, :, None, :]
        by_pose = np.zeros((len(residual), POINT, POSE))
        by_pose[:, 0, 2], by_pose[:, 1, 2] = residual[:, 1], -residual[:, 0]
        return residual, by_control.reshape(len(residual), POINT, -1), by_pose

    def smooth(self, control_points: Array, poses: Array) -> Rows:
        """Return `bending` as rows on [three control points | pose], two rows for each second difference."""
        residual, by_control, by_pose = self.bending(control_points, poses)
        keys = np.column_stack([self.keys[self.neighbours], pose_keys(self.middle_cycle)])
        return Rows(
            keys=np.repeat(keys, POINT, axis=0),
            jacobian=np.concatenate([by_control, by_pose], axis=2).reshape(residual.size, -1),
            residual=residual.ravel(),
            owner=np.repeat(owners(self.middle_cycle, self.label), POINT),
        )

    @property
    def neighbours(self) -> IntArray:
        """Return the three control points (r, 3) of each second difference, by index."""
        return np.asarray((np.arange(len(self.smoothness))[:, None] + np.arange(3)) % len(self.keys))

    @property
    def middle_cycle(self) -> IntArray:
        """Return the cycle (r,) of the pose beside the middle of each second difference."""
        return np.asarray(self.cycle[self.neighbours[:, 1]])

    @property
    def _keys_beside(self) -> IntArray:
        return np.column_stack([self.keys, pose_keys(self.cycle)])

    def anchor(self) -> Rows:
        """Return rows that hold each control point where it is.

        The numbers of their factors are negative, so that they differ from those of cycles.
        """
        keys = np.repeat(self.keys, POINT)
        jacobian = np.tile(np.eye(POINT), (len(self.keys), 1)) / self.sigma_anchor
        owner = np.asarray(-1 - self.label - 2 * (indices(keys) // POINTS_A_FACTOR))
        return Rows(keys[:, None], jacobian, np.zeros(len(keys)), owner)

    def damping(self, control_points: Array, poses: Array, weight: float) -> Rows:
        """Return rows `sqrt(weight) (dc_j - dp_k - dtheta_k J (c_j - p_k))`, two for each control point.

        They damp how a control point moves as seen from the pose beside it, in 1/m^2, and not a map that
        swings with its poses, as an error of the yaw rate swings it. J is the quarter turn.
        """
        arm = control_points - poses[self.cycle, :2]
        by_point, by_theta = np.tile(np.eye(POINT), (len(arm), 1)), np.column_stack([arm[:, 1], -arm[:, 0]])
        return Rows(
            keys=np.repeat(self._keys_beside, POINT, axis=0),
            jacobian=np.sqrt(weight) * np.column_stack([by_point, -by_point, by_theta.ravel()]),
            residual=np.zeros(POINT * len(arm)),
            owner=np.repeat(owners(self.cycle, self.label), POINT),
        )

    def carried(self, control_points: Array, poses: Array, poses_after: Array) -> Array:
        """Return control points (m, 2) moved rigidly with the poses beside them, from and to (P, 3)."""
        before, after = poses[self.cycle], poses_after[self.cycle]
        turned = np.column_stack([np.zeros((len(before), 2)), after[:, 2] - before[:, 2]])
        return after[:, :2] + to_map(control_points - before[:, :2], turned)

    def cost(self, control_points: Array, poses: Array) -> float:
        """Return half the sum of the squared residuals at control points (m, 2) and all poses (P, 3)."""
        beside, _, _ = self.terms(control_points, poses[self.cycle])
        smooth = self.smoothness @ control_points / self.sigma_smoothness
        return 0.5 * float(beside @ beside + (smooth**2).sum())


def curve_gauge(state: State, label: int, sigma: float, until: int | None = None) -> CurveGauge:
    """Return the gauge that holds each control point where it is, beside a pose of a cycle before `until`."""
    boundary, control_points, poses = state.boundaries[label], state.control_points(label), state.poses
    mean_spacing = boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    cycle = _nearest_poses(state, label, until, mean_spacing)
    return CurveGauge(
        label=label,
        keys=state.keys(label),
        cycle=cycle,
        ahead=(_headings(poses[cycle]) * (control_points - poses[cycle, :2])).sum(axis=1),
        sigma=sigma,
        smoothness=smoothness_matrix(boundary.abscissae, boundary.length if boundary.periodic else None),
        sigma_smoothness=boundary.gauge.sigma_smoothness * mean_spacing,
        sigma_anchor=boundary.gauge.sigma_anchor,
    )


def _headings(poses: Array) -> Array:
    return np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])


def _nearest_poses(state: State, label: int, until: int | None, room: float) -> IntArray:
    """Return (m,) the pose nearest to where each control point acts, of those with the curve's direction.

    On an open curve, it is one of those whose places along the curve are nearest, give or take `room` (m): a
    curve that has drifted over itself would else be tied to a pose of another stretch.
    """
    boundary, points, poses = state.boundaries[label], state.control_points(label), state.poses[:until]
    u = boundary.abscissae
    position, tangent = (boundary.evaluate(points, u, order) for order in (0, 1))
    dx, dy = position[:, :1] - poses[:, 0], position[:, 1:] - poses[:, 1]
    along = tangent[:, :1] * np.cos(poses[:, 2]) + tangent[:, 1:] * np.sin(poses[:, 2])
    square = dx**2 + dy**2
    square[along <= 0.0] += square.max(initial=0.0)
    if not boundary.periodic:
        away = np.abs(u[:, None] - state.pose_u[label][:until])
        square[away > away.min(axis=1, keepdims=True) + room] = np.inf
    return np.asarray(square.argmin(axis=1))
