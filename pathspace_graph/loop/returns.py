"""Search for a return to the beginning of a drive: by its cones or, of lines, by its curves."""

from math import inf
from typing import Final

import numpy as np

from pathspace_graph.batch.start import unwrap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.mapping.constellation import relative_pose, return_to_beginning
from pathspace_graph.mapping.registration import (
    BEGINNING,
    HEADING,
    is_lost,
    is_within_reach,
    near_start,
    passes_start,
    register,
)
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings

from .drive_record import DriveRecord

CERTAIN_PATH: Final = 20.0  # path after which the certainty of a pose is checked again (m)
RETURN_CYCLES: Final = 10  # number of cycles between attempts of a vehicle that hardly moves


class ReturnFinder(Copyable):
    """Search for a return of an open road, some metres or cycles after the last attempt."""

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._tried = -inf, 0  # path length (m) and cycle of the last attempt
        self._rests_until = 0.0  # path length of the next attempt (m)
        self._certain_until = 0.0  # path length up to which the pose counts as certain (m)

    def rest(self, road: Road, length: float) -> None:
        """Pause the search for a length (m) from here."""
        self._rests_until = road.path.length + length

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the newest pose relative to an early one, if it is recognized there."""
        length, cycle, closing = road.path.length, road.next_cycle, self._settings.closing
        tried, tried_cycle = self._tried
        waited = length >= tried + closing.check_interval or cycle >= tried_cycle + RETURN_CYCLES
        if length < self._rests_until or not waited or not near_start(road.path, road.poses[-1], closing):
            return None
        self._tried = length, cycle
        if self._settings.of_lines:
            return self._by_curves(road, record) if road.boundaries else None
        seen_in = record.seen_in(road.smoother.variables.sensor, noise)
        covariance = road.smoother.newest_covariance()
        return return_to_beginning(seen_in, unwrap(record.poses), covariance, road.settings)

    def _by_curves(self, road: Road, record: DriveRecord) -> Revisit | None:
        """Lay the newest detections on the beginning of the curves."""
        smoother, path, closing = road.smoother, road.path, self._settings.closing
        smoother.transform_to_origin()
        track, times = smoother.map, smoother.times
        if path.length < self._certain_until and not is_within_reach(track, times, closing):
            return None  # saves a costly covariance
        covariance = smoother.newest_covariance()
        if not is_lost(covariance, closing):
            self._certain_until = path.length + CERTAIN_PATH
        found = register(track, times, covariance, path.beginning, closing)
        if found is None or not passes_start(track.state, path, found.motion):
            return None
        poses = record.with_window(road)
        newest = poses[-1:].copy()
        found.motion.move(newest)
        beside = (path_lengths(poses) < BEGINNING) & (np.cos(poses[:, 2] - newest[0, 2]) > np.cos(HEADING))
        away = np.where(beside, np.hypot(*(poses[:, :2] - newest[0, :2]).T), inf)
        earlier, information = int(away.argmin()), np.asarray(np.linalg.inv(found.covariance), np.float64)
        ends = (earlier, poses[earlier]), (len(poses) - 1, newest[0])
        return relative_pose(*ends, newest[0], information)
