"""The curves as the engine sees them: rows of readings (paper: Update) and of weak priors, on keys."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.gauge import pair_residuals
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.projection import offset_from_foot_point, project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import CONTROL_LETTERS, POSE, control_keys, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Gauge

from .detections import DetectionTable
from .state import State

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

TOGETHER = 6
"""Control points in a row whose weak priors are one factor: few factors, and small ones."""


class CurveMap:
    """Both boundaries, the readings of the poses in the window, and the rows that both make."""

    def __init__(self, settings: MapperSettings, state: State | None = None) -> None:
        self.settings = settings
        self.state = state or State()
        """The curves, and all variables."""
        self.variables = self.state.variables
        self.detections = DetectionTable()
        """Readings of the poses in the window."""
        self.slid = False
        """Whether a reading of the rows asked for last has slid to where an open curve is inactive."""
        self._found: tuple[IntArray, Array] = (np.zeros(0, np.intp), np.zeros(0))

    # --- readings ----------------------------------------------------------------------------------------

    def changed(self) -> IntArray:
        """(k,) cycles whose readings in use have changed since they were linearized last."""
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        """`w_i n_i . (R z_i + t - S(u_i)) / sigma_i` of the readings in use of some cycles.

        Keys [pose | control points of the span]; w the root of the Huber weight, zero where the foot point is
        not interior. The readings are left as they are. Of the residual `point` two rows each.
        """
        state, detections, settings = self.state, self.detections, self.settings
        if not state.boundaries or len(cycles) == 0:
            return []
        wanted = np.zeros(int(cycles[-1]) + 1, bool)
        wanted[cycles] = True
        rows = np.flatnonzero(detections.used[: detections.cycle.searchsorted(len(wanted))])
        rows = rows[wanted[detections.cycle[rows]]]
        curves, cycle = state.curves, detections.cycle[rows]
        curve = curves.number(detections.boundary[rows])
        poses = self.variables.poses_at(cycle)
        points = to_map(detections.point[rows], poses)
        foot = curves.refine(state.map_points, points, curve, detections.u[rows])
        self._found, self.slid = (rows, foot.u), curves.cut_off(curve, foot)
        measured = points, detections.covariance[rows], poses, foot, settings
        jacobian, residual = (
            _to_point(*measured) if settings.spline.residual == "point" else _across(*measured)
        )
        keys = np.concatenate([pose_keys(cycle)[:, None], curves.keys[foot.columns]], axis=1)
        doubled = len(residual) // max(len(rows), 1)
        return [Rows(np.repeat(keys, doubled, axis=0), jacobian, residual, np.repeat(cycle, doubled))]

    def linearized(self, cycles: IntArray) -> None:
        """The rows that were asked for last, of these cycles, are those of the graph from now on."""
        if len(cycles) and self.state.boundaries:
            rows, u = self._found
            self.detections.u[rows], self.detections.changed[:] = u, False

    def all_active(self) -> None:
        """Every control point is active again."""
        self.state.narrowed = {}

    def leave(self, cycle: int) -> None:
        """The pose of a cycle, the window's oldest, has left with its readings."""
        self.detections.keep_from(cycle + 1)
        self.state.drop_oldest_pose_u()

    # --- weak priors -------------------------------------------------------------------------------------

    @property
    def structure(self) -> object:
        """Another object where the weak priors are between other control points than before."""
        return self.state.curves if self.state.boundaries else None

    def gauge(self, whole: bool) -> list[Rows]:
        """Spacing between the active control points, or between all.

        `(|c_{j+1} - c_j| - nominal_j) / (sigma_spacing nominal_j)`.
        """
        if not self.state.boundaries:
            return []
        found = []
        for label, gauge in self._gauges(whole):
            points, sigma = (
                self.state.control_points(label),
                self.settings.gauge.sigma_spacing * gauge.nominal,
            )
            first, second = points[gauge.pairs[:, 0]], points[gauge.pairs[:, 1]]
            off, direction = pair_residuals(first, second, gauge.nominal)
            jacobian = np.concatenate([-direction, direction], axis=1) / sigma[:, None]
            found.append(self._rows(label, gauge.pairs, jacobian, off / sigma))
        return [_stacked(found)]

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """Smoothness and anchor between the active control points, or between all: rows that are linear.

        `D c / (sigma_smoothness spacing)`, and an anchor that holds each point where it is, so weakly that it
        only keeps the system regular.
        """
        smooth, anchors = [], []
        for label, gauge in self._gauges(whole):
            points, held = self.state.control_points(label), np.eye(2) / self.settings.gauge.sigma_anchor
            bent = (gauge.bending[:, :, None] * points[gauge.triples]).sum(axis=1)
            smooth.append(self._rows(label, gauge.triples, _by_axis(gauge.bending), bent.ravel()))
            active = gauge.points[:, None]
            held = np.tile(held, (len(active), 1))
            anchors.append(self._rows(label, active, held, np.zeros(len(held))))
        return [_stacked(smooth), _stacked(anchors)] if smooth else []

    def _gauges(self, whole: bool) -> Iterator[tuple[int, Gauge]]:
        for label, boundary in self.state.boundaries.items():
            yield label, boundary.gauge_on(boundary.everything if whole else self.state.active(label))

    def _rows(self, label: int, points: IntArray, jacobian: Array, residual: Array) -> Rows:
        """Rows, equally many of each line of points (m, k); those of neighbouring points have one owner."""
        repeated = np.repeat(points, len(residual) // max(len(points), 1), axis=0)
        owner = len(CONTROL_LETTERS) * (repeated[:, 0] // TOGETHER) + label
        return Rows(
            control_keys(label, self.state.boundaries[label].first + repeated), jacobian, residual, owner
        )


def _stacked(groups: Sequence[Rows]) -> Rows:
    """Rows of one pattern, one group after the other."""
    return Rows(
        keys=np.concatenate([rows.keys for rows in groups]),
        jacobian=np.concatenate([rows.jacobian for rows in groups]),
        residual=np.concatenate([rows.residual for rows in groups]),
        owner=np.concatenate([rows.owner for rows in groups]),
    )


def _by_axis(coefficients: Array) -> Array:
    """(2 m, 2 k) the same coefficients (m, k) on x and on y of k points, a row each."""
    both = np.zeros((len(coefficients), 2, coefficients.shape[1], 2))
    both[:, 0, :, 0] = both[:, 1, :, 1] = coefficients
    return both.reshape(2 * len(coefficients), 2 * coefficients.shape[1])


def _across(
    points: Array, covariances: Array, poses: Array, foot: FootPoints, settings: MapperSettings
) -> tuple[Array, Array]:
    """Weighted Jacobian (m, 3 + 2 (degree + 1)) and residual (m,) of the distances across the curve."""
    projected = project(points, covariances, poses, foot, settings.spline.sigma_model)
    whitened = projected.residual / projected.sigma
    weight = np.sqrt(huber_weights(whitened, settings.gate.huber)) * foot.interior / projected.sigma
    by_control = projected.by_control.reshape(len(points), 2 * foot.basis.shape[1])
    jacobian = np.concatenate([projected.by_pose, by_control], axis=1)
    return jacobian * weight[:, None], projected.residual * weight


def _to_point(
    points: Array, covariances: Array, poses: Array, foot: FootPoints, settings: MapperSettings
) -> tuple[Array, Array]:
    """The same (2 m, ...) and (2 m,) of the offsets from the foot points, a reading's two rows together."""
    projected = offset_from_foot_point(points, covariances, poses, foot, settings.spline.sigma_model)
    size = np.hypot(projected.residual[:, 0], projected.residual[:, 1])
    weight = np.repeat(np.sqrt(huber_weights(size, settings.gate.huber)) * foot.interior, 2)
    by_control = projected.by_control.reshape(len(weight), 2 * foot.basis.shape[1])
    jacobian = np.concatenate([projected.by_pose.reshape(len(weight), POSE), by_control], axis=1)
    return jacobian * weight[:, None], projected.residual.ravel() * weight


CurveSmoother = FixedLagSmoother[CurveMap]
"""The engine on both boundaries' curves."""
