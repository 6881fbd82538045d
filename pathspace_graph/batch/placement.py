"""Placement of a drive on the map of others, by the cones or lines of one of its stretches."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.places.constellation import Constellation, Prior
from pathspace_graph.places.find import KnownRoad, find, sure
from pathspace_graph.places.passes import seen_in
from pathspace_graph.settings.mapper import MapperSettings

LEAST_DRIVEN: Final = 30.0  # least length of a drive (m)
PLACED_STRETCH: Final = 60.0  # length of a stretch of a drive that determines its place (m)
FROM_START: Final = 60.0  # length of the first path, whose cones determine the place on an open road (m)
ABOUT_START: Final = (5.0, 2.0, 0.1), (15.0, 0.3)
"""Sigmas (m, m, rad) and largest distance (m, rad) of the starts of two drives of an open road."""

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

    def seen(self, begin: float = 0.0, end: float = np.inf) -> Constellation:
        """Return the cones or points of lines detected on a stretch of the drive (m), in its frame."""
        cycles = np.flatnonzero((self.driven >= begin) & (self.driven <= end))
        table, of_lines = seen_in(self.detections)(cycles), self.settings.of_lines
        return Constellation.of(table, self.state.poses, self.settings.growth, of_lines=of_lines)

    @cached_property
    def road(self) -> KnownRoad:
        """The drive's map as a known road."""
        road = KnownRoad.of(self.state.splines)
        return road if self.settings.of_lines else replace(road, seen=self.seen())


def find_place(known: Driven, drive: Driven) -> Array:
    """Find the motion (3,) of a drive onto a known one; NotPlacedError if none is sure.

    Hypotheses along an open road are ambiguous, so both drives must begin at about the same place there.
    """
    if drive.driven[-1] < LEAST_DRIVEN:
        raise NotPlacedError(f"it is shorter than {LEAST_DRIVEN:g} m")
    if not known.state.closed:
        places = find(drive.seen(0.0, FROM_START), known.road.seen, Prior.about(np.zeros(3), *ABOUT_START))
        if (place := sure(places)) is None:
            raise NotPlacedError(OTHER_START)
        return place.pose
    motion, found = _by_stretches(known.road, drive)
    if motion is not None:
        return motion
    backwards, _ = _by_stretches(known.road.backwards(), drive)
    if backwards is not None:
        raise NotPlacedError(OTHER_WAY)
    raise NotPlacedError(TWO_PLACES if found else OTHER_TRACK)


def _by_stretches(road: KnownRoad, drive: Driven) -> tuple[Array | None, bool]:
    """Return the motion of the first stretch with a sure place, and whether one fits anywhere."""
    fits, ends = False, np.arange(PLACED_STRETCH, float(drive.driven[-1]) + PLACED_STRETCH, PLACED_STRETCH)
    for end in np.minimum(ends, drive.driven[-1]).tolist():
        within = (drive.driven >= end - PLACED_STRETCH) & (drive.driven <= end)
        poses = drive.state.poses[within]
        seen = drive.seen(end - PLACED_STRETCH, end).seen_from(poses[-1])
        places = find(seen, road.seen, road.along(poses))
        if (place := sure(places)) is not None:
            return compose(place.pose, inverse(poses[-1])), True
        fits |= bool(places) and places[0].odds > -np.inf
    return None, fits
