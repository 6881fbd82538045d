"""Placement of a drive on the map of others, by hypotheses along the road.

The driven path is aligned rigidly with the known road at each place, and the best places are refined by the
registration of detections. A place is accepted if nearly all detections lie on the curves there, the cones of
a stretch surely lie on known ones, and no other place is nearly as good.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, move_points, path_lengths, rotation
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.constellation import LAID_NEWEST, NEARBY, Constellation, lay, seen_in
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.registration import Motion, Registration, Sightings
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

PLACE_STEP: Final = 2.0  # distance of the places tried, and of the points of a path (m)
LEAST_DRIVEN: Final = 30.0  # least length of a drive (m)
LEAST_OF_LINE: Final = 150.0  # least length of a drive without cones that confirm the place (m)
STRETCH: Final = LAID_NEWEST  # length of a stretch of a drive whose cones confirm the place (m)
MISFIT: Final = 6.0  # largest rms distance of both paths at a place that is refined (m)
SHARE_MISFIT: Final = 0.02  # added to it, as a share of the length of the path
MOST_PLACES: Final = 12  # largest number of places that are refined
APART: Final = 6.0  # largest distance of the drive's first pose in two hypotheses of one place (m)
DETECTIONS: Final = 800  # largest number of registered detections, evenly chosen
SIGMAS_PLACE: Final = (3.0, 3.0, 0.1)  # of the motion at a place before its refinement (m, m, rad)
REFINEMENTS: Final = 2  # number of consecutive registrations
SIGMA_FIT: Final = 0.5  # a detection at a distance d from its curve scores `exp(-d^2 / (2 SIGMA_FIT^2))` (m)
MIN_SCORE: Final = 0.6  # least score of a place
MARGIN: Final = 0.1  # least lead of the best score over every other place

FIRST_SEEN: Final = 60.0  # length of the first path, whose cones determine the place on an open road (m)
ABOUT_START: Final = (15.0, 0.3)  # largest distance between the starts of drives of an open road (m, rad)
SIGMAS_START: Final = (5.0, 2.0, 0.1)  # standard deviations of that distance (m, m, rad)

OTHER_TRACK: Final = "it fits nowhere on the map of the other drives"
OTHER_WAY: Final = "it goes the other way round"
TWO_PLACES: Final = "it fits in two places of the map of the other drives"
OTHER_START: Final = "its cones do not determine where it begins on the open road of the other drives"


class NotPlacedError(Exception):
    """A drive has no sure place on the map; the message says why."""


@dataclass(frozen=True, eq=False)
class Driven:
    """A drive that was solved alone: curves, poses, and the detections on the curves."""

    state: State
    detections: DetectionTable
    settings: MapperSettings

    @cached_property
    def driven(self) -> Array:
        """Length (m) of the path to each pose (P,)."""
        return path_lengths(self.state.poses)

    def cones(self, begin: float = 0.0, end: float = np.inf) -> Constellation:
        """Return the cones detected on a stretch of the drive (m), in its frame."""
        cycles = np.flatnonzero((self.driven >= begin) & (self.driven < end))
        table = seen_in(self.detections.cones(self.settings.of_lines))(cycles)
        return Constellation.of(table, self.state.poses, self.settings.growth)

    @cached_property
    def all_cones(self) -> Constellation:
        """Cones of the whole drive."""
        return self.cones()


@dataclass(frozen=True, eq=False)
class Place:
    """A motion of a drive onto the known map."""

    score: float  # 0 to 1
    motion: Array  # (3,) from the frame of the drive to that of the map


def find_place(known: Driven, drive: Driven) -> Array:
    """Find the motion (3,) of a drive onto a known one; NotPlacedError if none is sure.

    Hypotheses along an open road are ambiguous, so both drives must begin at about the same place there.
    """
    least = LEAST_OF_LINE if drive.settings.of_lines else LEAST_DRIVEN
    if drive.driven[-1] < least:
        raise NotPlacedError(f"it is shorter than {least:g} m")
    seen = sightings(drive)
    places = _around(known, drive, seen) if known.state.closed else _about_start(known, drive, seen)
    if not drive.settings.of_lines:
        places = [place for place in places if cones_agree(known, drive, place.motion)]
    if not places:
        raise NotPlacedError(OTHER_TRACK)
    best, first = places[0], drive.state.poses[:1, :2]
    begins = [move_points(place.motion, first)[0] for place in places]
    rivals = [p.score for p, at in zip(places, begins, strict=True) if np.hypot(*(at - begins[0])) > APART]
    if max(rivals, default=0.0) > best.score - MARGIN:
        raise NotPlacedError(TWO_PLACES)
    return best.motion


def _around(known: Driven, drive: Driven, seen: Sightings) -> list[Place]:
    """Find the places around a closed map where a drive fits, the best first."""
    loop = way_around(known.state)
    way = resampled(drive.state.poses[:, :2], min(float(drive.driven[-1]), PLACE_STEP * len(loop)))
    places = _places(known.state, seen, beside(loop, way), drive.settings)
    if places:
        return places
    other_side = replace(seen, labels=LEFT + RIGHT - seen.labels)
    backwards = _places(known.state, other_side, beside(loop[::-1], way), drive.settings)
    raise NotPlacedError(OTHER_WAY if backwards else OTHER_TRACK)


def _about_start(known: Driven, drive: Driven, seen: Sightings) -> list[Place]:
    """Find the place where the first cones of a drive lie on those of a known one."""
    first, others = drive.cones(0.0, FIRST_SEEN), known.cones(0.0, FIRST_SEEN + ABOUT_START[0])
    laid = lay(first, others, np.zeros(3), np.diag(np.array(SIGMAS_START) ** -2), ABOUT_START)
    if laid is None or not laid.is_sure:
        raise NotPlacedError(OTHER_START)
    places = _places(known.state, seen, [laid.pose], drive.settings)
    if not places:
        raise NotPlacedError(OTHER_TRACK)
    return places


def cones_agree(known: Driven, drive: Driven, motion: Array) -> bool:
    """Whether the cones of a stretch of a drive, after a motion (3,), surely lie on known ones.

    A short path fits on many roads; its cones do not.
    """
    for begin in np.arange(0.0, max(float(drive.driven[-1]) - 0.5 * STRETCH, 1.0), STRETCH).tolist():
        pose = drive.state.poses[drive.driven.searchsorted(begin)]
        seen = drive.cones(begin, begin + STRETCH).seen_from(pose)
        reach = NEARBY.radius, NEARBY.turn
        laid = lay(seen, known.all_cones, compose(motion, pose), NEARBY.information, reach)
        if laid is not None and laid.is_sure:
            return True
    return False


def way_around(known: State) -> Array:
    """Points (n, 2), `PLACE_STEP` apart, of the first lap around a closed map."""
    label = next(iter(known.boundaries))
    part = known.drives.longest(len(known.poses))
    pose_u = known.pose_u[label][part]
    lap = pose_u - pose_u[0] < known.boundaries[label].length
    around = known.poses[part][lap, :2]
    around = np.concatenate([around, around[:1]])
    return resampled(around, float(path_lengths(around)[-1]))[:-1]


def resampled(path: Array, length: float) -> Array:
    """Points of the first `length` (m) of a path (n, 2), at most `PLACE_STEP` apart."""
    driven = path_lengths(path)
    at = np.linspace(0.0, length, int(np.ceil(length / PLACE_STEP)) + 1)
    return np.column_stack([np.interp(at, driven, axis) for axis in path.T])


def beside(loop: Array, way: Array) -> list[Array]:
    """Motions (3,) that align a path (m, 2) with a loop (n, 2) where it fits best, the best first."""
    path, around = way @ np.array([1.0, 1j]), loop @ np.array([1.0, 1j])
    places = (np.arange(len(loop))[:, None] + np.arange(len(way))) % len(loop)
    target = around[places]
    mean, means = path.mean(), target.mean(axis=1)
    turn = ((path - mean).conj() * (target - means[:, None])).sum(axis=1)
    turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
    off = np.abs(turn[:, None] * (path - mean) - (target - means[:, None]))
    misfit = np.sqrt((off**2).mean(axis=1))
    shift = means - turn * mean
    motions, chosen = np.column_stack([shift.real, shift.imag, np.angle(turn)]), list[int]()
    most, begins = MISFIT + SHARE_MISFIT * PLACE_STEP * len(way), turn * path[0] + shift
    for i in np.argsort(misfit).tolist():
        if misfit[i] > most or len(chosen) == MOST_PLACES:
            break
        if (np.abs(begins[chosen] - begins[i]) > APART).all():
            chosen.append(i)
    return list(motions[chosen])


def sightings(drive: Driven) -> Sightings:
    """Detections on the curves of their own drive, in its frame."""
    detections = drive.detections
    rows = np.flatnonzero(detections.used & np.isin(detections.boundary, BOUNDARIES))
    rows = rows[:: max(-(-len(rows) // DETECTIONS), 1)]
    points = detections.points_map(rows, drive.state.variables)
    return Sightings.of_points(rows, detections.boundary[rows], points)


def _places(known: State, seen: Sightings, motions: Sequence[Array], settings: MapperSettings) -> list[Place]:
    """Register detections from motions (3,); return the places on the curves, the best first."""
    kept = np.isin(seen.labels, list(known.boundaries))
    if not kept.any():
        return []
    seen = Sightings.of_points(seen.rows[kept], seen.labels[kept], seen.points[kept])
    places = [_registered(known, seen, motion, settings) for motion in motions]
    return sorted((place for place in places if place.score >= MIN_SCORE), key=lambda place: -place.score)


def _registered(known: State, seen: Sightings, motion: Array, settings: MapperSettings) -> Place:
    centre, prior = seen.points.mean(axis=0), np.diag(np.array(SIGMAS_PLACE) ** -2)
    vector = np.append(move_points(motion, centre[None])[0] - centre, motion[2])
    stretches = {label: (b.tables.low, b.tables.high) for label, b in known.boundaries.items()}
    registration = Registration(known, seen, stretches, settings.closing)
    for _ in range(REFINEMENTS):
        vector = registration.refine(Motion(centre, vector), vector, prior).motion.vector
    distance = _distances(known, seen.labels, Motion(centre, vector).apply(seen.points))
    shift = centre + vector[:2] - rotation(float(vector[2])) @ centre
    score = float(np.exp(-0.5 * (distance / SIGMA_FIT) ** 2).mean())
    return Place(score, np.append(shift, vector[2]))


def _distances(known: State, labels: IntArray, points: Array) -> Array:
    """Distance (m,) of points (m, 2) from the curves of their labels."""
    distance = np.full(len(points), np.inf)
    for label, boundary in known.boundaries.items():
        own = labels == label
        foot = boundary.find_anywhere(known.control_points(label), points[own])
        distance[own] = np.hypot(*(points[own] - foot.position).T)
    return distance
