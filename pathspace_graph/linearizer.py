"""The window as whitened linear rows at the current estimate, and their normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.gauge import pair_residuals
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry, odometry_residuals
from pathspace_graph.factors.projection import huber_weights, project, project_to_point, to_map

from .readings import Readings
from .settings import MapperSettings
from .state import State
from .window import POSE, Prior, Rows, accumulate

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class FootParameters:
    """Foot points found anew while linearizing."""

    rows: IntArray
    """(m,) readings."""
    u: Array
    """(m,) their parameters."""
    cut_off: bool
    """Whether any reading slid to where an open curve is far."""


def reading_rows(state: State, readings: Readings, settings: MapperSettings) -> tuple[Rows, FootParameters]:
    """`w_i n_i . (R z_i + t - S(u_i)) / sigma_i` of every reading in use (paper: Update).

    Columns [pose | control points of the span]; w the root of its Huber weight, zero where the foot point is
    not interior. The readings are left as they are. Of the residual `point` two rows each.
    """
    rows = np.flatnonzero(readings.used)
    curves, slots = state.curves, readings.slot[rows]
    curve = curves.number(readings.boundary[rows])
    poses = state.poses[slots]
    points = to_map(readings.point[rows], poses)
    foot = curves.refine(state.map_points, points, curve, readings.u[rows])
    base = 2 * foot.columns
    by_control = np.stack([base, base + 1], axis=2).reshape(len(rows), 2 * base.shape[1])
    columns = np.concatenate([state.pose_columns(slots), by_control], axis=1)
    if settings.spline.residual == "point":
        jacobian, residual = _to_point(points, readings.covariance[rows], poses, foot, settings)
        columns = np.repeat(columns, 2, axis=0)
    else:
        jacobian, residual = _across(points, readings.covariance[rows], poses, foot, settings)
    return Rows(columns, jacobian, residual), FootParameters(rows, foot.u, curves.cut_off(curve, foot))


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
    projected = project_to_point(points, covariances, poses, foot, settings.spline.sigma_model)
    size = np.hypot(projected.residual[:, 0], projected.residual[:, 1])
    weight = np.repeat(np.sqrt(huber_weights(size, settings.gate.huber)) * foot.interior, 2)
    by_control = projected.by_control.reshape(len(weight), 2 * foot.basis.shape[1])
    jacobian = np.concatenate([projected.by_pose.reshape(len(weight), POSE), by_control], axis=1)
    return jacobian * weight[:, None], projected.residual.ravel() * weight


def spacing_rows(state: State, sigma_share: float) -> Rows:
    """`(|c_{j+1} - c_j| - nominal_j) / (sigma_share nominal_j)`: near control points keep their distance."""
    curves = state.curves
    pairs, nominal = curves.pairs, curves.nominal
    first, second = state.map_points[pairs[:, ::2].T // 2]
    residual, direction = pair_residuals(first, second, nominal)
    sigma = sigma_share * nominal
    jacobian = np.concatenate([-direction, direction], axis=1) / sigma[:, None]
    return Rows(pairs, jacobian, residual / sigma)


def odometry_rows(state: State, odometry: Sequence[IntegratedOdometry]) -> Rows:
    """`W_k (Log(delta_k^-1 x_k^-1 x_{k+1}) + G_k calibration)` between all neighbouring poses of the window.

    Columns [calibration | pose | next pose]; G is `calibration_jacobian`, W `whitener`.
    """
    poses, m = state.poses, len(odometry)
    deltas = np.array([o.delta for o in odometry])
    whiteners = np.array([o.whitener for o in odometry])
    by_calibration = np.array([o.calibration_jacobian for o in odometry])
    residual, by_start, by_end = odometry_residuals(poses[:-1], poses[1:], deltas)
    residual = residual + by_calibration @ state.calibration
    shared = np.full((m, 1), state.map_size) + np.arange(CALIBRATION_SIZE)
    pairs = (state.pose_column(0) + POSE * np.arange(m))[:, None] + np.arange(2 * POSE)
    columns = np.repeat(np.concatenate([shared, pairs], axis=1), POSE, axis=0)
    jacobian = whiteners @ np.concatenate([by_calibration, by_start, by_end], axis=2)
    whitened = np.einsum("mij,mj->mi", whiteners, residual)
    return Rows(columns, jacobian.reshape(m * POSE, -1), whitened.ravel())


def normal_equations(
    groups: Sequence[Rows], prior: Prior, state: State, system: Array
) -> tuple[Array, Array]:
    """`H` (n, n) and `-gradient` (n,) of the rows, the prior, and each boundary's smoothness and anchor.

    All on the state's system, whose values are `system` (n,).
    """
    hessian, descent = accumulate(groups, len(system))
    q = len(prior.point)
    hessian[:q, :q] += prior.information
    descent[:q] += prior.descent_at(system)
    add_smoothness(hessian, descent, state, system)
    return hessian, descent


def add_smoothness(hessian: Array, descent: Array, state: State, system: Array) -> None:
    """Each boundary's smoothness and anchor between near control points, added to normal equations."""
    if state.boundaries:
        n, curves = state.near_size, state.curves
        hessian[:n, :n] += curves.hessian
        descent[:n] -= curves.smooth @ system[:n]
