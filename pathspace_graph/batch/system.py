"""The least-squares problem of a whole log: its cost at a state, and its linear factors there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.projection import ProjectionRows, project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.sensor import SensorRows, range_rates, sensor_rows
from pathspace_graph.front_end.log_odometry import LogOdometry, sensor_prior, sensor_prior_cost
from pathspace_graph.graph.elimination import Elimination, fix_map, linear_graph, owners
from pathspace_graph.graph.keys import SENSOR_KEY, are_poses, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from .gauge import CurveGauge, curve_gauge

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Biweight:
    """Tukey's robust loss `rho(z) = g^2 / 6 (1 - (1 - z^2 / g^2)^3)`, which is constant beyond the gate g.

    A detection at the gate has no weight. So nothing moves when one more or one less is used. With Huber's
    loss and a hard gate it would.
    """

    gate: float
    """This is the gate g in sigmas."""

    def loss(self, whitened: Array) -> Array:
        """Returns `rho(z)` (m,) of whitened residuals z (m,)."""
        return np.asarray(self.gate**2 / 6.0 * (1.0 - self._inner(whitened) ** 3))

    def weights(self, whitened: Array) -> Array:
        """Returns the robust weights `rho'(z) / z = (1 - z^2 / g^2)^2` (m,)."""
        return np.asarray(self._inner(whitened) ** 2)

    @property
    def ceiling(self) -> float:
        """Returns the loss of a detection that isn't used, which is that at the gate."""
        return float(self.loss(np.array([self.gate]))[0])

    def _inner(self, whitened: Array) -> Array:
        return np.maximum(1.0 - (whitened / self.gate) ** 2, 0.0)


