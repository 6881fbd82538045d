"""The Hungarian landmark graph over a whole log: every pose and landmark at once, associations refreshed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.graph.keys import POSE
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import BatchRun
from pathspace_graph.laps import LapCounter
from pathspace_graph.mapping.log_odometry import integrate_log
from pathspace_graph.run import settings_dict
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings

from .fixed_lag import point_map
from .reassociation import Reassociation, drop_rare
from .start import start_online, start_oracle
from .state import LandmarkDetections, LandmarkState
from .system import LandmarkSystem
from .tentative import duplicates

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NAME: Final = "landmark-batch"
"""What the command line knows it by."""


@dataclass(frozen=True, eq=False)
class LandmarkResult(BatchRun):
    """What the landmark batch gives; it has converged where the last round changed hardly any association."""

    rounds: int = 0
    """Times that the log was associated anew; 0 where the associations were told."""
    pose_covariances: Array = field(default_factory=lambda: np.zeros((0, POSE, POSE)))
    """(n, 3, 3) marginal covariance of each pose (x, y, theta), map frame."""


class LandmarkBatch:
    """Cones as points, poses of the whole log; begun at the online run of `LandmarkFixedLag`."""

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)

    def solve(self, log: Log, associations: Ints | None = None) -> LandmarkResult:
        """The optimum over a log: associate, solve, merge, drop, until no association changes.

        associations (R,): landmark of each detection in file order, negative for none: told, they are kept;
        for evaluation only.
        """
        with threadpool_limits(limits=1):
            return self._solve(log, associations)

    def _solve(self, log: Log, associations: Ints | None) -> LandmarkResult:
        settings = self.settings.landmark
        chain = integrate_log(log, self.odometry_sigma, self.settings.odometry)
        detections = LandmarkDetections.of(log.cycles)
        if associations is None:
            state = start_online(log, detections, self.settings, self.odometry_sigma)
        else:
            state = start_oracle(detections, chain, associations)
        system = LandmarkSystem(detections, chain, self.settings)
        system.settle(state)
        rounds, converged = 0, associations is not None
        while not converged and rounds < settings.max_rounds:
            rounds += 1
            converged = self._refresh(system, state) <= settings.settled * len(detections)
            system.settle(state)
        return self._result(system, state, rounds, converged)

    def _refresh(self, system: LandmarkSystem, state: LandmarkState) -> int:
        """Associate anew, merge, drop; how many readings are of another landmark now."""
        detections, problem = system.detections, system.eliminated(state)
        before, known = detections.landmark.copy(), len(state)
        Reassociation(state, detections, problem, self.settings, system.chain.stamps).run()
        first, second = duplicates(state, known, problem.joint, self.settings)
        detections.merge(state.numbers[first], state.numbers[second])
        drop_rare(state, detections, self.settings.growth.sightings)
        return int((before != detections.landmark).sum())

    def _result(
        self, system: LandmarkSystem, state: LandmarkState, rounds: int, converged: bool
    ) -> LandmarkResult:
        laps, problem, poses = LapCounter(), system.eliminated(state), state.variables.poses.copy()
        for pose in poses:
            laps.update(pose)
        return LandmarkResult(
            estimator=NAME,
            settings=settings_dict(self.settings),
            map=point_map(state, problem.joint(state.keys), laps.completed > 0),
            trajectory_t=system.chain.stamps,
            trajectory=poses,
            cycles=(),
            laps=laps.completed,
            rounds=rounds,
            converged=converged,
            pose_covariances=problem.pose_marginals,
        )
