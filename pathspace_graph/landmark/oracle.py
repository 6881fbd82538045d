"""The landmark batch with oracle associations: the true landmark of every detection is given.

No estimator can know them. The limit of a run is computed from this solution. It is the batch's own system
with the same calibration of the odometry, but without robust weights, since there are no outliers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.log import Log
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.settings.mapper import MapperSettings

from .state import LandmarkState
from .system import LandmarkSystem, insert_drive

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LandmarkSolution:
    """Holds the optimum of a landmark batch with oracle associations."""

    trajectory_t: Array
    """(n,) These are the stamps of the perception cycles, in s."""

    trajectory: Array
    """(n, 3) Each row is a smoothed pose (x, y, theta) in m and rad, map frame; theta is not wrapped."""

    landmark_ids: Ints
    """(m,) These are the associations' numbers of all landmarks that were detected, ascending."""

    landmarks: Array
    """(m, 2) Each row is the position of a landmark in m, map frame."""

    covariance: Array | None
    """(2m, 2m) This is the joint covariance of the landmarks in m^2, or None if it was not requested."""

    error: float
    """This is half the sum of the squared whitened residuals."""


def solve_landmarks(
    log: Log, associations: Ints, *, with_covariance: bool = False, settings: MapperSettings | None = None
) -> LandmarkSolution:
    """Minimizes all squared Mahalanobis distances over poses, calibration and landmarks; no loss is robust.

    associations (R,) holds the landmark of each detection in file order; negative ones are left out. The pose
    at the first odometry stamp is (0, 0, 0). The start is `start_oracle`.
    """
    settings = settings or MapperSettings()
    settings = replace(settings, gate=replace(settings.gate, huber=np.inf))
    system = LandmarkSystem.of_log(log, settings, KnownNoise(log.odometry_sigma))
    state = start_oracle(system, associations)
    system.optimize(state)
    return LandmarkSolution(
        trajectory_t=system.chain.stamps,
        trajectory=state.variables.poses.copy(),
        landmark_ids=state.numbers.astype(np.int64),
        landmarks=state.landmarks.copy(),
        covariance=system.eliminated(state).joint(state.keys) if with_covariance else None,
        error=system.cost(state),
    )


def start_oracle(system: LandmarkSystem, associations: Ints) -> LandmarkState:
    """Associates the system's detections with landmarks (R,), and returns the state by dead reckoning.

    Each landmark is placed at its first detection, and has the label of most of them.
    """
    detections, rows = system.detections, np.flatnonzero(associations >= 0)
    numbers, first, landmark = np.unique(associations[rows], return_index=True, return_inverse=True)
    detections.take(rows, numbers[landmark])
    calibration = np.array(system.settings.calibrations)
    poses = system.chain.dead_reckoned(calibration[:CALIBRATION_SIZE])
    points = to_map(detections.point[rows[first]], poses[detections.cycle[rows[first]]])
    labels = detections.label[rows]
    votes = np.stack(
        [np.bincount(landmark[labels == label], minlength=len(numbers)) for label in (LEFT, RIGHT, UNKNOWN)]
    )
    state = LandmarkState()
    state.add(points, votes.argmax(axis=0).astype(np.intp), numbers.astype(np.intp))
    state.votes = votes[: len(BOUNDARIES)].T
    insert_drive(state, calibration, poses)
    return state
