"""The yardstick: the landmark batch over a whole log, *told* which reading saw which landmark.

An estimator can't know that. It is what the limit of a run is made of: the batch's own system, with the
calibration of the odometry that every estimator estimates, and without robust weights, for what it is told
has no outliers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Log
from pathspace_graph.mapping.log_odometry import integrate_log
from pathspace_graph.settings.mapper import MapperSettings

from .start import start_oracle
from .state import LandmarkDetections
from .system import LandmarkSystem

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LandmarkSolution:
    """The optimum of a landmark batch that was told its associations."""

    trajectory_t: Array
    """(n,) s, one per perception cycle."""

    trajectory: Array
    """(n, 3) [x, y, theta], map frame, smoothed, theta not wrapped."""

    landmark_ids: Ints
    """(m,) what the associations call each landmark that was seen, ascending."""

    landmarks: Array
    """(m, 2) m, map frame."""

    covariance: Array | None
    """(2m, 2m) m^2, joint covariance of the landmarks, or None where it wasn't asked for."""

    error: float
    """Half the squared whitened residuals that are left."""


def solve_landmarks(
    log: Log, associations: Ints, *, with_covariance: bool = False, settings: MapperSettings | None = None
) -> LandmarkSolution:
    """argmin over poses, calibration and landmarks of all squared Mahalanobis distances, none of them robust.

    associations: (R,) landmark of each detection row in file order, negative for none (left out). The pose at
    the first odometry stamp is (0, 0, 0). Started at the integrated odometry and first sightings.
    """
    settings = settings or MapperSettings()
    settings = replace(settings, gate=replace(settings.gate, huber=np.inf))
    chain, detections = (
        integrate_log(log, log.odometry_sigma, settings.odometry),
        LandmarkDetections.of(log.cycles),
    )
    system = LandmarkSystem(detections, chain, settings)
    state = start_oracle(detections, chain, associations)
    system.settle(state)
    return LandmarkSolution(
        trajectory_t=chain.stamps,
        trajectory=state.variables.poses.copy(),
        landmark_ids=state.numbers.astype(np.int64),
        landmarks=state.landmarks.copy(),
        covariance=system.eliminated(state).joint(state.keys) if with_covariance else None,
        error=system.cost(state),
    )
