"""What the parts of the whole log's problem add to its normal equations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, odometry_residuals

from .arrowhead import Arrowhead
from .batch_data import Chain
from .batch_gauge import PoseRows
from .settings import OdometrySettings
from .window import POSE, Rows, accumulate

Array = NDArray[np.float64]

_SUB = POSE + CALIBRATION_SIZE
"""Columns [calibration | pose | next pose] of an odometry row: where the next pose's begin."""


def add_rows(system: Arrowhead, rows: PoseRows) -> None:
    """`J' J` and `-J' r` of rows added to normal equations."""
    slot, by_pose, residual = rows.slot, rows.by_pose, rows.residual
    count, n = len(system.diagonal), len(system.border)
    for i in range(POSE):
        for j in range(POSE):
            system.diagonal[:, i, j] += np.bincount(slot, by_pose[:, i] * by_pose[:, j], count)
        system.descent_poses[i::POSE] -= np.bincount(slot, by_pose[:, i] * residual, count)
    cells = POSE * (count * rows.columns[:, :, None] + slot[:, None, None]) + np.arange(POSE)
    products = rows.by_border[:, :, None] * by_pose[:, None, :]
    coupling = np.bincount(cells.ravel(), products.ravel(), POSE * count * n)
    system.coupling[:] += coupling.reshape(n, POSE * count).T
    hessian, descent = accumulate([Rows(rows.columns, rows.by_border, residual)], n)
    system.border[:] += hessian
    system.descent_border[:] += descent


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
