"""Relocalization of a lost vehicle on a closed map, by hypotheses along the loop.

While the vehicle is lost, its detections do not change the map. They are stored on the path by odometry,
which is aligned rigidly with each place of the loop. Registration refines the best places. Once one is
clearly better than all others, twice in a row, the window restarts there.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import move_points, path_lengths, to_map, wrap_angle
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.changes import forget_poses
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.registration import Motion, RefinedMotion, Registration, Sightings, worst_sigma
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State

from .known_loop import MIDDLE_STEP, Loop, lay_out_loop

FOUND: Final = "the vehicle was lost, and is found again"  # notice of a relocalization
SEARCH_INTERVAL: Final = 0.5  # least time between two attempts (s)
SEARCH_MEMORY: Final = 60.0  # length of the newest path in use (m)
SEARCH_DETECTIONS: Final = 200  # largest number of detections in use, chosen evenly
MIN_DETECTIONS: Final = 40  # least number of detections
LEAD: Final = 4.0  # distance ahead of the vehicle of an additional point of its path (m)
MISFIT: Final = 3.0  # largest rms distance of the aligned path from the middle of the track (m)
REACH: Final = 3.0  # largest distance of a detection from its curve; larger ones are clipped (m)
SEARCH_STARTS: Final = 12  # largest number of refined places
APART: Final = 4.0  # distance below which two places are the same (m)
SIGMAS_PLACE: Final = (3.0, 3.0, 0.2)  # prior of the pose at a place, before refinement (m, m, rad)
SIGMAS_START: Final = (1.0, 1.0, 0.2)  # prior of the given start pose of a drive (m, m, rad)
SIGMA_FIT: Final = 0.3  # scale of the score `exp(-d^2 / (2 SIGMA_FIT^2))` at a distance d from the curve (m)
MIN_SCORE: Final = 0.6  # least score of an accepted place; the true one has about 0.85
MARGIN: Final = 0.1  # least margin of its score over every other place
SIGMA_MAX: Final = 0.5  # largest standard deviation of the position in its worst direction (m)
CONFIRMATIONS: Final = 2  # successive attempts that must agree
WIDENING: Final = 3.0  # inflation of the registration's sigmas in the prior: its detections are used again
STEPS: Final = 2  # Gauss-Newton steps after the restart


@dataclass(frozen=True, eq=False)
class Place:
    """A place of the map to which the newest detections are registered."""

    score: float  # mean score of the detections, 0 to 1
    found: RefinedMotion

    def is_near(self, other: "Place") -> bool:
        apart = self.found.motion.vector[:2] - other.found.motion.vector[:2]
        return bool(np.hypot(*apart) < APART)


Choice = Callable[[list[Place] | None], RefinedMotion | None]


class Search(Copyable):
    """Search for a vehicle on a closed map, by the path and the detections since its start."""

    def __init__(self, road: Road, start: Array | None = None) -> None:
        """Start at the newest cycle; `start` (3,) is the pose of the road's origin on the map, if known."""
        self.settings, self.start = road.settings, start
        sigmas = SIGMAS_PLACE if start is None else SIGMAS_START
        self._information = np.diag(np.array(sigmas) ** -2)  # of the prior at a place
        self.first_cycle = road.next_cycle  # first cycle with stored detections
        self._poses: list[Array] = []
        self._seen: list[Detections] = []
        self._tried = road.smoother.times[-1]  # stamp of the last attempt (s)
        self._last: Motion | None = None  # result of the last attempt
        self._agreed = 0  # successive attempts with the same result

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
        old = int(driven.searchsorted(driven[-1] - SEARCH_MEMORY))
        del self._poses[:old], self._seen[:old]

    def find(self, smoother: CurveSmoother, choose: Choice | None = None) -> RefinedMotion | None:
        """Return the motion onto the map once successive attempts agree.

        `choose` selects a place from a list, best first; the default is `by_score`.
        """
        if not self._seen or self._seen[-1].t - self._tried < SEARCH_INTERVAL:
            return None
        best = (choose or self.by_score)(self._places(smoother))
        last, newest = self._last, self._poses[-1][None, :2]
        self._tried, self._last = self._seen[-1].t, None if best is None else best.motion
        if best is None:
            return None
        moved = best.motion.apply(newest)[0]
        agrees = last is not None and np.hypot(*(moved - last.apply(newest)[0])) < APART
        self._agreed = self._agreed + 1 if agrees else 1
        return best if self._agreed >= CONFIRMATIONS else None

    def widened(self, found: RefinedMotion) -> Array:
        """Return the covariance (3, 3) at a place, inflated since the window uses the detections again."""
        seen = np.linalg.inv(found.covariance) - self._information
        return np.asarray(np.linalg.inv(seen / WIDENING**2 + self._information), np.float64)

    def _places(self, smoother: CurveSmoother) -> list[Place] | None:
        """Return the likeliest places, best first; None with too few detections."""
        seen = self._sightings()
        if len(seen.rows) < MIN_DETECTIONS:
            return None
        smoother.refresh()  # the map still relaxes after the release of detections
        state, loop = smoother.map.state, lay_out_loop(smoother.map)
        centre = self._poses[-1][:2]
        starts = [(Motion(centre, vector), i) for vector, i in self._starts(loop, seen)]
        places = [self._refined(state, loop, seen, start, i) for start, i in starts]
        return sorted(places, key=lambda place: -place.score)

    def by_score(self, places: list[Place] | None) -> RefinedMotion | None:
        """Return the motion onto a place that is clearly better than all others, if there is one."""
        if not places or places[0].score < MIN_SCORE:
            return None
        best = places[0]
        rivals = [place.score for place in places if not place.is_near(best)]
        if rivals and rivals[0] > best.score - MARGIN:
            return None
        if self.start is not None:  # the start determines what the curves do not
            return best.found
        return best.found if worst_sigma(best.found.covariance) < SIGMA_MAX else None

    def _sightings(self) -> Sightings:
        labels = np.concatenate([one.labels for one in self._seen])
        cycles = np.repeat(np.arange(len(self._seen)), [len(one.labels) for one in self._seen])
        points = np.concatenate([one.points_vehicle for one in self._seen])
        rows = np.flatnonzero(np.isin(labels, BOUNDARIES))
        rows = rows[:: max(-(-len(rows) // SEARCH_DETECTIONS), 1)]
        placed = to_map(points[rows], np.array(self._poses)[cycles[rows]])
        return Sightings.of_points(rows, labels[rows], placed)

    # --- hypotheses --------------------------------------------------------------------------------------

    def _starts(self, loop: Loop, seen: Sightings) -> list[tuple[Array, int]]:
        """Return motions (3,) onto the likeliest places, each with the index of its point on the middle."""
        if self.start is not None:
            return [self._at_start(loop, self.start)]
        motions, misfit = self._beside(loop)
        possible = np.flatnonzero(misfit < MISFIT)
        if len(possible) == 0:
            return []
        turn, centre = np.exp(1j * motions[possible, 2])[:, None], self._poses[-1][:2]
        arms = (seen.points - centre) @ np.array([1.0, 1j])
        moved = turn * arms + (centre + motions[possible, :2]) @ np.array([[1.0], [1j]])
        points = np.stack([moved.real, moved.imag], axis=2)
        cost = np.square(loop.distances(seen.labels, points, REACH)).mean(axis=1)
        return [(motions[i], int(i)) for i in _spread(loop, possible, cost)]

    def _at_start(self, loop: Loop, start: Array) -> tuple[Array, int]:
        """Return the motion (3,) of the origin to `start` (3,), and the index of the nearest point."""
        newest = self._poses[-1][:2]
        there = move_points(start, newest[None])[0]
        nearest = int(np.hypot(*(loop.middle - there).T).argmin())
        return np.append(there - newest, start[2]), nearest

    def _beside(self, loop: Loop) -> tuple[Array, Array]:
        """Align the path with the middle up to each point; return motions (n, 3) and misfits (n,) in m."""
        poses = np.array(self._poses)
        behind = np.append(np.hypot(*np.diff(poses[:, :2], axis=0).T)[::-1].cumsum()[::-1], 0.0)
        _, first = np.unique(behind // MIDDLE_STEP, return_index=True)
        ahead = poses[-1, :2] + LEAD * np.array([np.cos(poses[-1, 2]), np.sin(poses[-1, 2])])
        path = np.concatenate([poses[first, :2], ahead[None]]) @ np.array([1.0, 1j])
        target = loop.at(loop.stations[:, None] - np.append(behind[first], -LEAD))
        mean, means = path.mean(), target.mean(axis=1)
        turn = ((path - mean).conj() * (target - means[:, None])).sum(axis=1)
        turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
        misfit = np.abs(turn[:, None] * (path - mean) - (target - means[:, None]))
        centre = poses[-1, :2] @ np.array([1.0, 1j])
        shift = means - centre - turn * (mean - centre)
        return np.column_stack([shift.real, shift.imag, np.angle(turn)]), np.sqrt((misfit**2).mean(axis=1))

    def _refined(self, state: State, loop: Loop, seen: Sightings, start: Motion, i: int) -> Place:
        """Register the detections from an initial motion onto point `i` of the middle."""
        gate, stretches = self.settings.gate, dict[int, tuple[float, float]]()
        driven = float(path_lengths(np.array(self._poses))[-1])
        for label, u in loop.beside.items():  # the stretch in view on a path that ends there
            tables = state.boundaries[label].tables
            low = float(u[i]) - driven - gate.station_room
            high = float(u[i]) + gate.view_ahead + gate.station_room
            whole = high - low >= tables.high - tables.low
            stretches[label] = (tables.low, tables.high) if whole else (low, high)
            if not state.boundaries[label].periodic:
                stretches[label] = max(low, tables.low), min(high, tables.high)
        registration = Registration(state, seen, stretches, self.settings.closing)
        found = registration.refine(start, start.vector, self._information)
        distance = loop.distances(seen.labels, found.motion.apply(seen.points), REACH)
        return Place(float(np.exp(-0.5 * (distance / SIGMA_FIT) ** 2).mean()), found)


def _spread(loop: Loop, places: IntArray, cost: Array) -> list[int]:
    """Return the places of least cost that are at least `APART` from each other."""
    chosen = list[int]()
    for i in places[np.argsort(cost)].tolist():
        away = np.abs(loop.stations[chosen] - loop.stations[i])
        if (np.minimum(away, loop.length - away) >= APART).all():
            chosen.append(i)
        if len(chosen) == SEARCH_STARTS:
            break
    return chosen


def restart_window(smoother: CurveSmoother, first_cycle: int, found: RefinedMotion) -> Array:
    """Move the window to the place found; return the jump (3,) of the newest pose.

    The poses before `first_cycle` leave the window. The prior of the map stays; that of the poses is replaced
    by the covariance of the registration.
    """
    state, settings = smoother.map.state, smoother.map.settings
    forget_poses(smoother, first_cycle)
    before = state.poses[-1].copy()
    found.motion.move(state.poses)
    smoother.add_pose_prior(smoother.next_cycle - 1, found.covariance * WIDENING**2)
    locate_poses(state)
    smoother.reassociate()
    for _ in range(STEPS):
        smoother.step(settings.sigma_step)
    jump = state.poses[-1] - before
    return np.append(jump[:2], wrap_angle(jump[2]))
