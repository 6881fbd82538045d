"""The vehicle whose place is unknown: its search on a known map, and the phase of one that is lost.

While the vehicle is lost, its detections do not change the map. They are stored on the path by odometry,
which proposes places by its shape (`places.find`). Once one of them is sure, the window restarts there.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, difference, inverse, path_lengths
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.smoother import forget_poses
from pathspace_graph.health import DEGRADED, Health
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.places.find import STRETCH, KnownRoad, Place, Prior, place_on, sure

from .drive import Drive, Phase, Step

FOUND: Final = "the vehicle was lost, and is found again"  # notice of a relocalization
SEARCH_INTERVAL: Final = 0.5  # least time between two attempts (s)
LEAST_PATH: Final = 20.0  # least length of the path without a given start (m)
AT_START: Final = (1.0, 1.0, 0.2), (4.0, 0.5)  # sigmas and reach of a given start (m, m, rad)
WIDENING: Final = 3.0  # inflation of the sigmas of a place: its detections are used again


class Search(Copyable):
    """Search for a vehicle on a known road, by the path and the detections since its start."""

    def __init__(self, road: Road, known: KnownRoad, start: Array | None = None) -> None:
        """Start at the newest cycle; `start` (3,) is the pose of the road's origin on the map, if known."""
        self.settings, self.known, self.start = road.settings, known, start
        self.first_cycle = road.next_cycle  # first cycle with stored detections
        self._poses: list[Array] = []
        self._seen: list[Detections] = []
        self._tried = road.smoother.times[-1]  # stamp of the last attempt (s)

    def look(self, road: Road, classified: Classified, reading: Reading) -> None:
        """Store the newest cycle of a road, with detections corrected by the calibration."""
        track = road.smoother.map
        corrected = track.detections.corrected(classified.new, track.variables.sensor).copy()
        self.observe(road.poses[-1], replace(reading.detections, points_vehicle=corrected))

    def observe(self, pose: Array, detections: Detections) -> None:
        """Store a cycle: its pose (3,) by odometry, and its detections."""
        self._poses.append(pose.copy())
        self._seen.append(detections)
        driven = path_lengths(np.array(self._poses))
        old = int(driven.searchsorted(driven[-1] - STRETCH))
        del self._poses[:old], self._seen[:old]

    def find(self) -> Place | None:
        """Return the place of the newest pose, if an attempt is due and finds a sure one."""
        if not self._seen or self._seen[-1].t - self._tried < SEARCH_INTERVAL:
            return None
        self._tried = self._seen[-1].t
        poses = np.array(self._poses)
        prior = None
        if self.start is not None:
            prior = Prior.about(compose(self.start, poses[-1]), *AT_START)
        elif path_lengths(poses)[-1] < LEAST_PATH:
            return None
        return sure(place_on(self.known, self._seen_in, poses, self.settings, prior))

    def _seen_in(self, cycles: IntArray) -> DetectionColumns:
        return DetectionColumns.of(self._seen[cycles[0] :], int(cycles[0]))


class Lost(Phase):
    """Search for a lost vehicle; detections do not change the closed map."""

    uses_detections = False

    def __init__(self, closed: Phase, road: Road, health: Health) -> None:
        """Start when the vehicle on a closed map becomes lost, with the health that says why."""
        self.closed = closed  # phase of a vehicle that is found
        road.smoother.refresh()
        track = road.smoother.map
        cones = None if road.settings.of_lines else track.cones
        self.search = Search(road, KnownRoad.of(track.state.splines, cones))
        self._health = health

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Record the detections for the search."""
        self.search.look(road, classified, reading)
        return self, self._health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Restart the window where the search finds the vehicle."""
        drive.record.estimated(road)
        found = None if drive.rests(road) else self.search.find()
        if found is None:
            return Step(self)
        first_cycle = max(self.search.first_cycle, road.smoother.first_cycle)
        drive.monitor.restart()
        jump = restart_window(road.smoother, first_cycle, found)
        return Step(self.closed, jump, FOUND, Health(DEGRADED, FOUND))


def restart_window(smoother: CurveSmoother, first_cycle: int, place: Place) -> Array:
    """Move the window to the place of the newest pose; return its jump (3,).

    The poses before `first_cycle` leave the window. The prior of the map stays; that of the poses is replaced
    by the widened covariance of the place.
    """
    state, settings = smoother.map.state, smoother.map.settings
    forget_poses(smoother, first_cycle)
    before = state.poses[-1].copy()
    state.poses[:] = compose(compose(place.pose, inverse(before)), state.poses)
    smoother.add_pose_prior(smoother.next_cycle - 1, widened(place))
    locate_poses(state)
    smoother.reassociate()
    for _ in range(2):
        smoother.step(settings.sigma_step)
    return difference(state.poses[-1], before)


def widened(place: Place) -> Array:
    """Return the covariance (3, 3) at a place, inflated since the window uses the detections again."""
    return np.asarray(WIDENING**2 * np.linalg.inv(place.information), np.float64)
