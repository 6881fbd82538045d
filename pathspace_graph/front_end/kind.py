"""The kind of a sensor: whether detections stay where they are, as cones do, or lie anywhere along a line.

The nearest detections of a cycle are laid on an earlier one by odometry. Cones find themselves there, within
their noise. Points of a line find a neighbour: at distances that are spread evenly over half the gap between
points, whatever the gap.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.se2 import compose, move_points, relative
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, Kind
from pathspace_graph.run import split_odometry
from pathspace_graph.scale import nearest_cones, side_of
from pathspace_graph.settings.mapper import MapperSettings

KIND_COMPARED: Final = 2  # nearest detections of a side that are compared: noise grows with the range
PARTNERS: Final = 10  # nearest detections of an earlier cycle among which each of them has its partner
MOVED: Final = 0.25  # least way between both cycles, over the gap: at rest a line is seen at the same places
KIND_LONGEST: Final = 1.5  # longest time between them (s), over which odometry hardly drifts
PATIENCE: Final = 120.0  # time (s) after which the kind is what it is by then
MOST_AWAY: Final = 1.5  # largest distance that counts, over half the gap
FEWEST: Final = 80  # comparisons from which clear ones are enough; the median of a line has a sigma of 0.08
KIND_CLEAR: Final = 0.2, 0.5  # median distances over half the gap, below and above which they are clear
ENOUGH: Final = 300  # comparisons that tell: 0.1 to 0.27 was met for cones, 0.46 to 1.2 for lines
KIND_CONES: Final = 0.32  # median distance over half the gap up to which they are cones
LINE: Final = 0.4  # from which on they are points of a line; between, it cannot be told
ON_LINE: Final = 2.2  # median distance (sigmas) across the line up to which points are on it, not garbled
LEAST_SIGMA: Final = 1e-3  # least standard deviation of that distance (m)
_OF_LINES: Final[dict[tuple[int, ...], Kind]] = {
    (): "cones",
    (LEFT,): "line-left",
    (RIGHT,): "line-right",
    (LEFT, RIGHT): "line",
}


class SideKind:
    """Judge of one side of the road, which sees its detections cycle by cycle."""

    def __init__(self) -> None:
        self._gaps: list[float] = []
        self._away: list[float] = []  # distances from the partners, over half the gap
        self._across: list[float] = []  # distances from the line through the partners (sigmas)
        self._past: list[tuple[float, Array, Array]] = []  # stamp, pose (3,) and points (k, 2) of cycles

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other._gaps, other._away, other._across = self._gaps[:], self._away[:], self._across[:]
        other._past = self._past[:]
        return other

    def see(self, t: float, pose: Array, points: Array, sigmas: Array) -> None:
        """Compare points (k, 2) of a cycle with those of an earlier one.

        They are in the vehicle frame, the nearest first, with standard deviations (k,) of a coordinate (m).
        """
        self._past = [one for one in self._past if one[0] >= t - KIND_LONGEST]
        if len(points) > 1:
            self._gaps.append(float(np.median(_from_nearest(points[:KIND_COMPARED], points))))
            gap = float(np.median(self._gaps))
            self._compare(pose, points[:KIND_COMPARED], sigmas[:KIND_COMPARED], gap)
            self._past.append((t, pose, points))

    def _compare(self, pose: Array, points: Array, sigmas: Array, gap: float) -> None:
        for _, earlier, partners in reversed(self._past):
            way = relative(earlier, pose)
            if np.hypot(way[0], way[1]) < MOVED * gap:
                continue
            placed = move_points(way, points)
            seen = np.hypot(*placed.T) < np.hypot(*partners[-1])
            away = np.hypot(*(placed[seen, None] - partners).transpose(2, 0, 1)).min(axis=1)
            self._away += np.minimum(away / (0.5 * gap), MOST_AWAY).tolist()
            across = _from_line(placed[seen], partners) / np.maximum(2.0**0.5 * sigmas[seen], LEAST_SIGMA)
            self._across += across.tolist()
            return

    @property
    def is_final(self) -> bool:
        count = len(self._away)
        if count < FEWEST or count >= ENOUGH:
            return count >= ENOUGH
        return not KIND_CLEAR[0] < float(np.median(self._away)) < KIND_CLEAR[1]

    @property
    def is_line(self) -> bool | None:
        """Whether they are points of a line; None where that cannot be told."""
        if not self.is_final:
            return None
        away, across = float(np.median(self._away)), float(np.median(self._across))
        if away < KIND_CONES:
            return False
        return True if away > LINE and across < ON_LINE else None


def _from_nearest(points: Array, others: Array) -> Array:
    """Return the distance (m,) of each point (m, 2) from the nearest other one of (k, 2), m <= k."""
    distances = np.hypot(*(points[:, None] - others).transpose(2, 0, 1))
    distances[np.arange(len(points)), np.arange(len(points))] = np.inf
    return np.asarray(distances.min(axis=1))


def _from_line(points: Array, corners: Array) -> Array:
    """Return the distance (m,) of each point (m, 2) from the line through corners (k, 2), at least two."""
    begin, step = corners[:-1], np.diff(corners, axis=0)
    off = points[:, None] - begin
    share = np.clip((off * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
    return np.asarray(np.hypot(*(off - share[..., None] * step).transpose(2, 0, 1)).min(axis=1))


class KindJudge:
    """Judge of both sides of the road."""

    def __init__(self) -> None:
        self._sides: Mapping[int, SideKind] = {label: SideKind() for label in BOUNDARIES}
        self._pose: Array = np.zeros(3)
        self._lasted, self._begun = 0.0, np.nan  # time since the first cycle, and its stamp (s)

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other._sides = {label: side.copy() for label, side in self._sides.items()}
        return other

    def see(self, odometry: Odometry, detections: Detections) -> None:
        """See a cycle and the twists since the one before."""
        if len(odometry.t):
            held = np.diff(np.append(odometry.t, detections.t))
            self._pose = compose(self._pose, integrate_twists(held, odometry.twist, np.zeros(3)).delta)
        self._begun = detections.t if np.isnan(self._begun) else self._begun
        self._lasted = detections.t - self._begun
        side = side_of(detections)
        for label, judge in self._sides.items():
            if not judge.is_final:
                own = np.flatnonzero(side == label)
                points, covariances = detections.points_vehicle[own], detections.covariances[own]
                near = nearest_cones(points, covariances, PARTNERS)
                sigmas = np.sqrt(0.5 * np.trace(covariances[near], axis1=1, axis2=2))
                judge.see(detections.t, self._pose, points[near], sigmas)

    @property
    def is_final(self) -> bool:
        return self._lasted > PATIENCE or all(judge.is_final for judge in self._sides.values())

    @property
    def kind(self) -> Kind | None:
        """Kind by both sides, where one that cannot be told is as the other; None where neither can be."""
        lines = {label: judge.is_line for label, judge in self._sides.items()}
        known = [line for line in lines.values() if line is not None]
        if not known:
            return None
        return _OF_LINES[
            tuple(label for label, line in lines.items() if (known[0] if line is None else line))
        ]


@lru_cache(maxsize=1)  # several ask about the log that was read last
def kind_of(log: Log) -> Kind | None:
    """Kind of a log's sensor, as the log states it or by its first seconds; None where neither tells it."""
    if log.sensor.kind:
        return log.sensor.kind
    judge = KindJudge()
    for odometry, detections in split_odometry(log):
        judge.see(odometry, detections)
        if judge.is_final:
            break
    return judge.kind


def with_kind(settings: MapperSettings, log: Log) -> MapperSettings:
    """Return settings with the kind of a log's sensor where they leave it open.

    Lines have no stations.
    """
    settings = replace(settings, kind=settings.kind or kind_of(log))
    return replace(settings, stations=False) if settings.lines else settings
