"""The whole log's least-squares problem: its cost at a state, and its normal equations there."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.linear_graph import (
    LinearRows,
    WindowKeys,
    linear_graph,
    prior_rows,
    window_keys,
)
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.projection import ProjectionRows, project, to_map

from .arrowhead import Arrowhead, empty_arrowhead
from .batch_data import Chain
from .batch_equations import add_odometry, add_priors, add_rows, calibration_information, odometry_terms
from .batch_gauge import CurveGauge, PoseRows, curve_gauge
from .batch_kernel import Kernel
from .labels import BOUNDARIES
from .readings import Readings
from .settings import MapperSettings
from .state import State
from .window import POSE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Projected:
    """The readings in use on one boundary, at a state."""

    rows: IntArray
    """(m,) readings."""
    foot: FootPoints
    """Their foot points."""
    projection: ProjectionRows
    """Their residuals and derivatives."""

    sigma: Array
    """(m,) held for a round, m."""

    @property
    def whitened(self) -> Array:
        """(m,) residuals in sigmas."""
        return np.asarray(self.projection.residual / self.sigma)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The problem at one state."""

    state: State
    """Where."""
    projected: dict[int, Projected]
    """Of each boundary."""
    odometry: tuple[Array, Array]
    """Whitened residuals (P - 1, 3) and derivatives (P - 1, 3, 8) by [calibration | pose | next pose]."""
    cost: float
    """Half the sum of squares, robust losses in place of the readings' own."""


