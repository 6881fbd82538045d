"""Search for a return to the beginning of a drive: by curves, by cones, or by the shape of the road."""

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
    RefinedMotion,
    is_lost,
    is_within_reach,
    near_start,
    passes_start,
    register,
)
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.online import ClosingSettings

from .drive_record import DriveRecord
from .revisit import recognize

CERTAIN_PATH: Final = 20.0  # path after which the certainty of a pose is checked again (m)
RECOGNITION_INTERVAL: Final = 10.0  # distance between attempts by shape (m along the path)
RETURN_CYCLES: Final = 10  # number of cycles between attempts by cones
LONG_PATH: Final = 1000.0
"""Path length (m) from which `RECOGNITION_INTERVAL` grows in proportion, as the cost of an attempt does."""


class ReturnFinder(Copyable):
    """Search for a return of an open road in three ways, at most one of them per cycle."""

    def __init__(self, settings: ClosingSettings) -> None:
        self._settings = settings
        self._tried = dict.fromkeys(("curves", "cones", "shape"), (-inf, 0))
        """Path length (m) and cycle of the last attempt in each way."""
        self._rests_until = 0.0  # path length of the next attempt (m)
        self._certain_until = 0.0  # path length up to which the pose counts as certain (m)

    def rest(self, road: Road, length: float) -> None:
        """Pause the search for a length (m) from here; zero ends the pause."""
        self._rests_until = road.path.length + length if length else 0.0

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the newest pose relative to an earlier one, by the due way that has waited longest."""
        for way in sorted(self._tried, key=lambda one: self._tried[one][0]):
            if not self._is_due(road, way):
                continue
            if way == "cones":
                return self._by_cones(road, record, noise)
            found = self._by_curves(road) if way == "curves" else recognize(road.smoother)
            within = BEGINNING if way == "curves" else road.path.length - self._settings.min_path
            return None if found is None else self._revisit_of(road, record, found, within)
        return None

    def by_curves(self, road: Road) -> RefinedMotion | None:
        """Return the motion of the newest detections onto the beginning of the curves, if a check is due."""
        return self._by_curves(road) if self._is_due(road, "curves") else None

    def _by_curves(self, road: Road) -> RefinedMotion | None:
        smoother, path, settings = road.smoother, road.path, self._settings
        smoother.transform_to_origin()
        track, times = smoother.map, smoother.times
        if path.length < self._certain_until and not is_within_reach(track, times, settings):
            return None  # saves a costly covariance
        covariance = smoother.newest_covariance()
        if not is_lost(covariance, settings):
            self._certain_until = path.length + CERTAIN_PATH
        found = register(track, times, covariance, path.beginning, settings)
        return found if found is not None and passes_start(track.state, path, found.motion) else None

    def _by_cones(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the newest pose relative to an early one, if its cones match those of the beginning."""
        covariance = road.smoother.newest_covariance()
        seen_in = record.seen_in(road.smoother.variables.sensor, noise)
        return return_to_beginning(seen_in, unwrap(record.poses), covariance, road.settings)

    def _revisit_of(self, road: Road, record: DriveRecord, found: RefinedMotion, within: float) -> Revisit:
        """Return the moved newest pose relative to the nearest pose on the first `within` metres."""
        poses = record.with_window(road)
        newest = poses[-1:].copy()
        found.motion.move(newest)
        beside = (path_lengths(poses) < within) & (np.cos(poses[:, 2] - newest[0, 2]) > np.cos(HEADING))
        away = np.where(beside, np.hypot(*(poses[:, :2] - newest[0, :2]).T), inf)
        earlier, information = int(away.argmin()), np.asarray(np.linalg.inv(found.covariance), np.float64)
        ends = (earlier, poses[earlier]), (len(poses) - 1, newest[0])
        return relative_pose(*ends, newest[0], information)

    def _is_due(self, road: Road, way: str) -> bool:
        """Whether a way is due, some metres or cycles after its last attempt; if so, record the attempt."""
        length, cycle = road.path.length, road.next_cycle
        tried, tried_cycle = self._tried[way]
        interval = self._settings.check_interval
        if way == "shape":
            interval = RECOGNITION_INTERVAL * max(length / LONG_PATH, 1.0)
        elif not near_start(road.path, road.poses[-1], self._settings):
            return False
        waited = way == "cones" and cycle >= tried_cycle + RETURN_CYCLES
        if length < self._rests_until or (length < tried + interval and not waited):
            return False
        if way == "curves" and not road.boundaries:
            return False
        self._tried[way] = length, cycle
        return True
