"""Constellations: the newest cones, merged and without identity, are laid on earlier ones.

All pairs of a new and an earlier cone of one label vote for the motion that lays one on the other. The places
with most votes near the prediction of odometry are refined on a sum of capped squares. The cheapest place is
sure if nearly all cones that the earlier path would have seen lie on its cones, and no rival costs nearly as
little. Cones stand at regular distances, so a few of them fit in many places. Rivals are the other places,
the prediction itself, where the vehicle may not be back yet, and new road after a failure of odometry. A sure
place is a relative pose of two cycles, the measurement of every return.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Final, Self

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import (
    compose,
    path_lengths,
    relative,
    rotated,
    rotation,
    to_map,
    to_vehicle,
)
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import ClosingSettings, GrowthSettings

from .detections import DetectionColumns
from .registration import HEADING, start_crossings
from .tentative import merged_in_turn

LAID_SIGMA: Final = 0.25  # standard deviation added to a cone's covariance, for slow errors of the sensor (m)
LAID_GATE: Final = 9.0  # cap of a cone's square (sigmas^2); beyond it, the cone lies on no other
CELL: Final = 0.5  # cell size of the votes (m)
TURN: Final = 0.05  # step of the headings (rad)
LAID_APART: Final = 1.0  # least distance of two different places (m)
PLACES: Final = 10  # largest number of places for each heading, and a third of those refined
RANGE: Final = 16.0  # largest range of merged detections (m)
VIEWED: Final = 0.95  # share of the detections within the range and the bearing of a view
VIEWS: Final = 2.0  # distance of the views along a path (m)
LAID_NEWEST: Final = 30.0  # length of the newest path whose cones are laid on earlier ones (m)
BEYOND: Final = 10.0  # length by which the earlier path exceeds the newest on each side (m)
LAID_CONES: Final = 6  # least number of cones in view for a sure place
LAID_MISFIT: Final = 2.0  # largest mean capped square of these: the expectation of matching cones in 2D
UNSEEN: Final = 2.0  # largest cost of a cone out of view: the expectation of a matching one
ODOMETRY_FAILED: Final = 20.0  # cost of a failure of odometry: twice the log odds against it
LAID_ODDS: Final = 14.0  # least difference of cost to the next place: odds of a thousand
LAID_SIGHTINGS: Final = 3  # least number of detections of a cone
LAP_BEGINNING: Final = 40.0  # length of the beginning of a drive, on which a lap closes (m)
LAP_NEWEST: Final = 60.0  # length of the newest path, which crosses the start if a lap closes (m)
LAP_TURNED: Final = 0.3  # largest error of the heading after a lap (rad)
SAME_ROAD: Final = 2.5  # largest distance of two passes of one road, across it (m)
SAME_HEADING: Final = 0.5  # largest angle between two passes of one road (rad)
LIMITS: Final = (LAID_SIGMA, LAID_GATE, CELL, TURN, LAID_APART, float(PLACES), UNSEEN, ODOMETRY_FAILED)


Cones = tuple[Array, Array, IntArray]
"""Points (n, 2), covariances (n, 2, 2) and labels (n,) of cones."""
NO_CONES: Final[Cones] = (np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.intp))
EVERYWHERE: Final[Array] = np.array([[0.0, 0.0, 0.0, inf, inf]])
"""View of a complete constellation."""


@dataclass(frozen=True, eq=False)
class Constellation:
    """Cones in one frame."""

    points: Array  # (n, 2) in m
    covariances: Array  # (n, 2, 2) in m^2
    labels: IntArray  # (n,)
    views: Array = field(default_factory=EVERYWHERE.copy)
    """(k, 5) poses from which cones were detected, with range (m) and largest bearing (rad) of a view."""

    @classmethod
    def of(cls, table: DetectionColumns, poses: Array, settings: GrowthSettings) -> Self:
        """Merge detections, the most certain first, to cones in the map frame, by poses (P, 3) of cycles."""
        point = table.point
        rows = np.flatnonzero((table.label != UNKNOWN) & (np.hypot(*point.T) < RANGE))
        rows = rows[np.argsort(np.trace(table.covariance[rows], axis1=1, axis2=2), kind="stable")]
        at = poses[table.cycle[rows]]
        points, covariances = to_map(point[rows], at), rotated(table.covariance[rows], at[:, 2])
        labels, found = table.label[rows], [NO_CONES]
        for label in np.unique(labels).tolist():
            own = labels == label
            places, information, counts = merged_in_turn(points[own], covariances[own], settings)
            seen = counts >= LAID_SIGHTINGS
            covariance = np.asarray(np.linalg.inv(information[seen]), np.float64)
            found.append((places[seen], covariance, np.full(len(covariance), label)))
        places, covariances, labels = (np.concatenate(column) for column in zip(*found, strict=True))
        return cls(places, covariances, labels, _views(poses[np.unique(table.cycle)], point[rows]))

    @property
    def cones(self) -> Cones:
        return self.points, self.covariances, self.labels

    def seen_from(self, pose: Array) -> "Constellation":
        """Transform the cones to the frame of a pose (3,)."""
        turned = rotated(self.covariances, np.full(len(self.labels), -pose[2]))
        return Constellation(to_vehicle(self.points, pose[None]), turned, self.labels)


@dataclass(frozen=True, eq=False)
class Laid:
    """Pose that lays cones in its frame on earlier ones."""

    pose: Array  # (3,) map frame
    information: Array  # (3, 3) of the pose, from the cones that lie on others
    count: int  # number of cones in view of the earlier path
    misfit: float  # mean capped square of these
    odds: float  # difference of cost to the next place

    @property
    def is_sure(self) -> bool:
        """Whether nearly all of enough cones lie on earlier ones, and no other place is nearly as good."""
        return self.count >= LAID_CONES and self.misfit <= LAID_MISFIT and self.odds >= LAID_ODDS


def lay(
    seen: Constellation, known: Constellation, mean: Array, information: Array, reach: tuple[float, float]
) -> Laid | None:
    """Lay cones in the vehicle frame on known ones in the map frame; None if there are too few of them.

    The pose is searched within a `reach` (m, rad) of its `mean` (3,). Its squared Mahalanobis distance from
    the mean, with `information` (3, 3), counts up to `ODOMETRY_FAILED`.
    """
    if min(len(seen.labels), len(known.labels)) < LAID_CONES:
        return None
    places = kernels.laid(seen.cones, known.cones, known.views, mean, information, reach, LIMITS)
    return _best(*places, len(seen.labels))


def _best(poses: Array, informations: Array, squares: Array, counts: Array, away: Array, total: int) -> Laid:
    """Return the best of the places of `_kernels:laid`, for a total number of cones.

    A cone out of view costs as much as a cone of the next best place with enough cones in view. So rows at
    regular distances, which fit in many places, count little.
    """
    misfit = squares / np.maximum(counts, 1.0)
    enough = np.where(counts >= LAID_CONES, misfit, inf)
    _, unseen = _best_and_next(enough, poses, UNSEEN)
    costs = squares + unseen * (total - counts) + np.minimum(away, ODOMETRY_FAILED)
    best, rival = _best_and_next(costs, poses, ODOMETRY_FAILED + unseen * total)  # the limit is new road
    odds = float(rival - costs[best])
    return Laid(poses[best], informations[best], int(counts[best]), float(misfit[best]), odds)


def _best_and_next(values: Array, poses: Array, limit: float) -> tuple[int, float]:
    """Return the index of the least value, and the least value of another place, up to a limit."""
    best = int(values.argmin())
    others = np.hypot(*(poses[:, :2] - poses[best, :2]).T) > LAID_APART
    return best, float(values[others].min(initial=limit))


def _views(poses: Array, points: Array) -> Array:
    """Views (k, 5) from poses (P, 3), `VIEWS` apart, with the limits of the detections (m, 2)."""
    if len(points) == 0:
        return np.zeros((0, 5))
    far, wide = np.quantile(np.abs([np.hypot(*points.T), np.arctan2(*points.T[::-1])]), VIEWED, axis=1)
    _, first = np.unique(path_lengths(poses) // VIEWS, return_index=True)
    return np.column_stack([poses[first], np.tile([far, wide], (len(first), 1))])


# --- passes of a drive -----------------------------------------------------------------------------------

SeenIn = Callable[[IntArray], DetectionColumns]
"""The detections of ascending cycles (k,)."""


def seen_in(table: DetectionColumns) -> SeenIn:
    """Return the function that selects detections of a table by cycles."""
    return lambda cycles: table.where(np.flatnonzero(table.in_cycles(cycles)))


@dataclass(frozen=True, eq=False)
class Expected:
    """Prior of the newest pose beside an earlier pass, centred on its estimate."""

    radius: float  # largest distance (m)
    turn: float  # largest angle (rad)
    information: Array  # (3, 3) of the newest pose, map frame

    @classmethod
    def within(cls, radius: float, turn: float, sigmas: tuple[float, float, float]) -> Self:
        """Expect a pose with standard deviations (m, m, rad)."""
        return cls(radius, turn, np.diag(np.array(sigmas) ** -2.0))

    @classmethod
    def after(cls, length: float, covariance: Array, closing: ClosingSettings) -> Self:
        """Expect a pose with a covariance (3, 3) after drift over a length (m)."""
        information = np.asarray(np.linalg.inv(covariance), np.float64)
        return cls(closing.radius + closing.drift * length, LAP_TURNED, information)


NEARBY: Final = Expected.within(4.0, 0.15, (1.0, 1.0, 0.05))
"""Prior after laps were aligned, or beside another pass of an open road."""


def return_to_beginning(
    seen_in: SeenIn, poses: Array, covariance: Array, settings: MapperSettings
) -> Revisit | None:
    """Return the newest pose in the frame of one at the beginning of the drive, if its place is sure.

    `poses` (P, 3) are those of all cycles, and `covariance` (3, 3) is that of the newest. The newest path
    must cross the start line: in each round of a skidpad the vehicle is on its beginning again, but has not
    closed a lap.
    """
    stations, closing = path_lengths(poses), settings.closing
    length = float(stations[-1])
    last = min(length - closing.min_path, LAP_BEGINNING)
    expected = Expected.after(length, covariance, closing)
    found = find_return(seen_in, poses, last, expected, settings.growth)
    if found is None or not found[0].is_sure:
        return None
    laid, earlier = found
    newest = to_vehicle(poses[stations > length - LAP_NEWEST, :2], poses[-1:])
    crosses, _ = start_crossings(to_map(newest, laid.pose[None]), poses[0])
    return revisit_of(laid, poses, earlier, len(poses) - 1) if crosses.any() else None


def find_return(
    seen_in: SeenIn, poses: Array, last: float, expected: Expected, settings: GrowthSettings
) -> tuple[Laid, int] | None:
    """Lay the newest cones on those of an earlier pass; return the result and the cycle beside it.

    `poses` (P, 3) are those of all cycles up to the newest. The earlier pass ended at the path length `last`
    (m). None if there is no pass, the cones are too few, or they lie beside another road.
    """
    earlier, newest = path_lengths(poses) < last, poses[-1]
    alike = earlier & (np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING))
    away = np.where(alike, np.hypot(*(poses[:, :2] - newest[:2]).T), np.inf)
    place = int(away.argmin())
    if not away[place] < expected.radius:
        return None
    laid = lay_newest(seen_in, poses, place, expected, settings)
    if laid is None:
        return None
    beside = to_vehicle(laid.pose[None, :2], poses[earlier])
    at = int(np.hypot(*beside.T).argmin())
    same_road = abs(beside[at, 1]) < SAME_ROAD and np.cos(laid.pose[2] - poses[at, 2]) > np.cos(SAME_HEADING)
    return (laid, at) if same_road else None


def lay_newest(
    seen_in: SeenIn, poses: Array, place: int, expected: Expected, settings: GrowthSettings
) -> Laid | None:
    """Lay the cones of the newest metres on those around an earlier place, given the poses (P, 3) of all."""
    stations = path_lengths(poses)
    first = int(stations.searchsorted(stations[-1] - LAID_NEWEST, side="right"))
    old = np.flatnonzero(np.abs(stations[:first] - stations[place]) < LAID_NEWEST + BEYOND)
    known = Constellation.of(seen_in(old), poses, settings)
    seen = Constellation.of(seen_in(np.arange(first, len(poses))), poses, settings).seen_from(poses[-1])
    return lay(seen, known, poses[-1], expected.information, (expected.radius, expected.turn))


def revisit_of(laid: Laid, poses: Array, earlier: int, later: int) -> Revisit:
    """Return the pose of a `later` cycle in the frame of an `earlier` one, given the place of the newest.

    `poses` (P, 3) are those of all cycles. The drive is rigid from the later cycle to the newest.
    """
    moved = compose(laid.pose, relative(poses[-1], poses[later]))
    return relative_pose((earlier, poses[earlier]), (later, moved), laid.pose, laid.information)


def relative_pose(
    earlier: tuple[int, Array], later: tuple[int, Array], centre: Array, information: Array
) -> Revisit:
    """Return the pose of a later cycle in the frame of an earlier one, each given with its pose (3,).

    `information` (3, 3) is that of a pose at `centre` (3,), map frame, to which the later pose is fixed.
    """
    (first, frame), (last, pose) = earlier, later
    arm, change = pose[:2] - centre[:2], np.eye(3)
    change[:2, 2] = -arm[1], arm[0]
    change[:2] = rotation(frame[2]).T @ change[:2]
    back = np.linalg.inv(change)
    root = np.linalg.cholesky(back.T @ information @ back).T
    return Revisit(first, last, relative(frame, pose), np.asarray(root, np.float64))
