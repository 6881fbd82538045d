"""The place of a vehicle on what is known: constellations of cones, or curves, laid on one another.

Cones are merged, without identity, in one frame. A prior or the shape of the driven path proposes poses, and
cones or curves verify them. Cones stand at regular distances, so a few of them fit in many places. A place
has log odds against every rival: the other places, and that the vehicle is at none of them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, log
from typing import Final, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import KDTree

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.path import HEADING
from pathspace_graph.mapping.tracks import Tracks
from pathspace_graph.settings.mapper import GrowthSettings, MapperSettings
from pathspace_graph.spline.boundary import sampled
from pathspace_graph.spline.bspline import BSpline

FIT_SIGMA: Final = 0.25  # standard deviation added to a cone's covariance, for slow errors of the sensor (m)
FIT_GATE: Final = 9.0  # cap of a cone's square (sigmas^2); beyond it, the cone lies on no other
VOTE_CELL: Final = 0.5  # cell size of the votes (m)
VOTE_TURN: Final = 0.05  # step of the headings (rad)
PLACES_APART: Final = 1.0  # least distance of two different places (m)
PLACES: Final = 10  # largest number of places for each heading, and a third of those refined
MATCHING: Final = 2.0
"""Expected square of a matching cone in 2D: the largest mean at a place, and cost of a cone out of view."""
FAILED: Final = 20.0  # largest cost of the distance from a prior: twice the log odds against its failure
FIT_LIMITS: Final = (FIT_SIGMA, FIT_GATE, VOTE_CELL, VOTE_TURN, PLACES_APART, float(PLACES), MATCHING, FAILED)
REACH: Final = (6.0, 0.2)  # largest distance and angle of a place from a pose on a path (m, rad)
MERGE_RANGE: Final = 16.0  # largest range of merged detections (m)
LOOKUP_RANGE: Final = 1.25 * MERGE_RANGE  # largest measured range of detections that may be merged (m)
PATH_STEP: Final = 2.0  # distance of neighbouring poses from which cones are seen, or a place is tried (m)
LINE_WEIGHT: Final = 0.25
"""Weight of a point of a line, merged to about 1 m: neighbours on a line say the same for 4 m."""

CURVE_SIGMA: Final = 0.12  # standard deviation added across a curve, which passes slow errors by (m)
CURVE_STEP: Final = 0.2  # step of the sampled curves (m)
BEGINNING: Final = 60.0  # length of open curves that counts as their beginning (m)
REGULAR: Final[Array] = np.diag([1e-2, 1e-2, 1.0])  # information without any curve (1/m^2, 1/m^2, 1/rad^2)

EVERYWHERE: Final[Array] = np.array([[0.0, 0.0, 0.0, inf, inf]])
"""View of a complete constellation."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Poses at which a vehicle may be, equally likely, each a Gaussian of the same covariance."""

    poses: Array  # (k, 3) map frame
    information: Array  # (3, 3) map frame
    reach: tuple[float, float] = REACH  # largest distance and angle from a pose that is tried (m, rad)
    failed: float = FAILED  # cost of the vehicle at none of them: twice the log odds against it
    along: Array | None = None  # (j, 3) poses that are tried, where `poses` is a single one

    @classmethod
    def about(
        cls,
        poses: Array,
        sigmas: tuple[float, float, float],
        reach: tuple[float, float] = REACH,
        failed: float = FAILED,
    ) -> Self:
        """Return a prior with standard deviations (m, m, rad)."""
        return cls(np.atleast_2d(poses), np.diag(np.array(sigmas) ** -2.0), reach, failed)

    @property
    def tried(self) -> Array:
        """Poses (j, 3) about which places are searched."""
        return self.poses if self.along is None else self.along

    @property
    def means(self) -> Array:
        """Means (j, 3) of the Gaussians at the poses that are tried."""
        return np.ascontiguousarray(np.broadcast_to(self.poses, self.tried.shape))


