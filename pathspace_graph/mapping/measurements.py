"""All that a log measured, flat: what the batch optimization holds its estimate against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.elimination import owners
from pathspace_graph.graph.keys import CALIBRATION_KEY, pose_key
from pathspace_graph.graph.odometry import OdometryChain, calibrated_delta, odometry_rows
from pathspace_graph.graph.rows import Rows
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import OdometrySettings

from .detections import DetectionTable

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
    odometry: OdometryChain
    """From each cycle's pose to the next, P - 1 intervals."""
    calibration_sigma: Array
    """(2,) standard deviation of the calibration (scale error [-], yaw-rate bias [rad/s]) about zero."""

    def __len__(self) -> int:
        return len(self.stamps)

    def dead_reckoned(self, calibration: Array) -> Array:
        """Poses (P, 3), theta not wrapped: the odometry alone, freed of a scale error and a bias (2,)."""
        poses = [self.first]
        for interval in self.odometry.intervals:
            poses.append(compose(poses[-1], calibrated_delta(interval, calibration)))
        return np.array(poses)

    def terms(self, poses: Array, calibration: Array) -> tuple[Array, Array]:
        """Whitened residuals (P - 1, 3) and derivatives (P - 1, 3, 8) by [calibration | pose | next pose]."""
        return self.odometry.terms(slice(None), poses, calibration)

    def prior_cost(self, first: Array, calibration: Array) -> float:
        """Half the squares of the priors on the first pose (3,) and on the calibration (2,)."""
        off, whitened = first - self.first, calibration / self.calibration_sigma
        return 0.5 * float(off @ self.first_information @ off + whitened @ whitened)

    def rows(self, terms: tuple[Array, Array], first: Array, calibration: Array) -> list[Rows]:
        """The odometry's `terms`, and the priors at a first pose (3,) and a calibration (2,)."""
        start = np.arange(len(self.odometry))
        root = np.asarray(np.linalg.cholesky(self.first_information).T, np.float64)
        return [
            odometry_rows(start, terms, owners(start)),
            _prior(pose_key(0), root, first - self.first),
            _prior(CALIBRATION_KEY, np.diag(1.0 / self.calibration_sigma), calibration),
        ]


def _prior(key: int, root: Array, off: Array) -> Rows:
    """`root off` as rows on one variable, in the first factor."""
    return Rows(np.full((len(off), 1), key), root, root @ off, np.zeros(len(off), np.intp))


def integrate_log(log: Log, sigma: Array, settings: OdometrySettings) -> Chain:
    """Every interval between two cycles of a log; sigma (3,) of a twist reading (m/s, m/s, rad/s)."""
    steps = [integrate_odometry(odometry, cycle.t, sigma) for odometry, cycle in split_odometry(log)]
    return Chain(
        stamps=np.array([cycle.t for cycle in log.cycles]),
        first=compose(np.zeros(3), steps[0].delta),
        first_information=np.linalg.inv(steps[0].covariance + np.diag(settings.sigmas_start) ** 2),
        odometry=OdometryChain(steps[1:]),
        calibration_sigma=np.array([settings.sigma_scale, settings.sigma_bias]),
    )


def integrate_odometry(odometry: Odometry, end: float, sigma: Array) -> IntegratedOdometry:
    """Integrates twists, the last of which is held until `end` (s); sigma (3,) is that of a twist reading."""
    return integrate_twists(np.diff(np.append(odometry.t, end)), odometry.twist, sigma)


def collect_detections(log: Log) -> DetectionTable:
    """Every reading of a log, none in use."""
    cycles = log.cycles
    labels = np.concatenate([np.zeros(0, np.intp), *(cycle.labels for cycle in cycles)]).astype(np.intp)
    return DetectionTable(
        cycle=np.repeat(np.arange(len(cycles)), [len(cycle.labels) for cycle in cycles]).astype(np.intp),
        point=np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
        covariance=np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)]),
        label=labels,
        boundary=labels.copy(),
        u=np.zeros(len(labels)),
        used=np.zeros(len(labels), bool),
        changed=np.zeros(len(labels), bool),
    )
