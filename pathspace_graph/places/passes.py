"""What was seen lately, on an earlier pass of the drive or on a known road."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import (
    compose,
    difference,
    path_lengths,
    relative,
    rotation,
    to_map,
    to_vehicle,
)
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.path import HEADING
from pathspace_graph.settings.mapper import MapperSettings

from .constellation import BEGINNING, FAILED, PATH_STEP, REACH, Constellation, Prior, SampledCurves
from .find import KnownRoad, Place, find, sure

NEWEST_PATH: Final = 30.0  # length of the newest path whose cones are laid on earlier ones (m)
NEWEST_PATHS: Final = NEWEST_PATH, 2.0 * NEWEST_PATH  # lengths that are tried (m); 120 m are not rigid enough
LONGEST_SHARE: Final = 0.1  # largest share of the drive in such a length
BEYOND: Final = 10.0  # length by which the earlier path exceeds the newest on each side (m)
NEARBY: Final = (1.0, 1.0, 0.05), (4.0, 0.15)
"""Sigmas (m, m, rad) and reach (m, rad) after laps were aligned, or beside another pass of an open road."""
STRETCH: Final = 60.0  # length of a path that shows its place by its shape, or crosses the start (m)
CLOSES_WITHIN: Final = 200.0  # length of the drive's beginning on which a lap of cones may close (m)
START_LATERAL: Final = 5.0  # largest distance from the start at which its line is crossed to close a loop (m)
SAME_ROAD: Final = 2.5  # largest distance of two passes of one road, across it (m)

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
) -> Revisit | None:
    """Return the newest pose in the frame of one at the beginning of the drive, if its place is sure.

    `poses` (P, 3) are those of all cycles, and `covariance` (3, 3) is that of the newest. It is tried at the
    poses of the beginning that the covariance allows. Lines are laid on the beginning of `curves`. The newest
    path must cross the start line: in each round of a skidpad the vehicle is on its beginning again, but has
    not closed a lap.
    """
    stations, least = path_lengths(poses), settings.closing.min_path
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
        place = newest_place(seen_in, poses, tried, prior, settings)
    else:
        place = sure(find(seen_lately(seen_in, poses, NEWEST_PATH, settings), curves, prior))
    earlier = None if place is None else beside(place, poses, beginning)
    if place is None or earlier is None or stations[earlier] > within:  # beyond, the right one may be untried
        return None
    newest = to_vehicle(poses[stations > max(length - within - STRETCH, least), :2], poses[-1:])
    crosses = crosses_start(to_map(newest, place.pose[None]), poses[0])
    return revisit_of(place, poses, earlier, len(poses) - 1) if crosses else None


def find_return(
    seen_in: SeenIn, poses: Array, last: float, settings: MapperSettings
) -> tuple[Place, int] | None:
    """Find the sure place of the newest cones on those of an earlier pass, and the cycle beside it.

    `poses` (P, 3) are those of all cycles up to the newest, whose place is nearby (`NEARBY`). The earlier
    pass ended at the path length `last` (m). None without a pass, too, and where the place is beside another
    road.
    """
    stations, newest = path_lengths(poses), poses[-1]
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
    offsets = to_vehicle(place.pose[None, :2], poses[cycles])
    nearest = int(np.hypot(*offsets.T).argmin())
    turned = np.cos(place.pose[2] - poses[cycles[nearest], 2])
    is_same = abs(offsets[nearest, 1]) < SAME_ROAD and turned > np.cos(HEADING)
    return int(cycles[nearest]) if is_same else None


def newest_place(
    seen_in: SeenIn,
    poses: Array,
    near: IntArray,
    prior: Prior,
    settings: MapperSettings,
) -> Place | None:
    """Return the sure place of the newest cones on those around earlier cycles (k,).

    Where rows of cones are too regular, a longer stretch of the newest path is laid, up to a tenth of the
    drive: the longer that is, the more places does its drift allow.
    """
    stations = path_lengths(poses)
    around = stations[near.min()], stations[near.max()]
    for length in NEWEST_PATHS:
        if length > max(LONGEST_SHARE * stations[-1], NEWEST_PATH):
            break
        seen = seen_lately(seen_in, poses, length, settings)
        least, most = around[0] - length - BEYOND, around[1] + length + BEYOND
        old = np.flatnonzero((stations > least) & (stations < min(most, stations[-1] - length)))
        place = sure(find(seen, Constellation.of(seen_in(old), poses, settings.growth), prior))
        if place is not None:
            return place
    return None


def seen_lately(seen_in: SeenIn, poses: Array, length: float, settings: MapperSettings) -> Constellation:
    """Return what was seen on the newest path of a length (m), in the frame of the newest of poses (P, 3)."""
    stations = path_lengths(poses)
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
    _, first = np.unique(path_lengths(poses) // step, return_index=True)
    off = difference(poses[first], prior.poses)
    possible = np.einsum("ki,ij,kj->k", off, prior.information, off) < FAILED
    possible |= (np.hypot(*off[:, :2].T) < REACH[0]) & (np.abs(off[:, 2]) < HEADING)
    tried = np.concatenate([prior.poses, prior.poses + off[possible]])
    return replace(prior, along=tried), np.asarray(first[possible], np.intp)


def crosses_start(path: Array, start: Array) -> bool:
    """Whether a path (n, 2) crosses the line of a start (3,), in its direction."""
    ahead, left = to_vehicle(path, start[None]).T
    steps, forward = np.hypot(np.diff(ahead), np.diff(left)), np.diff(ahead)
    crosses = (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & (np.abs(left[1:]) < START_LATERAL)
    return bool((crosses & (forward > np.cos(HEADING) * steps)).any())


def revisit_of(place: Place, poses: Array, earlier: int, later: int) -> Revisit:
    """Return the pose of a `later` cycle in the frame of an `earlier` one, given the place of the newest.

    `poses` (P, 3) are those of all cycles. The drive is rigid from the later cycle to the newest, whose place
    has the information.
    """
    frame, moved = poses[earlier], compose(place.pose, relative(poses[-1], poses[later]))
    arm, change = moved[:2] - place.pose[:2], np.eye(3)
    change[:2, 2] = -arm[1], arm[0]
    change[:2] = rotation(frame[2]).T @ change[:2]
    back = np.linalg.inv(change)
    root = np.linalg.cholesky(back.T @ place.information @ back).T
    return Revisit(earlier, later, relative(frame, moved), np.asarray(root, np.float64))
