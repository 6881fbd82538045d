"""Pairs of nearby cycles, and motions: cones stand still, so a right one lays detections on each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import se2_exp, wrap_angle
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.settings.plausibility import PlausibilitySettings

SEEN: Final = 0.95
"""This share of the detections is nearer than the range, and between the bearings, that a cycle sees."""
ROUND: Final = 0.1
"""A sensor sees all around if the mean of the directions to its detections is shorter than this."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Holds pairs of cycles, whose detections are in the frame of the log; what is not there is NaN."""

    begin: Array
    """(P,) These are the stamps of the earlier cycles (s)."""
    end: Array
    """(P,) These are the stamps of the later cycles (s)."""
    before: Array
    """(P, m, 2) These are the detections of the earlier cycles."""
    after: Array
    """(P, m, 2) These are the detections of the later cycles."""
    variances: Array
    """(P, m, m) These are the variances of one coordinate of each difference of two detections (m^2)."""
    gap: IntArray
    """(P,) The later cycle comes this number of cycles after the earlier one."""
    reach: float
    """A detection explains another one at distance d with the weight `exp(-d^2 / 2 reach^2)`."""

    def __len__(self) -> int:
        return len(self.begin)

    def distances(self, frame: Array, motion: Array) -> Array:
        """Returns the squared distances (P, m, m) of earlier from later detections, laid on them by a motion.

        frame (2, 2) leads from the frame of the log to the vehicle's, and motion (P, 3) from the later to the
        earlier vehicle frame. Where there is no detection the distance is infinite.
        """
        laid = self.laid(frame, motion)
        off = (self.before @ frame.T)[:, :, None] - laid[:, None]
        square = np.einsum("pijk,pijk->pij", off, off)
        return np.where(np.isnan(square), np.inf, square)

    def laid(self, frame: Array, motion: Array) -> Array:
        """Returns the later detections (P, m, 2) in the earlier vehicle frame."""
        c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
        turn = np.stack([c, s, -s, c], axis=-1).reshape(-1, 2, 2)  # the transpose, for points in rows
        return np.asarray((self.after @ frame.T) @ turn + motion[:, None, :2])

    def explained(self, frame: Array, motion: Array) -> Array:
        """Returns the share (P,) of the detections of both cycles that lie on one of the other cycle."""
        weights = np.exp(self.distances(frame, motion) / (-2.0 * self.reach**2))
        total = weights.max(axis=2).sum(axis=1) + weights.max(axis=1).sum(axis=1)
        return np.asarray(total / np.maximum(self.count, 1))

    def chosen(self, rows: BoolArray) -> Pairs:
        """Returns the pairs (P,) that are flagged."""
        return replace(
            self,
            begin=self.begin[rows],
            end=self.end[rows],
            before=self.before[rows],
            after=self.after[rows],
            variances=self.variances[rows],
            gap=self.gap[rows],
        )

    def overlap(self, motion: Array) -> Array:
        """Returns the share (P,) of the later detections that the earlier cycle could have seen.

        What a cycle sees is told from all detections: up to which range, and to both sides of which bearing.
        """
        ranges, bearings = _polar(self.before)
        vector = np.nanmean(np.exp(1j * bearings))
        middle = float(np.angle(vector)) if abs(vector) > ROUND else 0.0
        farthest = np.nanquantile(ranges, SEEN)
        widest = np.nanquantile(np.abs(wrap_angle(bearings - middle)), SEEN)
        ranges, bearings = _polar(self.laid(np.eye(2), motion))
        inside = (ranges < farthest) & (np.abs(wrap_angle(bearings - middle)) < widest)
        return np.asarray(inside.sum(axis=1) / np.isfinite(ranges).sum(axis=1))

    @property
    def count(self) -> IntArray:
        """Returns the number (P,) of detections of both cycles."""
        return np.asarray(
            np.isfinite(self.before[..., 0]).sum(axis=1) + np.isfinite(self.after[..., 0]).sum(axis=1)
        )


