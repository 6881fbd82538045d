"""The Hungarian landmark graph over a whole log: all poses and landmarks at once, associations refreshed."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import solving
from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.graph.keys import POSE
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import BatchRun
from pathspace_graph.laps import LapCounter
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.run import settings_dict, split_odometry
from pathspace_graph.scale.door import log_at_scale
from pathspace_graph.settings.mapper import MapperSettings

from .fixed_lag import LandmarkFixedLag
from .merging import find_duplicates
from .reassociation import Reassociation, remove_rare
from .state import UNASSOCIATED, LandmarkState, point_map
from .system import LandmarkSystem, insert_drive

Array = NDArray[np.float64]

NAME: Final = "landmark-batch"
"""This is the estimator's name on the command line."""


@log_at_scale
class LandmarkBatch:
    """Maps cones as points with all poses of a log; the start is the online run of `LandmarkFixedLag`."""

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        self.noise = known_noise(odometry_sigma)

    def solve(self, log: Log) -> BatchRun:
        """Solves a log: associate, optimize, merge and remove landmarks, until the associations stay.

        The result has converged if the last round changed hardly any association.
        """
        with threadpool_limits(limits=1), solving("the batch"):
            return self._solve(log)

    def _solve(self, log: Log) -> BatchRun:
        settings = self.settings.landmark
        system = LandmarkSystem.of_log(log, self.settings, self.noise)
        system, state = start_online(log, system, self.noise)
        system.optimize(state)
        rounds, converged = 0, False
        while not converged and rounds < settings.max_rounds:
            rounds += 1
            converged = self._refresh(system, state) <= settings.settled * len(system.detections)
            system.optimize(state)
        return self._result(system, state, converged)

    def _refresh(self, system: LandmarkSystem, state: LandmarkState) -> int:
        """Associates anew, merges and removes landmarks; returns how many associations have changed."""
        detections, problem = system.detections, system.eliminated(state)
        before, known = detections.landmark.copy(), len(state)
        Reassociation(state, detections, problem, self.settings, system.chain.stamps).run()
        gone, kept = find_duplicates(state, known, problem.joint, self.settings)
        detections.merge(state.numbers[gone], state.numbers[kept])
        remove_rare(state, detections, self.settings.growth.sightings)
        return int((before != detections.landmark).sum())

    def _result(self, system: LandmarkSystem, state: LandmarkState, converged: bool) -> BatchRun:
        laps, problem, poses = LapCounter(), system.eliminated(state), state.variables.poses.copy()
        for pose in poses:
            laps.update(pose)
        return BatchRun(
            estimator=NAME,
            settings=settings_dict(self.settings),
            map=point_map(state.landmarks, state.labels, problem.joint(state.keys), laps.completed > 0),
            trajectory_t=system.chain.stamps,
            trajectory=poses,
            cycles=(),
            laps=laps.completed,
            converged=converged,
            noise=system.noise,
        )


def start_online(log: Log, system: LandmarkSystem, noise: KnownNoise) -> tuple[LandmarkSystem, LandmarkState]:
    """Returns the last map of the online run, with each pose and association as it left the window.

    The problem is returned with the priors of the calibrations as the online run believed them in the end.
    """
    online, detections = LandmarkFixedLag(system.settings, noise), system.detections
    smoother, track = online.smoother, online.smoother.map
    poses = np.zeros((len(log.cycles), POSE))
    landmark = np.full(len(detections), UNASSOCIATED, np.intp)
    begins = np.searchsorted(detections.cycle, np.arange(len(log.cycles)))
    for odometry, cycle in split_odometry(log):
        online.update(odometry, cycle)
        first = smoother.first_cycle
        poses[first : smoother.next_cycle] = smoother.variables.poses
        landmark[begins[first] : begins[first] + len(track.detections)] = track.detections.landmark
    final = np.arange(track.state.next_number)
    for gone, kept in sorted(track.merged_into.items()):  # ascending, so that `kept` is final already
        final[gone] = final[kept]
    rows = np.flatnonzero(landmark >= 0)
    detections.take(rows, final[landmark[rows]])
    state = LandmarkState()
    state.add(track.state.landmarks, track.state.labels, track.state.numbers)
    state.votes, state.next_number = track.state.votes, track.state.next_number
    insert_drive(state, smoother.variables.calibrations, poses)
    return system.believing(online.believed), state