@dataclass(frozen=True, eq=False)
class Fits:
    """Poses at which seen cones fit on known ones, each by its n seen cones."""

    poses: Array  # (k, 3) map frame
    information: Array  # (k, 3, 3) of the pose, from the cones that lie on others, without the prior
    squares: Array  # (k,) sum of the capped squares of the cones in view of what is known
    counts: Array  # (k,) number of these cones
    away: Array  # (k,) squared Mahalanobis distance from the prior


@dataclass(frozen=True, eq=False)
class Constellation:
    """Cones in one frame, or points of lines."""

    points: Array  # (n, 2) in m
    covariances: Array  # (n, 2, 2) in m^2
    labels: IntArray  # (n,)
    views: Array = field(default_factory=EVERYWHERE.copy)
    """(k, 5) poses from which cones were detected, with range (m) and largest bearing (rad) of a view."""
    weight: float = 1.0  # weight of each cone or point in the sum of squares

    @classmethod
    def of(
        cls,
        table: DetectionColumns,
        poses: Array,
        settings: GrowthSettings,
        *,
        of_lines: bool = False,
    ) -> Self:
        """Merge detections, the most certain first, to cones in the map frame, by poses (P, 3) of cycles."""
        point = table.point
        rows = np.flatnonzero((table.label != UNKNOWN) & (np.hypot(*point.T) < MERGE_RANGE))
        rows = rows[np.argsort(np.trace(table.covariance[rows], axis1=1, axis2=2), kind="stable")]
        at = poses[table.cycle[rows]]
        points, covariances = se2.to_map(point[rows], at), se2.rotated(table.covariance[rows], at[:, 2])
        tracks = Tracks(settings.merge_radius, np.inf)
        tracks.add(points, covariances, table.label[rows], np.arange(len(rows), dtype=float))
        seen = np.concatenate([tracks.confirmed(label, settings.sightings) for label in BOUNDARIES])
        labels = tracks.votes[seen].argmax(axis=1)
        covariances = np.asarray(np.linalg.inv(tracks.information[seen]), np.float64)
        views = np.zeros((0, 5))
        if len(rows):
            polar = np.abs([np.hypot(*point[rows].T), np.arctan2(*point[rows].T[::-1])])
            limits, cycles = np.quantile(polar, 0.95, axis=1), np.unique(table.cycle)
            _, first = np.unique(se2.path_lengths(poses[cycles]) // PATH_STEP, return_index=True)
            views = np.column_stack([poses[cycles][first], np.tile(limits, (len(first), 1))])
        return cls(tracks.points[seen], covariances, labels, views, LINE_WEIGHT if of_lines else 1.0)

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def cones(self) -> tuple[Array, Array, IntArray]:
        return self.points, self.covariances, self.labels

    def seen_from(self, pose: Array) -> Self:
        """Transform the cones to the frame of a pose (3,)."""
        turned = se2.rotated(self.covariances, np.full(len(self), -pose[2]))
        return replace(self, points=se2.to_vehicle(self.points, pose[None]), covariances=turned)

    def relabelled(self, labels: Mapping[int, int]) -> Self:
        """Return the same cones with other labels."""
        return replace(self, labels=np.array([labels[label] for label in self.labels.tolist()], np.intp))

    def fits(self, seen: "Constellation", prior: Prior) -> Fits:
        """Fit cones seen in the vehicle frame on these, about each pose of a prior.

        All pairs of a seen and a known cone of one label vote for the pose that lays one on the other. The
        poses with most votes near the prior's are refined on a sum of capped squares.
        """
        searched = prior.tried, prior.means, prior.information, prior.reach
        return Fits(*kernels.laid(seen.cones, self.cones, self.views, *searched, FIT_LIMITS))


# --- known curves ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SampledCurves:
    """Known curves by label, `CURVE_STEP` apart, for lines and where no cones are known."""

    points: Mapping[int, Array]  # (n, 2) in m, map frame
    normals: Mapping[int, Array]  # (n, 2) unit normals
    trees: Mapping[int, KDTree]
    open: bool  # whether a point beyond an end is out of view

    @classmethod
    def of(cls, splines: Mapping[int, BSpline], ends: Mapping[int, float] | None = None) -> Self:
        """Sample curves, or the beginning of open ones with confirmed ends (m)."""
        points, normals = dict[int, Array](), dict[int, Array]()
        for label, spline in splines.items():
            low, high = spline.domain
            end = high if ends is None else min(high, beginning_of(ends[label]))
            u = np.linspace(low, end, max(int((end - low) / CURVE_STEP), 1) + 1)
            points[label], normals[label] = spline.evaluate(u), se2.left_of(spline.tangent_unit(u))
        trees = {label: KDTree(curve) for label, curve in points.items()}
        is_open = ends is not None or not all(spline.periodic for spline in splines.values())
        return cls(points, normals, trees, is_open)

    def relabelled(self, labels: Mapping[int, int]) -> Self:
        """Return the same curves with other labels."""
        points = {labels[label]: one for label, one in self.points.items()}
        normals = {labels[label]: one for label, one in self.normals.items()}
        trees = {labels[label]: one for label, one in self.trees.items()}
        return type(self)(points, normals, trees, self.open)

    def fits(self, seen: Constellation, prior: Prior) -> Fits:
        """Fit cones or points of lines, seen in the vehicle frame, on the curves from all poses of a prior.

        Iterated closest points minimize the sum of squares across the curves, with the prior.
        """
        poses, information = prior.tried, prior.information
        H = np.zeros((len(poses), 3, 3))
        for gate in (3.0, 2.0, 1.2, 0.7):  # largest distance from a curve, by iteration (m)
            off, jacobian, variance, inside = self._rows(seen, poses)
            weight = np.where(inside & (np.abs(off) < gate), seen.weight / variance, 0.0)
            transposed = np.swapaxes(jacobian * weight[..., None], 1, 2)
            H = transposed @ jacobian
            away = se2.difference(poses, prior.means)[..., None]
            step = np.linalg.solve(H + information, transposed @ off[..., None] + information @ away)
            poses = poses - step[..., 0]
        off, _, variance, inside = self._rows(seen, poses)
        squares = np.where(inside, np.minimum(off**2 / variance, FIT_GATE), 0.0).sum(axis=1)
        sums = seen.weight * squares, seen.weight * inside.sum(axis=1)
        away = se2.difference(poses, prior.means)
        return Fits(poses, H + REGULAR, *sums, np.einsum("pi,ij,pj->p", away, information, away))

    def _rows(self, seen: Constellation, poses: Array) -> tuple[Array, Array, Array, BoolArray]:
        """Return signed distances (p, n) across, their derivatives (p, n, 3) and variances (p, n).

        They are of seen cones (n,) from each of the poses (p, 3). The last result says which are in view.
        """
        shape = len(poses), len(seen)
        at, labels = np.repeat(poses, len(seen), axis=0), np.tile(seen.labels, len(poses))
        points = se2.to_map(np.tile(seen.points, (len(poses), 1)), at)
        covariances = se2.rotated(np.tile(seen.covariances, (len(poses), 1, 1)), at[:, 2])
        off, normal, inside = np.zeros(len(at)), np.zeros((len(at), 2)), np.zeros(len(at), bool)
        for label, tree in self.trees.items():
            own = np.flatnonzero(labels == label)
            if len(own) == 0:
                continue
            _, nearest = tree.query(points[own])
            normal[own] = self.normals[label][nearest]
            off[own] = ((points[own] - self.points[label][nearest]) * normal[own]).sum(axis=1)
            last = len(self.points[label]) - 1
            inside[own] = (not self.open) | ((nearest > 0) & (nearest < last))
        turning = (normal * se2.left_of(points - at[:, :2])).sum(axis=1)
        variance = np.einsum("mi,mij,mj->m", normal, covariances, normal) + CURVE_SIGMA**2
        jacobian = np.column_stack([normal, turning]).reshape(*shape, 3)
        return off.reshape(shape), jacobian, variance.reshape(shape), inside.reshape(shape)


def beginning_of(end: float) -> float:
    """Return the length (m) of the beginning of an open curve that is confirmed up to an end (m)."""
    return min(BEGINNING, 0.6 * end)


Known = Constellation | SampledCurves


# --- find the place of a vehicle on what is known, by hypotheses, fits and odds -------------------------

SURE_ODDS: Final = 7.0  # least log odds of a place where a wrong one costs the map: a thousand to one
LEAST_CONES: Final = 6  # least number of cones in view at a place
FITS_BY_CHANCE: Final = 0.55
"""Probability that a cone lies on some other by chance, at a wrong place where its neighbours do."""

MISFIT_OF_WAY: Final = 3.0  # largest rms distance of an aligned path from the way (m)
MOST_HYPOTHESES: Final = 16  # largest number of hypotheses, those of the best shape


@dataclass(frozen=True, eq=False)
class Place:
    """A pose on what is known."""

    pose: Array  # (3,) map frame
    information: Array  # (3, 3) of the pose, from what was seen
    odds: float  # log odds against every other place and against none of them; -inf if it does not fit


def find(seen: Constellation, known: Known, prior: Prior) -> Place | None:
    """Find the best place where cones or lines, seen in the vehicle frame, lie on known ones.

    The cost of a place is the sum of capped squares of what lies in view of the known there, plus the squared
    Mahalanobis distance from the prior, up to `FAILED`. What is out of view costs as much as at the next best
    place. So rows at regular distances, which fit in many places, count little. At none of them, the cones
    fit as well by chance, in any of the tries.
    """
    total = seen.weight * len(seen)
    if total < LEAST_CONES or len(prior.poses) == 0:
        return None
    fits = known.fits(seen, prior)
    misfit = fits.squares / np.maximum(fits.counts, 1.0)
    enough = fits.counts >= LEAST_CONES
    unseen = _best_of_others(np.where(enough, misfit, inf), fits.poses, MATCHING)
    out_of_view = unseen * (total - fits.counts)
    costs = fits.squares + out_of_view + np.minimum(fits.away, FAILED)
    best = int(costs.argmin())
    by_cone = min(2.0 * log(1.0 / FITS_BY_CHANCE), MATCHING - float(misfit[best]))
    by_chance = by_cone * float(fits.counts[best]) - 2.0 * log(len(prior.tried))
    none = float(fits.squares[best] + out_of_view[best]) + prior.failed + by_chance
    rival = min(_best_of_others(costs, fits.poses, inf), none)
    is_fit = enough[best] and misfit[best] <= MATCHING
    odds = 0.5 * (rival - float(costs[best])) if is_fit else -inf
    return Place(fits.poses[best], fits.information[best], odds)


def sure(place: Place | None) -> Place | None:
    """Return the place if its odds are `SURE_ODDS` or more."""
    return place if place is not None and place.odds >= SURE_ODDS else None


def _best_of_others(values: Array, poses: Array, limit: float) -> float:
    """Return the least value at another place than that of the least, up to a limit."""
    others = np.hypot(*(poses - poses[int(values.argmin())])[:, :2].T) > PLACES_APART
    return float(values[others].min(initial=limit))


# --- hypotheses by the shape of the path -------------------------------------------------------------------


def along(poses: Array, way: Array, is_closed: bool) -> Array:
    """Return the poses (k, 3) that the newest of poses (P, 3) has where the path aligns with a way (n, 2).

    The path p is aligned rigidly (Umeyama 1991) with each stretch q of the way, whose points are `PATH_STEP`
    apart. With both as complex numbers about their means, the turn is that of sum(p* q), and the sum of
    squared distances is sum |p|^2 + sum |q|^2 - 2 |sum(p* q)|. The best shape is first.
    """
    length = se2.path_lengths(poses)
    steps = min(int(length[-1] / PATH_STEP), len(way) - 1)
    at = length[-1] - PATH_STEP * np.arange(steps, -1, -1)
    x, y = (np.interp(at, length, axis) for axis in poses[:, :2].T)
    path, around = x + 1j * y, way @ np.array([1.0, 1j])
    if is_closed:
        around = np.concatenate([around[len(way) - steps :], around])
    stretches = sliding_window_view(around, steps + 1)
    mean, means = path.mean(), stretches.mean(axis=1)
    turn = stretches @ (path - mean).conj()
    spread = np.square(np.abs(stretches - means[:, None])).sum(axis=1)
    misfit = np.square(np.abs(path - mean)).sum() + spread - 2.0 * np.abs(turn)
    chosen = list[int]()
    for i in np.argsort(misfit, kind="stable").tolist():
        if misfit[i] > len(path) * MISFIT_OF_WAY**2 or len(chosen) == MOST_HYPOTHESES:
            break
        away = np.abs(np.array(chosen) - i)
        if is_closed:
            away = np.minimum(away, len(way) - away)
        if (away * PATH_STEP >= REACH[0]).all():
            chosen.append(i)
    heading = np.angle(turn[chosen])
    newest = np.exp(1j * heading) * (poses[-1, :2] @ np.array([1.0, 1j]) - mean) + means[chosen]
    return np.column_stack([newest.real, newest.imag, heading + poses[-1, 2]])


@dataclass(frozen=True, eq=False)
class KnownRoad:
    """A known road: what is seen on it, and the way along it."""

    seen: Known  # its cones, or its curves where it has none
    way: Array  # (n, 2) points of its middle in driving order, `PATH_STEP` apart
    closed: bool

    @classmethod
    def of(cls, splines: Mapping[int, BSpline], cones: Mapping[int, Array] | None = None) -> Self:
        """Lay out both curves of a map by label, and their cones (k, 2), parameters and sigmas (m).

        Cones count only if both curves have some.
        """
        seen: Known = SampledCurves.of(splines)
        if cones and all(len(cones.get(label, ())) for label in splines):
            points = [spline.evaluate(cones[label][:, 0]) for label, spline in splines.items()]
            labels = np.concatenate([np.full(len(cones[label]), label) for label in splines])
            variances = np.concatenate([cones[label][:, 1] ** 2 for label in splines])
            seen = Constellation(np.concatenate(points), variances[:, None, None] * np.eye(2), labels)
        first, other = (sampled(spline, CURVE_STEP) for spline in splines.values())
        middle = 0.5 * (first + other[KDTree(other).query(first)[1]])
        length = se2.path_lengths(middle)
        at = np.linspace(0.0, length[-1], max(round(length[-1] / PATH_STEP), 1) + 1)
        way = np.column_stack([np.interp(at, length, axis) for axis in middle.T])
        closed = all(spline.periodic for spline in splines.values())
        return cls(seen, way[:-1] if closed else way, closed)

    def along(self, poses: Array) -> Prior:
        """Return the prior of the newest of poses (P, 3), wherever the path fits by its shape."""
        sigmas = (3.0, 3.0, 0.2)  # m, m, rad, about a hypothesis
        return Prior.about(along(poses, self.way, self.closed), sigmas, failed=0.0)

    def backwards(self) -> Self:
        """Return the same road driven the other way, on which left is right."""
        other = {LEFT: RIGHT, RIGHT: LEFT}
        return replace(self, seen=self.seen.relabelled(other), way=self.way[::-1])


# --- what was seen lately, on an earlier pass of the drive or on a known road ---------------------------

NEWEST_PATH: Final = 30.0  # length of the newest path whose cones are laid on earlier ones (m)
NEWEST_PATHS: Final = NEWEST_PATH, 2.0 * NEWEST_PATH  # lengths that are tried (m); 120 m are not rigid enough
BEYOND: Final = 10.0  # length by which the earlier path exceeds the newest on each side (m)
NEARBY: Final = (1.0, 1.0, 0.05), (4.0, 0.15)
"""Sigmas (m, m, rad) and reach (m, rad) after laps were aligned, or beside another pass of an open road."""
STANDING: Final = 0.1  # path of one cycle of the earlier pass: a standing sensor repeats its errors (m)
STRETCH: Final = 60.0  # length of a path that shows its place by its shape, or crosses the start (m)
CLOSES_WITHIN: Final = 200.0  # length of the drive's beginning on which a lap of cones may close (m)

SeenIn = Callable[[IntArray], DetectionColumns]
"""The detections of ascending cycles (k,)."""


def seen_in(table: DetectionColumns) -> SeenIn:
    """Return the function that selects detections of a table by cycles."""
    return lambda cycles: table.where(np.flatnonzero(table.in_cycles(cycles)))


def return_to_beginning(
    seen_in: SeenIn,
    poses: Array,
    covariance: Array,
    settings: MapperSettings,
    curves: SampledCurves | None = None,
    lengths: Sequence[float] | None = None,
) -> Revisit | None:
    """Return the newest pose in the frame of one at the beginning of the drive, if its place is sure.

    `poses` (P, 3) are those of all cycles, and `covariance` (3, 3) is that of the newest. It is tried at the
    poses of the beginning that the covariance allows. Lines are laid on the beginning of `curves`; `lengths`
    are those of `newest_place`. The newest path must cross the start line: in each round of a skidpad the
    vehicle is on its beginning again, but has not closed a lap.
    """
    stations, least = se2.path_lengths(poses), settings.closing.min_path
    length = float(stations[-1])
    within, step = (BEGINNING, PATH_STEP) if settings.of_lines else (CLOSES_WITHIN, REACH[0])
    beginning = stations < min(length - least, within + BEYOND)
    if not beginning.any():
        return None
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    prior, tried = tried_along(poses[beginning], Prior(poses[-1:], information), step)
    if len(tried) == 0:
        return None
    if curves is None:
        place = newest_place(seen_in, poses, tried, prior, settings, lengths)
    else:
        place = sure(find(seen_lately(seen_in, poses, NEWEST_PATH, settings), curves, prior))
    earlier = None if place is None else beside(place, poses, beginning)
    if place is None or earlier is None or stations[earlier] > within:  # beyond, the right one may be untried
        return None
    newest = se2.to_vehicle(poses[stations > max(length - within - STRETCH, least), :2], poses[-1:])
    # crosses the line of the start, within 5 m of it and in its direction
    ahead, left = se2.to_vehicle(se2.to_map(newest, place.pose[None]), poses[:1]).T
    steps, forward = np.hypot(np.diff(ahead), np.diff(left)), np.diff(ahead)
    crosses = (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & (np.abs(left[1:]) < 5.0)
    crosses &= forward > np.cos(HEADING) * steps
    return revisit_of(place, poses, earlier, len(poses) - 1) if crosses.any() else None


def find_return(
    seen_in: SeenIn, poses: Array, last: float, settings: MapperSettings
) -> tuple[Place, int] | None:
    """Find the sure place of the newest cones on those of an earlier pass, and the cycle beside it.

    `poses` (P, 3) are those of all cycles up to the newest, whose place is nearby (`NEARBY`). The earlier
    pass ended at the path length `last` (m). None without a pass, too, and where the place is beside another
    road.
    """
    stations, newest = se2.path_lengths(poses), poses[-1]
    earlier = stations < last
    alike = earlier & (np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING))
    away = np.where(alike, np.hypot(*(poses[:, :2] - newest[:2]).T), np.inf)
    nearest = int(away.argmin())
    if not away[nearest] < NEARBY[1][0]:
        return None
    place = newest_place(seen_in, poses, np.array([nearest]), Prior.about(newest, *NEARBY), settings)
    at = None if place is None else beside(place, poses, earlier)
    return None if place is None or at is None else (place, at)


def beside(place: Place, poses: Array, earlier: BoolArray) -> int | None:
    """Return the earlier one of poses (P, 3) that a place is beside, if it is on the same road."""
    cycles = np.flatnonzero(earlier)
    offsets = se2.to_vehicle(place.pose[None, :2], poses[cycles])
    nearest = int(np.hypot(*offsets.T).argmin())
    turned = np.cos(place.pose[2] - poses[cycles[nearest], 2])
    is_same = abs(offsets[nearest, 1]) < 2.5 and turned > np.cos(HEADING)  # m across the road
    return int(cycles[nearest]) if is_same else None


def newest_place(
    seen_in: SeenIn,
    poses: Array,
    near: IntArray,
    prior: Prior,
    settings: MapperSettings,
    lengths: Sequence[float] | None = None,
) -> Place | None:
    """Return the sure place of the newest cones on those around earlier cycles (k,).

    The newest path has one of some `lengths` (m), by default of all `newest_paths`.
    """
    stations = se2.path_lengths(poses)
    around = stations[near.min()], stations[near.max()]
    for length in lengths or newest_paths(float(stations[-1])):
        seen = seen_lately(seen_in, poses, length, settings)
        least, most = around[0] - length - BEYOND, around[1] + length + BEYOND
        old = np.flatnonzero((stations > least) & (stations < min(most, stations[-1] - length)))
        old = old[np.unique(stations[old] // STANDING, return_index=True)[1]]
        place = sure(find(seen, Constellation.of(seen_in(old), poses, settings.growth), prior))
        if place is not None:
            return place
    return None


def newest_paths(driven: float) -> tuple[float, ...]:
    """Return the lengths (m) of the newest path whose cones are laid on earlier ones, after a drive (m).

    Where rows of cones are too regular, a longer stretch is laid, up to a tenth of the drive: the longer that
    is, the more places does its drift allow.
    """
    return tuple(length for length in NEWEST_PATHS if length <= max(0.1 * driven, NEWEST_PATH))


def seen_lately(seen_in: SeenIn, poses: Array, length: float, settings: MapperSettings) -> Constellation:
    """Return what was seen on the newest path of a length (m), in the frame of the newest of poses (P, 3)."""
    stations = se2.path_lengths(poses)
    cycles = np.flatnonzero(stations > stations[-1] - length)
    seen = Constellation.of(seen_in(cycles), poses, settings.growth, of_lines=settings.of_lines)
    return seen.seen_from(poses[-1])


def place_on(
    road: KnownRoad, seen_in: SeenIn, poses: Array, settings: MapperSettings, prior: Prior | None = None
) -> Place | None:
    """Find the newest of poses (P, 3) on a known road, by a prior or else by the shape of the path."""
    seen = seen_lately(seen_in, poses, STRETCH if settings.of_lines else NEWEST_PATH, settings)
    return find(seen, road.seen, road.along(poses) if prior is None else prior)


def tried_along(poses: Array, prior: Prior, step: float = PATH_STEP) -> tuple[Prior, IntArray]:
    """Return a prior about one pose that is tried at poses of a path (P, 3), too, where it allows them.

    These are about a step (m) apart, and those beside the pose are tried in any case. The second result is
    their indices (k,).
    """
    _, first = np.unique(se2.path_lengths(poses) // step, return_index=True)
    off = se2.difference(poses[first], prior.poses)
    possible = np.einsum("ki,ij,kj->k", off, prior.information, off) < FAILED
    possible |= (np.hypot(*off[:, :2].T) < REACH[0]) & (np.abs(off[:, 2]) < HEADING)
    tried = np.concatenate([prior.poses, prior.poses + off[possible]])
    return replace(prior, along=tried), np.asarray(first[possible], np.intp)


def revisit_of(place: Place, poses: Array, earlier: int, later: int) -> Revisit:
    """Return the pose of a `later` cycle in the frame of an `earlier` one, given the place of the newest.

    `poses` (P, 3) are those of all cycles. The drive is rigid from the later cycle to the newest, whose place
    has the information.
    """
    frame, moved = poses[earlier], se2.compose(place.pose, se2.relative(poses[-1], poses[later]))
    arm, change = moved[:2] - place.pose[:2], np.eye(3)
    change[:2, 2] = -arm[1], arm[0]
    change[:2] = se2.rotation(frame[2]).T @ change[:2]
    back = np.linalg.inv(change)
    root = np.linalg.cholesky(back.T @ place.information @ back).T
    return Revisit(earlier, later, se2.relative(frame, moved), np.asarray(root, np.float64))
