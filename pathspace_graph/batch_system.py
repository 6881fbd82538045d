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
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, odometry_residuals
from pathspace_graph.factors.projection import ProjectionRows, huber_weights, project, to_map

from .arrowhead import Arrowhead, empty_arrowhead
from .batch_data import Chain
from .batch_gauge import CurveGauge, curve_gauge
from .labels import BOUNDARIES
from .readings import Readings
from .settings import MapperSettings, OdometrySettings
from .state import State
from .window import POSE, Rows, accumulate

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

_SUB = POSE + CALIBRATION_SIZE
"""Columns [calibration | pose | next pose] of an odometry row: where the next pose's begin."""


@dataclass(frozen=True)
class Kernel:
    """Robust loss of a whitened residual: Huber's, constant beyond a gate."""

    huber: float
    """Beyond it the loss grows linearly only."""
    gate: float
    """Beyond it a reading isn't used, and its loss is that at the gate."""

    def loss(self, whitened: Array) -> Array:
        """`rho(z)` (m,), Huber's alone: the gate is what decides which rows are used."""
        inner = np.minimum(np.abs(whitened), self.huber)
        return np.asarray(inner * (np.abs(whitened) - 0.5 * inner))

    @property
    def ceiling(self) -> float:
        """Loss of a reading that isn't used."""
        return float(self.loss(np.array([self.gate]))[0])


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
        boundaries = state.boundaries
        self._gauges = {b: curve_gauge(boundaries[b], state.control_points(b)) for b in boundaries}

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
        cost += sum(self._gauges[label].cost(state.control_points(label)) for label in state.boundaries)
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
            self._add_readings(system, at, label)
            self._add_gauge(system, state, label)
        add_odometry(system, *at.odometry)
        add_priors(
            system,
            self.chain,
            state.poses[0],
            state.calibration,
            calibration_information(self.settings.odometry),
        )
        return system

    def _add_readings(self, system: Arrowhead, at: Evaluation, label: int) -> None:
        by_pose, by_control, columns, residual, slot = self.whitened_rows(at, label)
        count, n = len(self.chain), len(system.border)
        for i in range(POSE):
            for j in range(POSE):
                system.diagonal[:, i, j] += np.bincount(slot, by_pose[:, i] * by_pose[:, j], count)
            system.descent_poses[i::POSE] -= np.bincount(slot, by_pose[:, i] * residual, count)
        for i in range(POSE):
            cells = (slot * n)[:, None] + columns
            products = by_pose[:, i, None] * by_control
            block = np.bincount(cells.ravel(), products.ravel(), count * n).reshape(count, n)
            system.coupling[i::POSE] += block
        hessian, descent = accumulate([Rows(columns, by_control, residual)], n)
        system.border[:] += hessian
        system.descent_border[:] += descent

    def whitened_rows(self, at: Evaluation, label: int) -> tuple[Array, Array, IntArray, Array, IntArray]:
        """By pose (m, 3), by control points (m, 2 p + 2), their columns, residuals (m,) and slots (m,)."""
        p, state = at.projected[label], at.state
        weight = np.sqrt(huber_weights(p.whitened, self.kernel.huber)) * p.foot.interior / p.sigma
        base = state.offset(label) + 2 * state.boundaries[label].columns(p.foot.span)
        shape = len(p.rows), 2 * base.shape[1]
        columns = np.stack([base, base + 1], axis=2).reshape(shape)
        by_control = p.projection.by_control.reshape(shape) * weight[:, None]
        by_pose = p.projection.by_pose * weight[:, None]
        return by_pose, by_control, columns, p.projection.residual * weight, self.readings.slot[p.rows]

    def linear_rows(self, at: Evaluation) -> list[LinearRows]:
        """Every whitened row on the whole state, whose normal equations these are."""
        state, groups = at.state, []
        for label in state.boundaries:
            by_pose, by_control, columns, residual, slot = self.whitened_rows(at, label)
            all_columns = np.concatenate([columns, state.pose_columns(slot)], axis=1)
            groups.append((all_columns, np.concatenate([by_control, by_pose], axis=1), residual))
            groups += _anchored(self._gauges[label], state.control_points(label), state.offset(label))
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

    def _add_gauge(self, system: Arrowhead, state: State, label: int) -> None:
        block, gauge = state.block(label), self._gauges[label]
        hessian, descent = accumulate([gauge.spacing(state.control_points(label))], block.stop - block.start)
        system.border[block, block] += hessian + gauge.smoothness + gauge.anchor * np.eye(len(hessian))
        system.descent_border[block] += descent - gauge.smoothness @ state.vector[block]


