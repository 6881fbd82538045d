"""Points of lines, kerbs or walls: evenly spaced, and labelled by their side of the driven path."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Odometry
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

from .messages import Points
from .settings import LEAST_SPACING, Frames


def default_spacing(points: Points) -> float:
    """Spacing (m) of a record that states none, by the median range, which has the size of the scene."""
    return max(0.15 * float(np.median(np.hypot(*points.points.T))), LEAST_SPACING)


def lines_of(
    t: Array,
    points: Points,
    odometry: Odometry,
    frames: Frames,
    spacing: float | None,
    notes: Counter[str],
) -> Points:
    """Space the points of messages at the stamps t (n,) in s evenly (m), and label them by the driven path.

    A label that a point has stays. Points farther from the path than a boundary are dropped.
    """
    spacing = spacing or default_spacing(points)
    scans = [along_lines(scan, spacing) for scan in points.apart(len(t))]
    found = Points.joined(scans)
    told = (
        f"points of lines are {spacing:.2g} m apart (--spacing), of {len(points.labels)} that were recorded"
    )
    notes[told] += len(found.labels)
    path = ReckonedPath.of(odometry, 0.5 * spacing)
    places = [from_sensor(scan.points, frames) for scan in scans]
    lateral = [path.lateral(float(at), own) for at, own in zip(t, places, strict=True)]
    kept = np.concatenate([nearest_lines(scan.lines, own) for scan, own in zip(scans, lateral, strict=True)])
    away = np.concatenate(lateral)
    known = np.abs(away[np.isfinite(away)])
    if len(known):
        kept &= ~(np.abs(away) > 3.0 * np.median(known))
    labels = np.select(
        [found.labels != UNKNOWN, away > 0.0, away < 0.0], [found.labels, LEFT, RIGHT], UNKNOWN
    )
    notes["points of lines were too far from the driven path, and were left out"] += int((~kept).sum())
    return found._replace(labels=labels).where(kept)


def from_sensor(points: Array, frames: Frames) -> Array:
    """Transform points (m, 2) of the sensor to the vehicle frame."""
    x, y, yaw = frames.mounting or (0.0, 0.0, 0.0)
    return np.asarray((points * frames.sides) @ rotation(yaw).T + np.array([x, y]))


def nearest_lines(lines: IntArray, lateral: Array) -> BoolArray:
    """Which points (m,) are of the polylines nearest to the path on their side, or of none."""
    kept = np.ones(len(lines), bool)
    numbers = np.unique(lines[lines >= 0])
    middles = np.array([np.nanmedian(lateral[lines == line]) for line in numbers])
    for side in (1.0, -1.0):
        away = np.where(side * middles > 0.0, side * middles, np.inf)
        far = numbers[(away > 1.5 * away.min(initial=np.inf)) & np.isfinite(away)]
        kept &= ~np.isin(lines, far)
    return kept


def along_lines(points: Points, spacing: float) -> Points:
    """Interpolate polylines and thin dense points to a spacing (m)."""
    parts = [points.where(spaced_apart(points.points, spacing, points.lines < 0))]
    for line in np.unique(points.lines[points.lines >= 0]):
        own = points.where(points.lines == line)
        placed = resampled(own.points, spacing)
        labels = np.full(len(placed), own.labels[0])
        parts.append(Points.of(placed, labels, lines=np.full(len(placed), line)))
    return Points.joined(parts)


def resampled(vertices: Array, spacing: float) -> Array:
    """Points (m, 2) of a polyline (n, 2) at each multiple of the spacing (m)."""
    s = np.append(0.0, np.cumsum(np.hypot(*np.diff(vertices, axis=0).T)))
    at = np.arange(0.0, s[-1] + 1e-9 * spacing, spacing)
    return np.column_stack([np.interp(at, s, vertices[:, 0]), np.interp(at, s, vertices[:, 1])])


def spaced_apart(points: Array, spacing: float, chosen: BoolArray) -> IntArray:
    """Indices of chosen points (m, 2) no two of which are nearer than the spacing (m).

    They are chosen by bearing, since by range the noise of the ranges would choose.
    """
    left = np.flatnonzero(chosen)
    left = left[np.argsort(np.arctan2(points[left, 1], points[left, 0]), kind="stable")]
    kept = []
    while len(left):
        kept.append(left[0])
        left = left[np.hypot(*(points[left] - points[left[0]]).T) >= spacing]
    return np.array(kept, dtype=int)


@dataclass(frozen=True, eq=False)
class ReckonedPath:
    """The path driven, by dead reckoning from the pose at the first twist."""

    t: Array  # (N,) stamps (s)
    poses: Array  # (N, 3) poses in m, m and rad
    s: Array  # (N,) path length (m)
    points: Array  # (k, 2) points of the path, evenly spaced
    at: Array  # (k,) their path lengths (m)

    @classmethod
    def of(cls, odometry: Odometry, step: float) -> "ReckonedPath":
        poses = odometry.poses()
        s = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
        at = np.linspace(0.0, s[-1], int(min(np.ceil(s[-1] / step), 1_000_000)) + 1)
        moved = np.diff(s, prepend=-1.0) > 0.0
        points = np.column_stack([np.interp(at, s[moved], poses[moved, k]) for k in range(2)])
        return cls(odometry.t, poses, s, points, at)

    def lateral(self, t: float, points: Array) -> Array:
        """Distances (m,) of points (m, 2) to the left of the path, seen in the vehicle frame at t.

        Each is measured on the stretch around the vehicle within its range, since the path may return later.
        A point before the beginning or beyond the end of the path has NaN.
        """
        x, y, heading, here = (np.interp(t, self.t, of) for of in (*self.poses.T, self.s))
        placed = points @ rotation(float(heading)).T + np.array([x, y])
        reach = 2.0 * np.hypot(*points.T)  # along the path, ahead and behind
        near = np.abs(self.at - here) <= reach.max(initial=0.0)
        path, at = self.points[near], self.at[near]
        if len(path) < 2:
            return np.full(len(points), np.nan)
        offset = placed[:, None] - path
        distances = np.hypot(offset[..., 0], offset[..., 1])
        distances[np.abs(at - here) > reach[:, None]] = np.inf
        foot = distances.argmin(axis=1)
        along, away = np.gradient(path, axis=0)[foot], offset[np.arange(len(foot)), foot]
        side = np.sign(along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0])
        forward = (along * away).sum(axis=1)
        first, last = at[foot] == self.at[0], at[foot] == self.at[-1]
        outside = (first & (forward < 0.0)) | (last & (forward > 0.0))
        return np.where(outside, np.nan, side * distances.min(axis=1))
