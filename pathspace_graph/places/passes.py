"""Passes of a drive: the newest cones on those of an earlier pass, as a relative pose of two cycles."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
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

from .constellation import Constellation, Prior, SampledCurves
from .find import Place, find, sure

NEWEST_PATH: Final = 30.0  # length of the newest path whose cones are laid on earlier ones (m)
BEYOND: Final = 10.0  # length by which the earlier path exceeds the newest on each side (m)
NEARBY: Final = (1.0, 1.0, 0.05), (4.0, 0.15)
"""Sigmas (m, m, rad) and reach (m, rad) after laps were aligned, or beside another pass of an open road."""
LAP_BEGINNING: Final = 40.0  # length of the beginning of a drive, on which a lap closes (m)
LAP_NEWEST: Final = 60.0  # length of the newest path, which crosses the start if a lap closes (m)
LAP_TURNED: Final = 0.3  # largest error of the heading after a lap (rad)
START_LATERAL: Final = 5.0  # largest distance from the start at which its line is crossed to close a loop (m)
START_HEADING: Final = 0.5  # largest angle between the heading at the start and that crossing (rad)
START_STEP: Final = 2.0  # step of the poses of the beginning at which lines are tried (m)
START_CHI2: Final = 16.3  # largest squared Mahalanobis distance of these: 99.9 % of chi-square, 3 degrees
SAME_ROAD: Final = 2.5  # largest distance of two passes of one road, across it (m)
SAME_HEADING: Final = 0.5  # largest angle between two passes of one road (rad)

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

    `poses` (P, 3) are those of all cycles, and `covariance` (3, 3) is that of the newest. Lines are laid on
    the beginning of `curves`. The newest path must cross the start line: in each round of a skidpad the
    vehicle is on its beginning again, but has not closed a lap.
    """
    stations, closing = path_lengths(poses), settings.closing
    length = float(stations[-1])
    last = min(length - closing.min_path, LAP_BEGINNING)
    reach = closing.radius_after(length), LAP_TURNED
    prior = Prior(poses[-1:], np.asarray(np.linalg.inv(covariance), np.float64), reach)
    found = find_return(seen_in, poses, last, prior, settings, curves)
    if found is None:
        return None
    place, earlier = found
    newest = to_vehicle(poses[stations > length - LAP_NEWEST, :2], poses[-1:])
    crosses = crosses_start(to_map(newest, place.pose[None]), poses[0])
    return revisit_of(place, poses, earlier, len(poses) - 1) if crosses else None


def find_return(
    seen_in: SeenIn,
    poses: Array,
    last: float,
    prior: Prior,
    settings: MapperSettings,
    curves: SampledCurves | None = None,
) -> tuple[Place, int] | None:
    """Find the sure place of the newest cones on those of an earlier pass, and the cycle beside it.

    `poses` (P, 3) are those of all cycles up to the newest, about which the prior is. The earlier pass ended
    at the path length `last` (m). None without a pass, too, and where the place is beside another road.
    """
    earlier, newest = path_lengths(poses) < last, poses[-1]
    alike = earlier & (np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING))
    away = np.where(alike, np.hypot(*(poses[:, :2] - newest[:2]).T), np.inf)
    nearest = int(away.argmin())
    if not away[nearest] < prior.reach[0]:
        return None
    place = newest_place(seen_in, poses, nearest, prior, settings, curves)
    if place is None:
        return None
    beside = to_vehicle(place.pose[None, :2], poses[earlier])
    at = int(np.hypot(*beside.T).argmin())
    turned = np.cos(place.pose[2] - poses[at, 2])
    return (place, at) if abs(beside[at, 1]) < SAME_ROAD and turned > np.cos(SAME_HEADING) else None


def newest_place(
    seen_in: SeenIn,
    poses: Array,
    nearest: int,
    prior: Prior,
    settings: MapperSettings,
    curves: SampledCurves | None = None,
) -> Place | None:
    """Return the sure place of the newest cones on those around a cycle, or of lines on curves."""
    stations = path_lengths(poses)
    first = int(stations.searchsorted(stations[-1] - NEWEST_PATH, side="right"))
    newest = np.arange(first, len(poses))
    growth, of_lines = settings.growth, settings.of_lines
    seen = Constellation.of(seen_in(newest), poses, growth, of_lines=of_lines).seen_from(poses[-1])
    if curves is None:
        old = np.flatnonzero(np.abs(stations[:first] - stations[nearest]) < NEWEST_PATH + BEYOND)
        places = find(seen, Constellation.of(seen_in(old), poses, growth), prior)
    else:
        places = find(seen, curves, tried_along(poses[:first], prior))
    return sure(places)


def tried_along(poses: Array, prior: Prior) -> Prior:
    """Return a prior about one pose that is tried at those of a path (P, 3), too, where it allows them."""
    _, first = np.unique(path_lengths(poses) // START_STEP, return_index=True)
    off = np.concatenate([np.zeros((1, 3)), difference(poses[first], prior.poses)])
    possible = np.einsum("ki,ij,kj->k", off, prior.information, off) < START_CHI2
    return replace(prior, starts=prior.poses + off[possible])


def crosses_start(path: Array, start: Array) -> bool:
    """Whether a path (n, 2) crosses the line of a start (3,), in its direction."""
    ahead, left = to_vehicle(path, start[None]).T
    steps, forward = np.hypot(np.diff(ahead), np.diff(left)), np.diff(ahead)
    crosses = (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & (np.abs(left[1:]) < START_LATERAL)
    return bool((crosses & (forward > np.cos(START_HEADING) * steps)).any())


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
