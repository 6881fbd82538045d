"""Finding a vehicle that is lost on a closed map: hypotheses along the loop, until one is left.

While the vehicle is lost, its detections do not change the map. They are remembered on the path by odometry,
which is laid rigidly beside each place of the loop, and the best places are refined by the registration. Once
one is clearly better than all others, twice in a row, the window starts anew there.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.batch.association import locate_poses
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths, to_map, wrap_angle
from pathspace_graph.graph.gaussian import half_solve
from pathspace_graph.graph.variables import POSE
from pathspace_graph.health import SHARE_DEGRADED, Evidence
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import Motion, RefinedMotion, Registration, Sightings, worst_sigma
from pathspace_graph.mapping.smoother import CurveSmoother, Gating
from pathspace_graph.mapping.state import SAMPLE, State
from pathspace_graph.spline.boundary import Boundary

_POSITION: Final = np.asfortranarray(np.eye(POSE)[:, :2])  # unit vectors that choose a pose's position
FOUND: Final = "the vehicle was lost, and is found again"  # notice of the cycle in which it is found
BESIDE: Final = 1.0  # distance from the closed curve within which an unused detection is explained (m)
GAP: Final = 3.0  # least distance of neighbouring cones with a gap between them, over the median
INTERVAL: Final = 0.5  # least time between two attempts (s)
MEMORY: Final = 60.0  # length of the newest path whose detections are compared with the map (m)
MOST_DETECTIONS: Final = 200  # largest number of detections, evenly chosen, that are compared with the map
MIN_DETECTIONS: Final = 40  # least number of detections that are compared with the map
STEP: Final = 2.0  # distance of the places along the loop (m)
LEAD: Final = 4.0  # distance ahead of the point on the middle of the track that the vehicle heads for (m)
MISFIT: Final = 3.0  # rms distance of the path driven from the middle within which a place is compared (m)
REACH: Final = 3.0  # distance from its curve that any farther detection counts as (m)
STARTS: Final = 12  # largest number of places that are refined
APART: Final = 4.0  # distance below which two places are one (m)
SIGMAS_PLACE: Final = (3.0, 3.0, 0.2)  # of the pose about a place, before it is refined (m, m, rad)
SIGMA_FIT: Final = 0.3  # a detection at a distance d from its curve scores `exp(-d^2 / (2 SIGMA_FIT^2))` (m)
MIN_SCORE: Final = 0.6  # least score of the place that is accepted; the true one has about 0.85
MARGIN: Final = 0.1  # least lead of its score over that of every other place
SIGMA_MAX: Final = 0.5  # largest standard deviation of the position there in its worst direction (m)
CONFIRMATIONS: Final = 2  # attempts, one after the other, that must find the same place
WIDENING: Final = 3.0  # of the registration's sigmas in the prior there: its detections are used again
STEPS: Final = 2  # Gauss-Newton steps at the place that was found


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed map as the search needs it."""

    middle: Array  # (n, 2) points on the middle of the track in driving order, in m, map frame
    stations: Array  # (n,) length along the middle up to each of them (m)
    length: float  # length of the middle (m)
    beside: Mapping[int, Array]  # (n,) parameters beside the points of the middle on each boundary (m)
    curves: Mapping[int, KDTree]  # densely sampled points of each boundary
    mapped: Mapping[int, BoolArray]  # whether each of these lies between detected cones (`is_mapped`)

    constant: ClassVar[bool] = True

    def at(self, stations: Array) -> Array:
        """Return the points of the middle at stations of any shape, as complex numbers x + i y."""
        x, y = (np.interp(stations, self.stations, axis, period=self.length) for axis in self.middle.T)
        return np.asarray(x + 1j * y)

    def distances(self, labels: IntArray, points: Array, most: float) -> Array:
        """Return the distance (..., m) of points (..., m, 2) from their curve (m,), in m, at most `most`."""
        found = np.full(points.shape[:-1], most)
        for label, curve in self.curves.items():
            of_label = labels == label
            distance, _ = curve.query(points[..., of_label, :], distance_upper_bound=most)
            found[..., of_label] = np.minimum(distance, most)
        return found

    def beside_gaps(self, labels: IntArray, points: Array) -> BoolArray:
        """Return which points (m, 2) are nearest to a gap of their curve (m,), where no cone is mapped."""
        found = np.zeros(len(points), bool)
        for label, curve in self.curves.items():
            of_label = np.flatnonzero(labels == label)
            if len(of_label):
                found[of_label] = ~self.mapped[label][curve.query(points[of_label])[1]]
        return found


