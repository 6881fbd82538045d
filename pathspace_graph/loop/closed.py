"""The closed map: localization, refinement and repair; and a vehicle that is lost on it."""

from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, difference, inverse, path_lengths
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.smoother import forget_poses
from pathspace_graph.health import DEGRADED, GOOD, LOST, Health
from pathspace_graph.io.log import Detections
from pathspace_graph.loop.closing import fix_gauge
from pathspace_graph.loop.drive import Drive, Phase, Step
from pathspace_graph.loop.known_loop import KnownLoop, MapRepair, evidence_of
from pathspace_graph.loop.lap_solver import Outcome, Unsolved
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.places.find import STRETCH, KnownRoad, Place, Prior, place_on, sure

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


# --- a vehicle that is not lost -----------------------------------------------------------------------------


class Closed(Phase):
    """Refinement and repair of a closed map."""

    def __init__(self, road: Road, boundaries_cross: bool = False) -> None:
        """Start just after the curves were closed: by a batch, whose boundaries do not cross, or as known."""
        self.map_repair = MapRepair(road.settings)
        self.known_loop = KnownLoop()
        self._boundaries_cross = boundaries_cross
        self._settled = road.path.length  # path length at the last replacement of the map (m)
        road.growth.tentative.clear()

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Judge estimate and map by the tested detections; the phase becomes `Lost` for a lost vehicle."""
        smoother, is_whole = road.smoother, road.has_both_boundaries
        known = self.known_loop if is_whole else None
        health = drive.monitor.update(evidence_of(smoother, classified.tested, known, reading))
        if health.condition == GOOD and self._boundaries_cross:
            health = Health(DEGRADED, "the two boundaries of the map cross")
        if is_whole and drive.can_repair:
            loop = self.known_loop.of(smoother)
            self.map_repair.observe(smoother.map, loop, classified.new, reading.detections.t)
        if health.condition != LOST or not is_whole or drive.solver.is_busy:
            return self, health
        smoother.map.detections.release_all()  # they must not change the map
        self.map_repair.tracks.clear()
        drive.record.give_up("the vehicle was lost")
        return Lost(self, road, health), health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Fix the gauge after enough laps, repair the map, and apply the batch of a repair."""
        drive.record.estimated(road)
        if drive.rests(road):
            return Step(self)
        if drive.solver.is_busy:
            outcome = drive.outcome(road, spent)
            return Step(self) if outcome is None else self.take(road, drive, outcome)
        smoother = road.smoother
        if not smoother.user_factors.given and smoother.held is None:  # user factors may observe the gauge
            longest = max(boundary.length for boundary in road.boundaries.values())
            if road.path.length > self._settled + road.settings.closing.gauge_laps * longest:
                fix_gauge(smoother)
        return Step(self, notice=self._repair(road, drive, reading))

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Apply a repaired map that explains the contradictions, if nothing speaks against it."""
        solved = None if isinstance(outcome, Unsolved) or outcome.objection else outcome
        notice = self.map_repair.end(solved)
        if solved is None or not notice:
            return Step(self)
        jump = drive.take(road, solved)
        self._boundaries_cross, self._settled = False, road.path.length
        return Step(self, jump, notice)

    def _repair(self, road: Road, drive: Drive, reading: Reading) -> str:
        """Start a batch of the drive if cones contradict the map; repair a known map in place.

        Return the notice of a repair in place.
        """
        t, driven = reading.detections.t, road.path.length
        if not road.has_both_boundaries or not drive.can_repair:
            return ""
        if not self.map_repair.is_due(self.known_loop, road.smoother, t, driven):
            return ""
        if drive.record.unsolvable is None:
            start = self.map_repair.begin(road.smoother, drive.record.poses)
            drive.begin_batch(road, reading.noise, start, ())
            return ""
        self.known_loop = KnownLoop()
        return self.map_repair.in_place(road.smoother)
