"""The curves as the engine sees them: rows of detections (paper: Update) and of weak priors, on keys."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.gauge import pair_residuals
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.projection import project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import CONTROL_LETTERS, SENSOR_KEY, control_keys, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Gauge

from .detections import DetectionTable
from .state import State

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POINTS_PER_FACTOR = 6
"""The weak priors of this number of consecutive control points are one factor, so that there are few factors
and each of them is small."""


class CurveMap:
    """Holds both boundaries and the detections of the window's poses, and builds their rows."""

    def __init__(self, settings: MapperSettings, state: State | None = None) -> None:
        self.settings = settings
        self.state = state or State()
        """The state holds the curves and all variables."""
        self.variables = self.state.variables
        self.detections = DetectionTable()
        """The table holds the detections of the poses in the window."""
        self.held_by_prior = False
        """The prior holds the spacing and the shape of the curves, which the window then does not."""
        self.scatter: dict[int, Array] = {}
        """Cones scatter about a boundary's curve by this sigma (m,) at each control point (m), where it is
        known."""
        self.cones: dict[int, Array] = {}
        """The cones of a closed boundary were detected at these parameters (k,) (m), where they are known."""
        self.reached_inactive = False
        """The flag is set when a foot point of the latest `rows` has slid to an inactive part of a curve."""
        self._found: tuple[IntArray, Array] = (np.zeros(0, np.intp), np.zeros(0))

    # --- detections --------------------------------------------------------------------------------------

    def changed(self) -> IntArray:
        """Returns the cycles (k,) whose associations have changed since they were last linearized."""
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Returns `w_i n_i . (R z_i + t - S(u_i)) / sigma_i` for the detections in use of ascending cycles.

        The keys are [pose | control points of the span]; w is the root of the Huber weight, and zero if the
        foot point is not interior. The refined parameters u are stored in the table only by `linearized`.
        """
        state, detections = self.state, self.detections
        if not state.boundaries or len(cycles) == 0:
            return []
        rows = np.flatnonzero(detections.used & detections.in_cycles(cycles))
        curves, cycle = state.curves, detections.cycle[rows]
        curve = curves.number(detections.boundary[rows])
        poses = self.variables.poses_at(cycle)
        points = to_map(detections.corrected(rows, self.variables.sensor), poses)
        foot = curves.refine(state.map_points, points, curve, detections.u[rows])
        self._found, self.reached_inactive = (rows, foot.u), curves.reaches_inactive(curve, foot)
        jacobian, residual = self._across(rows, points, poses, foot)
        keys = np.concatenate([self.measuring_keys(cycle), curves.keys[foot.columns]], axis=1)
        return [Rows(keys, jacobian, residual, cycle)]

    def measuring_keys(self, cycles: IntArray) -> IntArray:
        """Returns the keys (m, k) that the detections of cycles (m,) depend on beside the curves.

        These are the pose, and the calibration of the sensor where it is estimated.
        """
        poses = pose_keys(cycles)[:, None]
        if not len(self.variables.sensor):
            return poses
        return np.concatenate([poses, np.full_like(poses, SENSOR_KEY)], axis=1)

    def correct(self) -> None:
        """Corrects the detections by the present calibration of the sensor."""
        self.detections.correct(self.variables.sensor)

    def _across(self, rows: IntArray, points: Array, poses: Array, foot: FootPoints) -> tuple[Array, Array]:
        """Returns the weighted Jacobian (m, 3 + q + 2 (degree + 1)) and residual (m,) of signed distances.

        The detections (m,) are at points (m, 2), map frame, from poses (m, 3). Their q derivatives by the
        sensor's calibration are 5 or none.
        """
        settings, detections = self.settings, self.detections
        projected = project(points, detections.covariance[rows], poses, foot, settings.spline.sigma_model)
        by = detections.sensor_rows(rows, foot.normal_unit, projected.residual, poses, self.variables.sensor)
        residual = by.factor * projected.residual
        weight = np.sqrt(huber_weights(residual / projected.sigma, settings.gate.huber))
        weight *= foot.interior / projected.sigma
        by_control = projected.by_control.reshape(len(rows), 2 * foot.basis.shape[1])
        factor = by.factor[:, None]
        jacobian = np.concatenate([factor * projected.by_pose, by.by_sensor, factor * by_control], axis=1)
        return jacobian * weight[:, None], residual * weight

    def linearized(self, cycles: IntArray) -> None:
        """Accepts the latest `rows`, of these cycles: the graph holds them from now on."""
        if len(cycles) and self.state.boundaries:
            self.detections.refine(*self._found)
            self.detections.mark_linearized()

    def activate(self, keys: IntArray) -> None:
        """Makes control points active, which lie next to the active ones."""
        for label, indices in self.state.active_stretch.items():
            numbers = self.state.keys(label)[:1] + np.arange(indices[0])
            back = np.flatnonzero(np.isin(numbers, keys))
            self.state.active_stretch[label] = np.append(back, indices)

    def move(self, motion: Array) -> None:
        """Moves the cones that the curves were grown through by a rigid motion (3,) of the map frame."""
        for boundary in self.state.boundaries.values():
            boundary.move(motion)

    def activate_all(self) -> None:
        """Makes every control point active."""
        self.state.active_stretch = {}

    def drop_cycle(self, cycle: int) -> None:
        """Removes the detections of a cycle whose pose, the oldest one, has left the window."""
        self.detections.keep_from(cycle + 1)
        self.state.drop_oldest_pose_u()

    # --- weak priors -------------------------------------------------------------------------------------

    @property
    def structure(self) -> object:
        """Returns an object that is replaced when the weak priors hold other control points than before."""
        return self.state.curves if self.state.boundaries else None

    def gauge(self, whole: bool) -> list[Rows]:
        """Returns the spacing `(|c_{j+1} - c_j| - nominal_j) / (sigma_spacing nominal_j)`.

        The rows hold the active control points, or all of them if `whole`.
        """
        if not self.state.boundaries or self.held_by_prior:
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
        """Returns the linear priors: smoothness `D c / (sigma_smoothness spacing)`, and anchors.

        An anchor holds each control point where it is, so weakly that it only keeps the system regular. The
        rows hold the active control points, or all of them if `whole`.
        """
        smooth, anchors = [], []
        for label, gauge in self._gauges(whole):
            points, held = self.state.control_points(label), np.eye(2) / self.settings.gauge.sigma_anchor
            bent = (gauge.bending[:, :, None] * points[gauge.triples]).sum(axis=1)
            if not self.held_by_prior:
                smooth.append(self._rows(label, gauge.triples, _by_axis(gauge.bending), bent.ravel()))
            active = gauge.points[:, None]
            held = np.tile(held, (len(active), 1))
            anchors.append(self._rows(label, active, held, np.zeros(len(held))))
        return [_stacked(groups) for groups in (smooth, anchors) if groups]

    def _gauges(self, whole: bool) -> Iterator[tuple[int, Gauge]]:
        for label, boundary in self.state.boundaries.items():
            yield label, boundary.gauge_on(boundary.everything if whole else self.state.active(label))

    def _rows(self, label: int, points: IntArray, jacobian: Array, residual: Array) -> Rows:
        """Returns rows, equally many for each row of `points` (m, k); neighbouring points share an owner."""
        repeated = np.repeat(points, len(residual) // max(len(points), 1), axis=0)
        owner = len(CONTROL_LETTERS) * (repeated[:, 0] // POINTS_PER_FACTOR) + label
        return Rows(
            control_keys(label, self.state.boundaries[label].first + repeated), jacobian, residual, owner
        )


def _stacked(groups: Sequence[Rows]) -> Rows:
    """Concatenates groups of rows that have equally many keys."""
    return Rows(
        keys=np.concatenate([rows.keys for rows in groups]),
        jacobian=np.concatenate([rows.jacobian for rows in groups]),
        residual=np.concatenate([rows.residual for rows in groups]),
        owner=np.concatenate([rows.owner for rows in groups]),
    )


def _by_axis(coefficients: Array) -> Array:
    """Returns (2 m, 2 k) the coefficients (m, k) of k points, once for x and once for y."""
    both = np.zeros((len(coefficients), 2, coefficients.shape[1], 2))
    both[:, 0, :, 0] = both[:, 1, :, 1] = coefficients
    return both.reshape(2 * len(coefficients), 2 * coefficients.shape[1])


CurveSmoother: TypeAlias = FixedLagSmoother[CurveMap]
"""This is the fixed-lag engine on both boundaries' curves."""
