"""Pairs of nearby cycles, and motions: cones stand still, so a right one lays detections on each other."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import wrap_angle
from pathspace_graph.io.log import Detections

MIN_DETECTIONS: Final = 2  # least number of detections of a cycle that is compared
MOST_DETECTIONS: Final = 14  # most detections of a cycle that are compared, the nearest ones
SOME_CYCLES: Final = 200  # approximate number of cycles from which the spacing of the cones is told
GAPS: Final = (1, 2, 4, 8)  # numbers of cycles between the two that are compared
PAIRS_OF_GAP: Final = 60  # approximate number of pairs of cycles that are compared for each of the gaps
LONGEST: Final = 1.3  # longest time between the cycles of a pair (s), if cycles do not come more rarely
REACH: Final = 0.2  # distance that counts as the same by `exp(-1/2)`, over the cones' spacing
SEEN: Final = 0.95  # share of the detections within the range, and between the bearings, that a cycle sees
ROUND: Final = 0.1  # length of the mean direction to the detections below which a sensor sees all around


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of cycles, whose detections are in the frame of the log; what is not there is NaN."""

    begin: Array  # stamps (P,) of the earlier cycles (s)
    end: Array  # stamps (P,) of the later cycles (s)
    before: Array  # detections (P, m, 2) of the earlier cycles (m)
    after: Array  # detections (P, m, 2) of the later cycles (m)
    variances: Array  # variances (P, m, m) of one coordinate of each difference of two detections (m^2)
    gap: IntArray  # number (P,) of cycles from the earlier to the later one
    reach: float  # a detection explains another one at distance d with the weight `exp(-d^2 / 2 reach^2)`

    def __len__(self) -> int:
        return len(self.begin)

    def distances(self, frame: Array, motion: Array) -> Array:
        """Return the squared distances (P, m, m) of earlier from later detections, infinite without any.

        frame (2, 2) leads from the log's frame to the vehicle's, motion (P, 3) from the later to the earlier.
        """
        laid = self.laid(frame, motion)
        off = (self.before @ frame.T)[:, :, None] - laid[:, None]
        square = np.einsum("pijk,pijk->pij", off, off)
        return np.where(np.isnan(square), np.inf, square)

    def laid(self, frame: Array, motion: Array) -> Array:
        """Return the later detections (P, m, 2) in the earlier vehicle frame."""
        c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
        turn = np.stack([c, s, -s, c], axis=-1).reshape(-1, 2, 2)  # the transpose, for points in rows
        return np.asarray((self.after @ frame.T) @ turn + motion[:, None, :2])

    def explained(self, frame: Array, motion: Array) -> Array:
        """Return the share (P,) of the detections of both cycles that lie on one of the other cycle."""
        weights = np.exp(self.distances(frame, motion) / (-2.0 * self.reach**2))
        total = weights.max(axis=2).sum(axis=1) + weights.max(axis=1).sum(axis=1)
        return np.asarray(total / np.maximum(self.count, 1))

    def chosen(self, rows: BoolArray) -> Self:
        arrays = {name: value[rows] for name, value in vars(self).items() if name != "reach"}
        return replace(self, **arrays)

    def overlap(self, motion: Array) -> Array:
        """Return the share (P,) of the later detections that the earlier cycle could have seen."""
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
        before, after = (np.isfinite(points[..., 0]).sum(axis=1) for points in (self.before, self.after))
        return np.asarray(before + after)


def pairs_of(cycles: Sequence[Detections]) -> Pairs | None:
    """Return pairs of cycles spread over a log, or None where there are none with detections."""
    full = [cycle for cycle in cycles if len(cycle.labels) >= MIN_DETECTIONS]
    spacing = spacing_of(full[:: max(1, len(full) // SOME_CYCLES)])
    if spacing is None:
        return None
    stamps = np.array([cycle.t for cycle in full])
    pairs = []
    shortest = float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
    for gap in GAPS:
        later = np.arange(gap, len(full))
        near = stamps[later] - stamps[later - gap] <= max(LONGEST, 1.5 * shortest)
        later = later[near]
        chosen = later[:: max(1, len(later) // PAIRS_OF_GAP)]
        pairs.append([chosen - gap, chosen, np.full(len(chosen), gap)])
    first, second, gaps = np.concatenate(pairs, axis=1)
    if len(first) == 0:
        return None
    points, variances = padded(full, MOST_DETECTIONS)
    both = variances[first][:, :, None] + variances[second][:, None]
    begin, end = stamps[first], stamps[second]
    return Pairs(begin, end, points[first], points[second], both, gaps, REACH * spacing)


def padded(cycles: Sequence[Detections], most: int) -> tuple[Array, Array]:
    """Return the nearest detections (C, m, 2) of each cycle, and a coordinate's variances (C, m), or NaN."""
    points = np.full((len(cycles), most, 2), np.nan)
    variances = np.full((len(cycles), most), np.nan)
    for k, cycle in enumerate(cycles):
        nearest = np.argsort(np.hypot(*cycle.points_vehicle.T), kind="stable")[:most]
        points[k, : len(nearest)] = cycle.points_vehicle[nearest]
        variances[k, : len(nearest)] = 0.5 * np.trace(cycle.covariances[nearest], axis1=1, axis2=2)
    return points, variances


def spacing_of(cycles: Sequence[Detections]) -> float | None:
    """Return the median distance from a detection to the next one of its cycle, or None without any."""
    found = []
    for cycle in cycles:
        points = cycle.points_vehicle
        off = points[:, None] - points
        square = (off * off).sum(axis=-1)
        np.fill_diagonal(square, np.inf)
        found.append(np.sqrt(square.min(axis=1)))
    return float(np.median(np.concatenate(found))) if found else None


def _polar(points: Array) -> tuple[Array, Array]:
    return np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])


# --- motions --------------------------------------------------------------------------------------------


def motions(odometry_t: Array, poses: Array, begin: Array, end: Array) -> Array:
    """Return the motions (P, 3) between stamps (P,), each in the frame of its beginning."""
    first, last = _at(odometry_t, poses, begin), _at(odometry_t, poses, end)
    moved = turned(last[:, :2] - first[:, :2], -first[:, 2])
    return np.column_stack([moved, last[:, 2] - first[:, 2]])


def _at(odometry_t: Array, poses: Array, stamps: Array) -> Array:
    """Return the poses (P, 3) at stamps (P,) by linear interpolation; beyond the ends they are held."""
    return np.column_stack([np.interp(stamps, odometry_t, column) for column in poses.T])


def turned(vectors: Array, angles: Array) -> Array:
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])