def is_mapped(u: Array, cones: Array, length: float, gap: float, margin: float) -> BoolArray:
    """Return which parameters (m,) of a closed curve lie between neighbouring cones at parameters (k,), in m.

    The others lie in a gap, longer than `gap` times the median distance of neighbours, and farther than the
    margin (m) from its ends. Where the cones are not known, all of the curve counts as mapped.
    """
    if len(cones) < 2:
        return np.ones(len(u), bool)
    places = np.unique(np.mod(cones, length))
    steps = np.diff(places, append=places[0] + length)
    before = np.searchsorted(places, np.mod(u, length)) - 1
    past = np.mod(u - places[before], length)
    near_end = np.minimum(past, steps[before] - past) < margin
    return np.asarray(near_end | (steps <= gap * np.median(steps))[before])


def lay_out_loop(track: CurveMap) -> Loop:
    """Return the loop between two closed curves."""
    u, points, mapped, margin = {}, {}, {}, track.settings.growth.merge_radius
    for label, boundary in track.state.boundaries.items():
        u[label] = np.arange(boundary.tables.low, boundary.tables.high, SAMPLE)
        points[label] = boundary.evaluate(track.state.control_points(label), u[label])
        cones = track.cones.get(label, np.zeros(0))
        mapped[label] = is_mapped(u[label], cones, boundary.length, GAP, margin)
    curves = {label: KDTree(curve) for label, curve in points.items()}
    every = max(int(STEP / SAMPLE), 1)
    left = points[LEFT][::every]
    opposite = curves[RIGHT].query(left)[1]
    middle = 0.5 * (left + points[RIGHT][opposite])
    steps = np.hypot(*np.diff(middle, axis=0, append=middle[:1]).T)
    stations = np.concatenate([[0.0], steps.cumsum()[:-1]])
    beside = {LEFT: u[LEFT][::every], RIGHT: u[RIGHT][opposite]}
    return Loop(middle, stations, float(steps.sum()), beside, curves, mapped)


class KnownLoop:
    """The closed map, laid out when it is asked for, and again once the curves were replaced by others."""

    def __init__(self, smoother: CurveSmoother) -> None:
        self._smoother = smoother
        self._laid_out: tuple[list[Boundary], Loop] | None = None

    def get(self) -> Loop:
        """Return the loop as it was when it was laid out, which changes no variable."""
        state = self._smoother.map.state
        boundaries = [*state.boundaries.values()]
        if self._laid_out is None or self._laid_out[0] != boundaries:
            values = state.variables.values.copy()
            self._smoother.refresh()
            self._laid_out = boundaries, lay_out_loop(self._smoother.map)
            state.variables.values[:] = values
        return self._laid_out[1]

    @property
    def is_whole(self) -> bool:
        """Return whether the loop has closed, with both boundaries."""
        state = self._smoother.map.state
        return state.closed and set(state.boundaries) == set(BOUNDARIES)

    def with_gaps(self) -> list[int]:
        """Return the boundaries whose curves have gaps."""
        return [label for label, mapped in self.get().mapped.items() if not mapped.all()]

    def is_mapped(self, label: int, u: Array) -> BoolArray:
        """Return which parameters (m,) of a boundary lie between detected cones, to the nearest sample."""
        low = self._smoother.map.state.boundaries[label].tables.low
        nearest = np.rint((u - low) / SAMPLE).astype(np.intp)
        return self.get().mapped[label].take(nearest, mode="wrap")


def evidence_of(smoother: CurveSmoother, tested: Gating, known: KnownLoop, seen_again: BoolArray) -> Evidence:
    """Return what the tested detections say about the newest pose, before the update.

    On a closed map every coloured detection should lie on a curve. If many are not in use, these are looked
    for on the whole of their curve: they may be of a stretch across the infield. Three kinds say nothing
    about the vehicle: those not `seen_again` (m,) of all detections of the cycle, those on the curve of the
    other colour, and those beside a gap of the map.
    """
    detections = smoother.map.detections
    closed, used = smoother.map.state.closed, detections.used[tested.rows]
    again = seen_again[tested.rows - (len(detections) - len(seen_again))]
    judged = used | ((tested.in_view | closed) & again)
    labels, explained, unmapped = detections.label[tested.rows], used.copy(), np.zeros(len(used), bool)
    if known.is_whole and used.sum() < SHARE_DEGRADED * judged.sum():
        others = np.flatnonzero(judged & ~used)
        rows = tested.rows[others]
        points, loop, label = detections.points_map(rows, smoother.variables), known.get(), labels[others]
        explained[others] = loop.distances(label, points, BESIDE) < BESIDE
        unmapped[others] = ~explained[others] & loop.beside_gaps(label, points)
        wrong = loop.distances(LEFT + RIGHT - label, points, BESIDE) < BESIDE
        judged[others] &= explained[others] | ~wrong
        unmapped &= judged
    innovations, offered = tested.innovation[used], judged & ~unmapped
    sigma, last = np.nan, smoother.last_step
    if closed and last is not None:
        half = half_solve(last.factor[-POSE:, -POSE:], _POSITION.copy())  # the newest pose is the last block
        sigma = worst_sigma(half.T @ half)
    return Evidence(
        t=smoother.times[-1],
        offered=int(offered.sum()),
        explained=int(explained.sum()),
        used=int(used.sum()),
        innovations=float(innovations @ innovations),
        closed=closed,
        sigma=sigma,
        offered_by=_by_boundary(labels[offered]),
        explained_by=_by_boundary(labels[explained]),
        unmapped=_by_boundary(labels[unmapped]),
    )