def _anchored(gauge: CurveGauge, control_points: Array, offset: int) -> list[LinearRows]:
    """Spacing, smoothness and anchor of a curve whose control points begin at an entry of the state."""
    spacing, flat = gauge.spacing(control_points), control_points.ravel()
    columns = offset + np.arange(len(flat))
    smooth = prior_rows(gauge.smoothness, -gauge.smoothness @ flat)
    anchor = prior_rows(gauge.anchor * np.eye(len(flat)), np.zeros(len(flat)))
    priors = [(columns[own], jacobian, residual) for own, jacobian, residual in (smooth, anchor)]
    return [(offset + spacing.columns, spacing.jacobian, spacing.residual), *priors]


def moved(state: State, poses: Array, border: Array) -> State:
    """The state after a step of the poses (3 P,) and of [map | calibration] (n,)."""
    following = copy(state)
    following.vector = state.vector + np.concatenate([border, poses])
    return following


def calibration_information(settings: OdometrySettings) -> Array:
    """(2,) prior information of the calibration."""
    return np.array([settings.sigma_scale, settings.sigma_bias]) ** -2.0


def odometry_terms(chain: Chain, poses: Array, calibration: Array) -> tuple[Array, Array]:
    """Whitened residuals (P - 1, 3) and derivatives (P - 1, 3, 8) by [calibration | pose | next pose]."""
    residual, by_start, by_end = odometry_residuals(poses[:-1], poses[1:], chain.deltas)
    residual = residual + chain.by_calibration @ calibration
    jacobian = np.concatenate([chain.by_calibration, by_start, by_end], axis=2)
    return np.einsum("pij,pj->pi", chain.whiteners, residual), chain.whiteners @ jacobian


def add_odometry(system: Arrowhead, residual: Array, jacobian: Array) -> None:
    """`odometry_terms` added to normal equations whose border ends with the calibration."""
    gram = np.swapaxes(jacobian, 1, 2) @ jacobian
    descent = -np.einsum("pki,pk->pi", jacobian, residual)
    c, first, second = slice(0, CALIBRATION_SIZE), slice(CALIBRATION_SIZE, _SUB), slice(_SUB, None)
    system.diagonal[:-1] += gram[:, first, first]
    system.diagonal[1:] += gram[:, second, second]
    system.following[:] += gram[:, second, first]
    system.descent_poses[:-POSE] += descent[:, first].ravel()
    system.descent_poses[POSE:] += descent[:, second].ravel()
    system.coupling[:-POSE, -CALIBRATION_SIZE:] += gram[:, first, c].reshape(-1, CALIBRATION_SIZE)
    system.coupling[POSE:, -CALIBRATION_SIZE:] += gram[:, second, c].reshape(-1, CALIBRATION_SIZE)
    system.border[-CALIBRATION_SIZE:, -CALIBRATION_SIZE:] += gram[:, c, c].sum(axis=0)
    system.descent_border[-CALIBRATION_SIZE:] += descent[:, c].sum(axis=0)


def add_priors(
    system: Arrowhead, chain: Chain, first_pose: Array, calibration: Array, information: Array
) -> None:
    """Priors of the first pose (3,) and of the calibration (2,), of which `information` (2,) is given."""
    system.diagonal[0] += chain.first_information
    system.descent_poses[:POSE] -= chain.first_information @ (first_pose - chain.first)
    system.border[-CALIBRATION_SIZE:, -CALIBRATION_SIZE:] += np.diag(information)
    system.descent_border[-CALIBRATION_SIZE:] -= information * calibration


def linear_graph_of(system: BatchSystem, at: Evaluation) -> tuple[gtsam.GaussianFactorGraph, WindowKeys]:
    """The same step as one GTSAM graph of finished Jacobian blocks: every pose, reading and curve."""
    state = at.state
    sizes = [state.boundaries[b].size if b in state.boundaries else 0 for b in BOUNDARIES]
    keys = window_keys((sizes[0], sizes[1]), CALIBRATION_SIZE, state.poses)
    return linear_graph(system.linear_rows(at), keys), keys
