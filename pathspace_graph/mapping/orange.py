"""Orange cones: points of the map that belong to no boundary."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import inf
from typing import Final, Self

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, rotated, to_map
from pathspace_graph.factors.sensor import corrected
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.settings.online import GrowthSettings

from .tentative import TentativeTracks

PASS_RADIUS: Final = 0.4  # radius of the tracks of a pass, as a share of the merge radius: gates have pairs
STAYING: Final = 0.05  # share of a detection's variance that no number of detections averages out
SAME_CHI: Final = 2.5  # largest distance of two tracks of one cone, in sigmas of both together
SELDOM: Final = 0.4  # share of common cycles below which two tracks count as detected alone
PLACE: Final = 3.0  # distance around a cone in which only the best pass places cones (m)


@dataclass(frozen=True, eq=False)
class Sighting:
    """Orange cones as they were detected in one cycle."""

    cycle: int
    pose: Array  # (3,) pose of the vehicle, map frame
    twist: Array  # (3,) twist of the vehicle (m/s, m/s, rad/s)
    detections: Detections  # detections of orange cones only

    def placed_by(self, known: Sequence[tuple[int, Array]]) -> Self:
        """Take the pose from arrays of poses (P, 3), each with its first cycle; the last one wins."""
        poses = [poses[self.cycle - first] for first, poses in known if 0 <= self.cycle - first < len(poses)]
        return replace(self, pose=poses[-1].copy()) if poses else self


class OrangeCones:
    """Orange cones as points of the map. They belong to no boundary and do not constrain the vehicle pose.

    Each pass has tracks of its own, since the vehicle pose drifts between passes. Tracks of one cone are
    merged after the pass. At each place, the pass with most detections determines the cones.
    """

    MOST: Final = 500  # number of stored cycles, which are placed again when poses are corrected

    def __init__(self, settings: GrowthSettings, sigma: float) -> None:
        """Take the settings of merging, and a standard deviation (m) that is added to every cone."""
        self._settings, self._sigma = settings, sigma
        self._sightings: tuple[Sighting, ...] = ()
        self._passes: dict[int, tuple[_Pass, ...]] = {}  # by label, in order

    def copy(self) -> Self:
        """Return an independent copy; no attribute is changed in place."""
        return shallow(self)

    def add(self, sighting: Sighting, sensor: Array) -> None:
        """Add the detections of a cycle; `sensor` is the calibration of the sensor, (5,) or (0,)."""
        if len(sighting.detections.labels):
            self._sightings = (*self._sightings[1 - self.MOST :], sighting)
            self._place(sighting, sensor)

    def place_again(self, sensor: Array, *known: tuple[int, Array]) -> None:
        """Place all detections again by arrays of poses (P, 3), each with its first cycle; the last wins."""
        self._passes = {}
        self._sightings = tuple(one.placed_by(known) for one in self._sightings)
        for one in self._sightings:
            self._place(one, sensor)

    def move(self, motion: Array) -> None:
        """Move all cones by a rigid motion (3,) of the map frame."""
        self._sightings = tuple(replace(one, pose=compose(motion, one.pose)) for one in self._sightings)
        moved = {label: tuple(one.moved(motion) for one in passes) for label, passes in self._passes.items()}
        self._passes = moved

    def points(self) -> dict[int, PointBoundary]:
        """Return the cones that were detected often enough, by label."""
        found = {}
        for label, passes in sorted(self._passes.items()):
            cones = _best([one.cones() for one in passes], self._settings.sigma)
            if cones:
                blocks = [cone.covariance + self._sigma**2 * np.eye(2) for cone in cones]
                found[label] = PointBoundary(np.array([cone.place for cone in cones]), block_diag(*blocks))
        return found

    def _place(self, sighting: Sighting, sensor: Array) -> None:
        seen, pose, count = sighting.detections, sighting.pose, len(sighting.detections.labels)
        points = corrected(seen.points_vehicle, np.tile(sighting.twist, (count, 1)), sensor)
        covariances = rotated(seen.covariances, np.full(count, pose[2]))
        places = to_map(points, pose[None])
        for label in np.unique(seen.labels).tolist():
            own = seen.labels == label
            *earlier, present = self._passes_at(label, seen.t)
            present = present.with_detections(places[own], covariances[own], seen.t)
            self._passes = {**self._passes, label: (*earlier, present)}

    def _passes_at(self, label: int, t: float) -> tuple["_Pass", ...]:
        """Return the passes up to the present one, which is new if no cone was seen for a while."""
        passes, settings = self._passes.get(label, ()), self._settings
        if passes and t - passes[-1].tracks.last_t.max() <= settings.forget_after:
            return passes
        radius = PASS_RADIUS * settings.merge_radius
        return (*passes, _Pass(TentativeTracks(replace(settings, forget_after=inf, merge_radius=radius))))


@dataclass(frozen=True, eq=False)
class _Pass:
    """Tracks of one label in one pass; immutable."""

    tracks: TentativeTracks
    together: IntArray = field(default_factory=lambda: np.zeros((0, 0), np.intp))
    """(n, n) Number of cycles in which two tracks were detected together."""

    def with_detections(self, points: Array, covariances: Array, t: float) -> "_Pass":
        """Add detections (m, 2) with covariances (m, 2, 2), seen at t (s)."""
        tracks = self.tracks.copy()
        tracks.add(points, covariances, t)
        new, seen = len(tracks.last_t) - len(self.together), tracks.last_t == t
        return _Pass(tracks, np.pad(self.together, ((0, new), (0, new))) + np.outer(seen, seen))

    def moved(self, motion: Array) -> "_Pass":
        tracks = self.tracks.copy()
        tracks.move(motion)
        return replace(self, tracks=tracks)

    def cones(self) -> list["_Cone"]:
        """Confirmed tracks, merged while two of them may be one cone."""
        tracks, known = self.tracks, self.tracks.confirmed()
        rows = zip(
            tracks.points[known], tracks.information[known], tracks.counts[known].tolist(), strict=True
        )
        cones, together = [_Cone(*row) for row in rows], self.together[np.ix_(known, known)]
        while len(cones) > 1:
            pairs = list(combinations(range(len(cones)), 2))
            apart = [cones[a].apart(cones[b], _alone(together, a, b)) for a, b in pairs]
            if min(apart) > SAME_CHI**2:
                break
            a, b = pairs[int(np.argmin(apart))]
            cones[a] = cones[a].merged(cones.pop(b))
            for axis in (0, 1):
                np.moveaxis(together, axis, 0)[a] += np.moveaxis(together, axis, 0)[b]
                together = np.delete(together, b, axis)
        return cones


def _alone(together: IntArray, a: int, b: int) -> bool:
    """Whether two tracks were seldom detected in one cycle, unlike two cones."""
    return bool(together[a, b] < SELDOM * min(together[a, a], together[b, b]))


@dataclass(frozen=True, eq=False)
class _Cone:
    place: Array  # (2,) in m, map frame
    information: Array  # (2, 2) sum of the inverse covariances of its detections (1/m^2)
    count: int  # number of detections

    @property
    def single(self) -> Array:
        """Covariance (2, 2) of one detection (m^2)."""
        return np.asarray(self.count * np.linalg.inv(self.information), np.float64)

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the place (m^2), in which a part of each detection's error remains."""
        return (1.0 / self.count + STAYING) * self.single

    def apart(self, other: "_Cone", alone: bool) -> float:
        """Squared distance of two tracks in sigmas; `alone`, in sigmas of a single detection."""
        off = self.place - other.place
        joint = self.single + other.single if alone else self.covariance + other.covariance
        return float(off @ np.linalg.solve(joint, off))

    def merged(self, other: "_Cone") -> "_Cone":
        information = self.information + other.information
        vector = self.information @ self.place + other.information @ other.place
        place = np.asarray(np.linalg.solve(information, vector), np.float64)
        return _Cone(place, information, self.count + other.count)


def _best(passes: Sequence[Sequence[_Cone]], sigma: float) -> list[_Cone]:
    """Return the cones known to `sigma` (m), at each place from the pass with most detections."""
    found: list[_Cone] = []
    for cones in sorted(passes, key=lambda cones: -sum(cone.count for cone in cones)):
        before = np.array([cone.place for cone in found]).reshape(-1, 2)
        for cone in cones:
            is_new = (np.hypot(*(before - cone.place).T) > PLACE).all()
            if is_new and np.linalg.eigvalsh(cone.covariance)[-1] < sigma**2:
                found.append(cone)
    return found