def _by_boundary(labels: IntArray) -> tuple[int, int]:
    left, right = np.bincount(labels, minlength=len(BOUNDARIES)).tolist()
    return left, right


class Search:
    """What a lost vehicle has seen, and the search for its place on a closed map."""

    def __init__(self, smoother: CurveSmoother) -> None:
        self.settings, self._smoother = smoother.map.settings, smoother
        self.loop: Loop  # the map as it was in the last attempt
        self.first_cycle = smoother.next_cycle  # cycle from which on detections are remembered
        self._poses: list[Array] = []
        self._seen: list[Detections] = []
        self._tried = smoother.times[-1]
        self._last: Motion | None = None  # of the last attempt
        self._agreed, self._missed = 0, 0  # attempts in a row

    def observe(self, pose: Array, detections: Detections) -> None:
        """Remember a cycle: its pose (3,) by odometry, and its detections."""
        self._poses.append(pose.copy())
        self._seen.append(detections)
        driven = path_lengths(np.array(self._poses))
        old = int(driven.searchsorted(driven[-1] - MEMORY))
        del self._poses[:old], self._seen[:old]

    def find(self) -> RefinedMotion | None:
        """Return the motion onto the only place that agrees, once it was found several times in a row."""
        if not self._seen or self._seen[-1].t - self._tried < INTERVAL:
            return None
        best, last, newest = self._best(), self._last, self._poses[-1][None, :2]
        self._tried, self._last = self._seen[-1].t, None if best is None else best.motion
        if best is None:
            return None
        moved = best.motion.apply(newest)[0]
        agrees = last is not None and np.hypot(*(moved - last.apply(newest)[0])) < APART
        self._agreed = self._agreed + 1 if agrees else 1
        return best if self._agreed >= CONFIRMATIONS else None

    @property
    def is_off_map(self) -> bool:
        """Return whether no place of the map agrees with what was seen, several times in a row."""
        return self._missed >= CONFIRMATIONS

    def _best(self) -> RefinedMotion | None:
        """Return the motion onto the place that is clearly better than all others, if there is one."""
        seen = self._sightings()
        if len(seen.rows) < MIN_DETECTIONS:
            return None
        self._smoother.refresh()  # the map goes on to relax from the detections that were taken out of use
        state = self._smoother.map.state
        self.loop = lay_out_loop(self._smoother.map)
        centre = self._poses[-1][:2]
        places = [self._refined(state, seen, Motion(centre, vector), i) for vector, i in self._starts(seen)]
        places.sort(key=lambda place: -place[0])
        if not places or places[0][0] < MIN_SCORE:
            self._missed += 1
            return None
        self._missed = 0
        most, best = places[0]
        at = best.motion.vector[:2]
        rivals = [one for one, found in places if np.hypot(*(found.motion.vector[:2] - at)) >= APART]
        if rivals and rivals[0] > most - MARGIN:
            return None
        return best if worst_sigma(best.covariance) < SIGMA_MAX else None

    def _sightings(self) -> Sightings:
        labels = np.concatenate([one.labels for one in self._seen])
        cycles = np.repeat(np.arange(len(self._seen)), [len(one.labels) for one in self._seen])
        points = np.concatenate([one.points_vehicle for one in self._seen])
        rows = np.flatnonzero(np.isin(labels, BOUNDARIES))
        rows = rows[:: max(-(-len(rows) // MOST_DETECTIONS), 1)]
        placed = to_map(points[rows], np.array(self._poses)[cycles[rows]])
        return Sightings.of_points(rows, labels[rows], placed)

    # --- hypotheses --------------------------------------------------------------------------------------

    def _starts(self, seen: Sightings) -> list[tuple[Array, int]]:
        """Return motions (3,) onto the likeliest places, each with the index of its point of the middle."""
        motions, misfit = self._beside_the_loop()
        possible = np.flatnonzero(misfit < MISFIT)
        if len(possible) == 0:
            return []
        turn, centre = np.exp(1j * motions[possible, 2])[:, None], self._poses[-1][:2]
        arms = (seen.points - centre) @ np.array([1.0, 1j])
        moved = turn * arms + (centre + motions[possible, :2]) @ np.array([[1.0], [1j]])
        points = np.stack([moved.real, moved.imag], axis=2)
        cost = np.square(self.loop.distances(seen.labels, points, REACH)).mean(axis=1)
        return [(motions[i], int(i)) for i in self._spread(possible, cost)]

    def _spread(self, places: IntArray, cost: Array) -> list[int]:
        """Return the places of least cost that are no nearer to each other than `APART`."""
        chosen = list[int]()
        for i in places[np.argsort(cost)].tolist():
            away = np.abs(self.loop.stations[chosen] - self.loop.stations[i])
            if (np.minimum(away, self.loop.length - away) >= APART).all():
                chosen.append(i)
            if len(chosen) == STARTS:
                break
        return chosen

    def _beside_the_loop(self) -> tuple[Array, Array]:
        """Return motions (n, 3) that fit the path to the middle before its points, and rms misfits (n,)."""
        poses = np.array(self._poses)
        behind = np.append(np.hypot(*np.diff(poses[:, :2], axis=0).T)[::-1].cumsum()[::-1], 0.0)
        _, first = np.unique(behind // STEP, return_index=True)
        ahead = poses[-1, :2] + LEAD * np.array([np.cos(poses[-1, 2]), np.sin(poses[-1, 2])])
        path = np.concatenate([poses[first, :2], ahead[None]]) @ np.array([1.0, 1j])
        target = self.loop.at(self.loop.stations[:, None] - np.append(behind[first], -LEAD))
        mean, means = path.mean(), target.mean(axis=1)
        turn = ((path - mean).conj() * (target - means[:, None])).sum(axis=1)
        turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
        misfit = np.abs(turn[:, None] * (path - mean) - (target - means[:, None]))
        centre = poses[-1, :2] @ np.array([1.0, 1j])
        shift = means - centre - turn * (mean - centre)
        return np.column_stack([shift.real, shift.imag, np.angle(turn)]), np.sqrt((misfit**2).mean(axis=1))

    def _refined(self, state: State, seen: Sightings, start: Motion, i: int) -> tuple[float, RefinedMotion]:
        """Return the score (0 to 1) and the registration from a motion onto point `i` of the middle."""
        gate, stretches = self.settings.gate, dict[int, tuple[float, float]]()
        driven = float(path_lengths(np.array(self._poses))[-1])
        for label, u in self.loop.beside.items():  # what the vehicle has seen on a path that ends there
            tables = state.boundaries[label].tables
            low = float(u[i]) - driven - gate.station_room
            high = float(u[i]) + gate.view_ahead + gate.station_room
            whole = high - low >= tables.high - tables.low
            stretches[label] = (tables.low, tables.high) if whole else (low, high)
        registration = Registration(state, seen, stretches, self.settings.closing)
        found = registration.refine(start, start.vector, np.diag(np.array(SIGMAS_PLACE) ** -2))
        distance = self.loop.distances(seen.labels, found.motion.apply(seen.points), REACH)
        return float(np.exp(-0.5 * (distance / SIGMA_FIT) ** 2).mean()), found


def start_anew(smoother: CurveSmoother, first_cycle: int, found: RefinedMotion) -> Array:
    """Move the window onto the place that was found, and return the jump (3,) of the newest pose.

    The poses before `first_cycle` leave the window. The map and its prior stay; what the prior says about the
    poses is replaced by the covariance of the registration.
    """
    state, settings = smoother.map.state, smoother.map.settings
    smoother.forget_poses(first_cycle)
    before = state.poses[-1].copy()
    found.motion.move(state.poses)
    smoother.add_pose_prior(smoother.next_cycle - 1, found.covariance * WIDENING**2)
    locate_poses(state)
    smoother.reassociate()
    for _ in range(STEPS):
        smoother.step(settings.sigma_step)
    jump = state.poses[-1] - before
    return np.append(jump[:2], wrap_angle(jump[2]))
