"""All that a log measured, flat: what the batch optimization holds its estimate against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import (
    CALIBRATION_SIZE,
    IntegratedOdometry,
    compose,
    integrate_twists,
    odometry_residuals,
)

from .graph.elimination import owners
from .graph.keys import CALIBRATION_KEY, POSE, pose_key, pose_keys
from .graph.rows import Rows
from .log import Log
from .readings import Readings
from .run import split_odometry
from .settings import OdometrySettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Chain:
    """The odometry of a whole log: where it begins, and what leads from each cycle's pose to the next."""

    stamps: Array
    """(P,) of the perception cycles, s."""
    first: Array
    """(3,) the first cycle's pose, map frame, by odometry from the first odometry stamp."""
    first_information: Array
    """(3, 3) inverse of its covariance, map frame."""
    deltas: Array
    """(P - 1, 3) motion to the next cycle."""
    whiteners: Array
    """(P - 1, 3, 3) W with `W' W` the inverse of its covariance."""
    by_calibration: Array
    """(P - 1, 3, 2) derivative of its end by the calibration, in the frame of the end."""
    calibration_sigma: Array
    """(2,) standard deviation of the calibration (scale error [-], yaw-rate bias [rad/s]) about zero."""

    def __len__(self) -> int:
        return len(self.stamps)

    def dead_reckoned(self, calibration: Array) -> Array:
        """Poses (P, 3), theta not wrapped: the odometry alone, freed of a scale error and a bias (2,)."""
        local = self.by_calibration @ calibration
        c, s = np.cos(self.deltas[:, 2]), np.sin(self.deltas[:, 2])
        error = np.column_stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1]])
        poses = [self.first]
        for delta in self.deltas - np.column_stack([error, local[:, 2]]):
            poses.append(compose(poses[-1], delta))
        return np.array(poses)

    def terms(self, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """Whitened residuals (P - 1, 3) and derivatives (P - 1, 3, 8) by [calibration | pose | next pose]."""
        residual, by_start, by_end = odometry_residuals(poses[:-1], poses[1:], self.deltas)
        residual = residual + self.by_calibration @ calibration
        jacobian = np.concatenate([self.by_calibration, by_start, by_end], axis=2)
        return np.einsum("pij,pj->pi", self.whiteners, residual), self.whiteners @ jacobian

    def prior_cost(self, first: Array, calibration: Array) -> float:
        """Half the squares of the priors on the first pose (3,) and on the calibration (2,)."""
        off, whitened = first - self.first, calibration / self.calibration_sigma
        return 0.5 * float(off @ self.first_information @ off + whitened @ whitened)

    def rows(self, terms: tuple[Array, Array], first: Array, calibration: Array) -> list[Rows]:
        """The odometry's `terms`, and the priors at a first pose (3,) and a calibration (2,)."""
        residual, jacobian = terms
        start = np.arange(len(residual))
        shared = np.full(len(start), CALIBRATION_KEY)
        keys = np.column_stack([shared, pose_keys(start), pose_keys(start + 1)])
        flat = jacobian.reshape(residual.size, CALIBRATION_SIZE + 2 * POSE)
        root = np.asarray(np.linalg.cholesky(self.first_information).T, np.float64)
        return [
            Rows(np.repeat(keys, POSE, axis=0), flat, residual.ravel(), np.repeat(owners(start), POSE)),
            _prior(pose_key(0), root, first - self.first),
            _prior(CALIBRATION_KEY, np.diag(1.0 / self.calibration_sigma), calibration),
        ]


def _prior(key: int, root: Array, off: Array) -> Rows:
    """`root off` as rows on one variable, in the first factor."""
    return Rows(np.full((len(off), 1), key), root, root @ off, np.zeros(len(off), np.intp))


def integrate_log(log: Log, sigma: Array, settings: OdometrySettings) -> Chain:
    """Every interval between two cycles of a log; sigma (3,) of a twist reading (m/s, m/s, rad/s)."""
    steps = [
        _integrate(odometry.t, odometry.twist, cycle.t, sigma) for odometry, cycle in split_odometry(log)
    ]
    start = np.array([settings.sigma_start, settings.sigma_start, settings.sigma_start_heading])
    return Chain(
        stamps=np.array([cycle.t for cycle in log.cycles]),
        first=compose(np.zeros(3), steps[0].delta),
        first_information=np.linalg.inv(steps[0].covariance + np.diag(start) ** 2),
        deltas=np.array([step.delta for step in steps[1:]]).reshape(-1, 3),
        whiteners=np.array([step.whitener for step in steps[1:]]).reshape(-1, 3, 3),
        by_calibration=np.array([step.calibration_jacobian for step in steps[1:]]).reshape(-1, 3, 2),
        calibration_sigma=np.array([settings.sigma_scale, settings.sigma_bias]),
    )


def _integrate(t: Array, twist: Array, end: float, sigma: Array) -> IntegratedOdometry:
    return integrate_twists(np.diff(np.append(t, end)), twist, sigma)


def collect_readings(log: Log) -> Readings:
    """Every reading of a log, none in use."""
    cycles = log.cycles
    labels = np.concatenate([np.zeros(0, np.intp), *(cycle.labels for cycle in cycles)]).astype(np.intp)
    return Readings(
        cycle=np.repeat(np.arange(len(cycles)), [len(cycle.labels) for cycle in cycles]).astype(np.intp),
        point=np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
        covariance=np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)]),
        label=labels,
        boundary=labels.copy(),
        u=np.zeros(len(labels)),
        used=np.zeros(len(labels), bool),
        changed=np.zeros(len(labels), bool),
    )