@dataclass(frozen=True, eq=False)
class Projected:
    """Holds the detections that are used on one boundary, projected on its curve at a state."""

    rows: IntArray
    """These are the rows (m,) of the detections in their table."""
    foot: FootPoints
    """These are their foot points."""
    projection: ProjectionRows
    """These are their residuals and derivatives."""
    sigma: Array
    """These are their standard deviations (m,) across the curve in m, which a round holds."""
    inside: BoolArray
    """Each flag (m,) is set where the foot point was inside the curve when the round began. A round holds it,
    so that the cost does not jump where an end of an open curve slides past a detection."""
    by: SensorRows
    """This is how their residuals depend on the calibration of the sensor."""

    @property
    def whitened(self) -> Array:
        """Returns the residuals (m,) in sigmas."""
        return np.asarray(self.by.factor * self.projection.residual / self.sigma)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Holds the problem at one state."""

    state: State
    """This is the state."""
    projected: dict[int, Projected]
    """These are the used detections of each boundary."""
    odometry: tuple[Array, Array]
    """These are the residuals and derivatives of `LogOdometry.terms`."""
    cost: float
    """This is half the sum of squares, with the robust losses of the detections."""


class BatchSystem:
    """The problem is to minimize `sum rho(detections) + 1/2 |odometry, gauge, calibration, first pose|^2`."""

    def __init__(
        self, detections: DetectionTable, chain: LogOdometry, settings: MapperSettings, kernel: Biweight
    ) -> None:
        self.detections = detections
        self.chain = chain
        self.settings = settings
        self.kernel = kernel
        self.gauges: dict[int, CurveGauge] = {}
        """These are the weak priors of each boundary."""
        self._sigma, self._inside = np.ones(len(detections)), np.ones(len(detections), bool)
        self._rates = np.zeros((len(detections), 2))

    def begin(self, state: State) -> None:
        """Makes the gauges anew, which hold the control points where they are now.

        The optimizer calls this when knots have changed.
        """
        sigma = self.settings.batch.sigma_slide
        self.gauges = {label: curve_gauge(state, label, sigma) for label in state.boundaries}

    # --- cost --------------------------------------------------------------------------------------------

    def evaluate(self, state: State, hold: bool = False) -> Evaluation:
        """Returns the problem at a state; foot points are refined from those that the detections have.

        `hold` sets the sigma of each detection across its curve, and whether its foot point is inside the
        curve, which later evaluations keep. The derivatives leave out that the sigma depends on the direction
        of the curve.
        """
        projected = {label: self._project(state, label, hold) for label in state.boundaries}
        odometry = self.chain.terms(state.poses, state.calibration)
        cost = self._detections_cost(projected) + 0.5 * float((odometry[0] ** 2).sum())
        cost += sum(
            self.gauges[label].cost(state.control_points(label), state.poses) for label in state.boundaries
        )
        cost += self.chain.prior_cost(state.poses[0], state.calibration)
        cost += sensor_prior_cost(state.variables, self.settings.calibration)
        return Evaluation(state, projected, odometry, cost)

    def _project(self, state: State, label: int, hold: bool) -> Projected:
        detections = self.detections
        rows = detections.used_on(label)
        poses = state.variables.poses_at(detections.cycle[rows])
        points = to_map(detections.corrected(rows, state.variables.sensor), poses)
        foot = state.boundaries[label].refine(state.control_points(label), points, detections.u[rows])
        sigma_model = self.settings.spline.sigma_model
        projection = project(points, detections.covariance[rows], poses, foot, sigma_model)
        if hold:
            self._sigma[rows], self._inside[rows] = projection.sigma, foot.interior
            self._rates[rows] = range_rates(foot.normal_unit, poses, detections.measured[rows])
        by = self._by_sensor(state, rows, foot.normal_unit, foot.distance, self._rates[rows])
        return Projected(rows, foot, projection, self._sigma[rows], self._inside[rows], by)

    def _by_sensor(
        self, state: State, rows: IntArray, directions: Array, residual: Array, rates: Array
    ) -> SensorRows:
        """Returns how residuals (m,) along unit vectors (m, 2), map frame, depend on the sensor.

        A round holds the `rates` (m, 2), as it holds the sigmas.
        """
        detections, variables = self.detections, state.variables
        poses = variables.poses_at(detections.cycle[rows])
        measured, twists = detections.measured[rows], detections.twist[rows]
        return sensor_rows(directions, residual, poses, measured, twists, variables.sensor, rates)

    def _detections_cost(self, projected: dict[int, Projected]) -> float:
        used = sum(int(p.inside.sum()) for p in projected.values())
        losses = sum(float(self.kernel.loss(p.whitened[p.inside]).sum()) for p in projected.values())
        return losses + self.kernel.ceiling * (len(self.detections) - used)

    # --- linear factors ----------------------------------------------------------------------------------

    def rows(self, at: Evaluation, gauges: Mapping[int, CurveGauge] | None = None) -> list[Rows]:
        """Returns every whitened row of Gauss-Newton at a state; those of detections have robust weights.

        Other gauges than the problem's own may take their place.
        """
        state = at.state
        groups = self.chain.rows(at.odometry, state.poses[0], state.calibration)
        groups += sensor_prior(state.variables, self.settings.calibration)
        for label, gauge in (gauges or self.gauges).items():
            points = state.control_points(label)
            groups += [self.detection_rows(at, label), gauge.beside(points, state.poses)]
            groups += [gauge.smooth(points, state.poses), gauge.anchor()]
        return groups

    def detection_rows(self, at: Evaluation, label: int) -> Rows:
        """Returns the rows of the used detections on [control points of their span | pose]."""
        p, state = at.projected[label], at.state
        cycle, scale = self.detections.cycle[p.rows], self.scale(p)
        control = state.keys(label)[state.boundaries[label].columns(p.foot.span)]
        by_control = p.projection.by_control.reshape(len(cycle), 2 * control.shape[1])
        return Rows(
            keys=np.column_stack([*self._sensor_keys(state, cycle), control, pose_keys(cycle)]),
            jacobian=_jacobian(p.by, by_control, p.projection.by_pose) * scale[:, None],
            residual=p.by.factor * p.projection.residual * scale,
            owner=owners(cycle, label),
        )

    def _sensor_keys(self, state: State, cycles: IntArray) -> list[IntArray]:
        """Returns the key of the sensor's calibration for each row (m,), if it is estimated."""
        return [np.full_like(cycles, SENSOR_KEY)] if len(state.variables.sensor) else []

    def scale(self, projected: Projected) -> Array:
        """Returns the factor (m,) that whitens and weights each row (1/m), zero for those not inside."""
        weights = self.kernel.weights(projected.whitened)
        return np.asarray(np.sqrt(weights) * projected.inside / projected.sigma)

    def linear_graph(self, at: Evaluation) -> gtsam.GaussianFactorGraph:
        """Returns all rows as a linear graph, whose solution is the change from the state."""
        return linear_graph(self.rows(at), at.state.variables)

    def eliminated(self, at: Evaluation) -> Elimination:
        """Returns the linear problem with its poses eliminated."""
        return Elimination(self.linear_graph(at), at.state.variables.layout)

    def damping(self, state: State, weight: float) -> gtsam.GaussianFactorGraph:
        """Returns factors that damp how control points move as seen from the poses beside them (1/m^2)."""
        rows = [
            gauge.damping(state.control_points(label), state.poses, weight)
            for label, gauge in self.gauges.items()
        ]
        return linear_graph(rows, state.variables)

    def retract(self, state: State, step: Array) -> State:
        """Returns the state after a step (n,), taken in relative coordinates.

        The step changes each pose as seen from the pose before, and each control point as seen from the pose
        beside it. A map that swings by a large angle keeps its shape then, which the same step in map
        coordinates would stretch.
        """
        linear = moved(state, step)
        after, poses, goal = linear.copy(), state.poses, linear.poses
        driven = seen_from(poses[1:, :2], poses[:-1], goal[1:, :2], goal[:-1])
        after.poses[1:, :2] = goal[0, :2] + np.cumsum(rotated(driven, goal[:-1, 2]), axis=0)
        for label, gauge in self.gauges.items():
            points, k = after.control_points(label), gauge.cycle
            points[:] = to_map(
                seen_from(state.control_points(label), poses[k], points, goal[k]), after.poses[k]
            )
        return after

    def poses_alone(self, at: Evaluation) -> Array:
        """Returns the step (3 P,) of the poses while the map and the calibration are held."""
        keys = at.state.variables.keys
        graph = linear_graph(fix_map(self.rows(at)), at.state.variables)
        return Elimination(graph, Layout(keys[are_poses(keys)])).poses_given(np.zeros(0))