def pairs_of(cycles: Sequence[Detections], settings: PlausibilitySettings) -> Pairs | None:
    """Returns pairs of cycles that are spread over a log, or None where there are none with detections."""
    full = [cycle for cycle in cycles if len(cycle.labels) >= settings.min_detections]
    spacing = spacing_of(full[:: max(1, len(full) // settings.cycles)])
    if spacing is None:
        return None
    stamps = np.array([cycle.t for cycle in full])
    firsts, seconds, gaps = [], [], []
    shortest = float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
    for gap in settings.gaps:
        later = np.arange(gap, len(full))
        near = stamps[later] - stamps[later - gap] <= max(settings.longest, 1.5 * shortest)
        later = later[near]
        chosen = later[:: max(1, len(later) // settings.pairs)]
        firsts.append(chosen - gap)
        seconds.append(chosen)
        gaps.append(np.full(len(chosen), gap))
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    if len(first) == 0:
        return None
    points, variances = padded(full, settings.most_detections)
    return Pairs(
        stamps[first],
        stamps[second],
        points[first],
        points[second],
        variances[first][:, :, None] + variances[second][:, None],
        np.concatenate(gaps),
        settings.reach * spacing,
    )


def padded(cycles: Sequence[Detections], most: int) -> tuple[Array, Array]:
    """Returns the detections of each cycle (C, m, 2), at most so many that are nearest, and the variances of
    one coordinate of each (C, m); both are filled with NaN."""
    points = np.full((len(cycles), most, 2), np.nan)
    variances = np.full((len(cycles), most), np.nan)
    for k, cycle in enumerate(cycles):
        nearest = np.argsort(np.hypot(*cycle.points_vehicle.T), kind="stable")[:most]
        points[k, : len(nearest)] = cycle.points_vehicle[nearest]
        variances[k, : len(nearest)] = 0.5 * np.trace(cycle.covariances[nearest], axis1=1, axis2=2)
    return points, variances


def spacing_of(cycles: Sequence[Detections]) -> float | None:
    """Returns the median distance from a detection to the next one of its cycle, or None without any."""
    found = []
    for cycle in cycles:
        points = cycle.points_vehicle
        off = points[:, None] - points
        square = (off * off).sum(axis=-1)
        np.fill_diagonal(square, np.inf)
        found.append(np.sqrt(square.min(axis=1)))
    return float(np.median(np.concatenate(found))) if found else None


def _polar(points: Array) -> tuple[Array, Array]:
    """Returns the ranges and the bearings (P, m) of points (P, m, 2)."""
    return np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])


# --- the motion of the vehicle, by what the columns of the odometry may mean -----------------------------

Content = Literal["twist", "twist in the map frame", "pose", "nothing"]
"""The columns of the odometry hold this; with `nothing` the vehicle does not move at all."""

DEGREE: Final = float(np.pi / 180.0)
"""This is a degree in radians."""


@dataclass(frozen=True)
class Meaning:
    """Says what the columns of the odometry mean."""

    speed: float = 1.0
    """The unit of the speeds is this in m/s."""
    rate: float = 1.0
    """The unit of the yaw rate is this in rad/s."""
    content: Content = "twist"
    """The columns hold a twist of the vehicle, one in the axes of the map, or a pose."""

    def poses(self, odometry: Odometry) -> Array:
        """Returns the poses (N, 3) at the stamps, in a frame of their own; theta is not wrapped."""
        measured = odometry.twist * [self.speed, self.speed, self.rate]
        if self.content == "pose":
            return np.column_stack([measured[:, :2], np.unwrap(measured[:, 2])])
        if self.content == "nothing":
            return np.zeros_like(measured)
        dt = np.diff(odometry.t)[:, None]
        heading = np.append(0.0, np.cumsum(measured[:-1, 2:] * dt))
        if self.content == "twist":
            steps = _turned(se2_exp(measured[:-1] * dt)[:, :2], heading[:-1])
        else:
            steps = measured[:-1, :2] * dt
        return np.column_stack([np.cumsum(np.vstack([np.zeros(2), steps]), axis=0), heading])


def motions(odometry_t: Array, poses: Array, begin: Array, end: Array) -> Array:
    """Returns the motions (P, 3) between stamps (P,), each in the frame of its beginning.

    Between the stamps (N,) of the poses (N, 3) the motion is even.
    """
    first, last = _at(odometry_t, poses, begin), _at(odometry_t, poses, end)
    moved = _turned(last[:, :2] - first[:, :2], -first[:, 2])
    return np.column_stack([moved, last[:, 2] - first[:, 2]])


def _at(odometry_t: Array, poses: Array, stamps: Array) -> Array:
    """Returns the poses (P, 3) at stamps (P,) by linear interpolation; beyond the ends they are held."""
    return np.column_stack([np.interp(stamps, odometry_t, column) for column in poses.T])


def _turned(vectors: Array, angles: Array) -> Array:
    """Returns vectors (n, 2), each turned by its angle (n,)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])