class BatchSystem:
    """`min 1/2 |odometry|^2 + sum rho(readings) + 1/2 |spacing, smoothness, calibration, first pose|^2`."""

    def __init__(self, readings: Readings, chain: Chain, settings: MapperSettings, kernel: Kernel) -> None:
        self.readings = readings
        self.chain = chain
        self.settings = settings
        self.kernel = kernel
        self._sigma = np.ones(len(readings))

        self._gauges: dict[int, CurveGauge] = {}

    def begin(self, state: State) -> None:
        """The curves' own gauges, where control points are now: to be called when knots change."""
        sigma = self.settings.batch.sigma_slide
        self._gauges = {
            label: curve_gauge(boundary, state.control_points(label), state.poses, sigma)
            for label, boundary in state.boundaries.items()
        }

    def hold_sigmas(self, state: State) -> None:
        """Each reading's sigma across its curve as it is now: how it turns is in no derivative."""
        for label in state.boundaries:
            projected = self._project(state, label)
            self._sigma[projected.rows] = projected.projection.sigma

    # --- cost --------------------------------------------------------------------------------------------

    def evaluate(self, state: State) -> Evaluation:
        """Everything at a state; foot points are refined from where the readings have them."""
        projected = {label: self._project(state, label) for label in state.boundaries}
        odometry = odometry_terms(self.chain, state.poses, state.calibration)
        cost = self._readings_cost(projected) + 0.5 * float((odometry[0] ** 2).sum())
        cost += sum(
            self._gauges[label].cost(state.control_points(label), state.poses) for label in state.boundaries
        )
        return Evaluation(state, projected, odometry, cost + self._prior_cost(state))

    def _project(self, state: State, label: int) -> Projected:
        readings = self.readings
        rows = readings.used_on(label)
        poses = state.poses[readings.slot[rows]]
        points = to_map(readings.point[rows], poses)
        foot = state.boundaries[label].refine(state.control_points(label), points, readings.u[rows])
        sigma_model = self.settings.spline.sigma_model
        projection = project(points, readings.covariance[rows], poses, foot, sigma_model)
        return Projected(rows, foot, projection, self._sigma[rows])

    def _readings_cost(self, projected: dict[int, Projected]) -> float:
        used = sum(int(p.foot.interior.sum()) for p in projected.values())
        losses = sum(float(self.kernel.loss(p.whitened[p.foot.interior]).sum()) for p in projected.values())
        return losses + self.kernel.ceiling * (len(self.readings) - used)

    def _prior_cost(self, state: State) -> float:
        first = state.poses[0] - self.chain.first
        cost = first @ self.chain.first_information @ first
        cost += state.calibration @ (calibration_information(self.settings.odometry) * state.calibration)
        return 0.5 * float(cost)

    # --- normal equations --------------------------------------------------------------------------------

    def normal_equations(self, at: Evaluation) -> Arrowhead:
        """The Gauss-Newton system: readings weighted as Huber's loss has it, foot points exact."""
        state = at.state
        n, count = state.map_size + CALIBRATION_SIZE, len(self.chain)
        system = empty_arrowhead(count, n)
        for label in state.boundaries:
            add_rows(system, self.reading_rows(at, label))
            add_rows(system, self.gauge_rows(state, label))
            self._add_smoothness(system, state, label)
        add_odometry(system, *at.odometry)
        add_priors(
            system,
            self.chain,
            state.poses[0],
            state.calibration,
            calibration_information(self.settings.odometry),
        )
        return system

    def reading_rows(self, at: Evaluation, label: int) -> PoseRows:
        """The readings in use on a boundary, whitened and weighted, on the control points of their span."""
        p, state = at.projected[label], at.state
        weight = np.sqrt(self.kernel.weights(p.whitened)) * p.foot.interior / p.sigma
        base = state.offset(label) + 2 * state.boundaries[label].columns(p.foot.span)
        shape = len(p.rows), 2 * base.shape[1]
        return PoseRows(
            slot=self.readings.slot[p.rows],
            by_pose=p.projection.by_pose * weight[:, None],
            columns=np.stack([base, base + 1], axis=2).reshape(shape),
            by_border=p.projection.by_control.reshape(shape) * weight[:, None],
            residual=p.projection.residual * weight,
        )

    def gauge_rows(self, state: State, label: int) -> PoseRows:
        """What holds the control points of a boundary beside their poses."""
        return self._gauges[label].beside(state.control_points(label), state.poses, state.offset(label))

    def linear_rows(self, at: Evaluation) -> list[LinearRows]:
        """Every whitened row on the whole state, whose normal equations these are."""
        state, groups = at.state, []
        for label in state.boundaries:
            for rows in (self.reading_rows(at, label), self.gauge_rows(state, label)):
                columns = np.concatenate([rows.columns, state.pose_columns(rows.slot)], axis=1)
                jacobian = np.concatenate([rows.by_border, rows.by_pose], axis=1)
                groups.append((columns, jacobian, rows.residual))
            groups += _smooth(self._gauges[label], state.control_points(label), state.offset(label))
        residual, jacobian = at.odometry
        pairs = state.pose_columns(np.arange(len(residual)))[:, :1] + np.arange(2 * POSE)
        shared = np.full((len(residual), 1), state.map_size) + np.arange(CALIBRATION_SIZE)
        columns = np.repeat(np.concatenate([shared, pairs], axis=1), POSE, axis=0)
        groups.append((columns, jacobian.reshape(len(columns), -1), residual.ravel()))
        information = np.zeros((CALIBRATION_SIZE + POSE, CALIBRATION_SIZE + POSE))
        np.fill_diagonal(
            information, np.append(calibration_information(self.settings.odometry), [0.0] * POSE)
        )
        information[CALIBRATION_SIZE:, CALIBRATION_SIZE:] = self.chain.first_information
        off = np.append(state.calibration, state.poses[0] - self.chain.first)
        own, prior, value = prior_rows(information, -information @ off)
        first = np.append(shared[0], state.pose_columns(np.zeros(1, np.intp)))
        return [*groups, (first[own], prior, value)]

    def _add_smoothness(self, system: Arrowhead, state: State, label: int) -> None:
        block, gauge = state.block(label), self._gauges[label]
        system.border[block, block] += gauge.smoothness + gauge.anchor * np.eye(len(gauge.smoothness))
        system.descent_border[block] -= gauge.smoothness @ state.vector[block]


def _smooth(gauge: CurveGauge, control_points: Array, offset: int) -> list[LinearRows]:
    """Smoothness and anchor of a curve whose control points begin at an entry of the state."""
    flat = control_points.ravel()
    columns = offset + np.arange(len(flat))
    smooth = prior_rows(gauge.smoothness, -gauge.smoothness @ flat)
    anchor = prior_rows(gauge.anchor * np.eye(len(flat)), np.zeros(len(flat)))
    return [(columns[own], jacobian, residual) for own, jacobian, residual in (smooth, anchor)]


def moved(state: State, poses: Array, border: Array) -> State:
    """The state after a step of the poses (3 P,) and of [map | calibration] (n,)."""
    following = copy(state)
    following.vector = state.vector + np.concatenate([border, poses])
    return following


def linear_graph_of(system: BatchSystem, at: Evaluation) -> tuple[gtsam.GaussianFactorGraph, WindowKeys]:
    """The same step as one GTSAM graph of finished Jacobian blocks: every pose, reading and curve."""
    state = at.state
    sizes = [state.boundaries[b].size if b in state.boundaries else 0 for b in BOUNDARIES]
    keys = window_keys((sizes[0], sizes[1]), CALIBRATION_SIZE, state.poses)
    return linear_graph(system.linear_rows(at), keys), keys