def _jacobian(by: SensorRows, by_control: Array, by_pose: Array) -> Array:
    """Returns derivatives (m, n) by [calibration of the sensor | control points | pose]."""
    factor = by.factor[:, None]
    return np.concatenate([by.by_sensor, factor * by_control, factor * by_pose], axis=1)


def seen_from(points: Array, poses: Array, points_after: Array, poses_after: Array) -> Array:
    """Returns points (m, 2) in the frames of poses (m, 3) after a step, to first order in the step.

    The step leads from points and poses to those after it, all of them in the map frame.
    """
    arm, change = points - poses[:, :2], points_after - points - poses_after[:, :2] + poses[:, :2]
    turn = (poses_after[:, 2] - poses[:, 2])[:, None]
    return rotated(arm + change + turn * np.column_stack([arm[:, 1], -arm[:, 0]]), -poses[:, 2])


def rotated(vectors: Array, angles: Array) -> Array:
    """Returns vectors (m, 2), each turned by its angle (m,) in rad."""
    return to_map(vectors, np.column_stack([np.zeros((len(angles), 2)), angles]))


def moved(state: State, step: Array) -> State:
    """Returns the state after a step (n,) of its last n entries in map coordinates.

    These are all variables, or the poses alone.
    """
    after = state.copy()
    after.variables.values[len(after.variables.values) - len(step) :] += step
    return after
