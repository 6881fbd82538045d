"""A track: two rows of cones in driving order, the smooth middle of the road between them; and the events."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import scipy  # which imports its modules when they are used

from pathspace_graph.brief import Brief
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True, eq=False, repr=False)
class Track(Brief):
    """Cones of a track, in a frame of its own."""

    left: Array  # cones of the left boundary in driving order (n, 2) in m
    right: Array  # cones of the right boundary in driving order (m, 2) in m
    other: Array  # cones of no boundary, such as those of a gate (k, 2) in m
    closed: bool  # whether the last cones are followed by the first
    start: Array  # pose [x, y, theta] (3,) from which the vehicle starts, in m, m, rad
    name: str
    other_labels: IntArray | None = None  # labels (k,) of the other cones, by default UNKNOWN
    path: Array | None = None  # (k, 2) along which the road is driven, if not its middle (m)

    @cached_property
    def centre_line(self) -> SmoothCurve:
        """The smooth curve halfway between the boundaries, or along the path, track frame.

        Its clearance is the distance to the nearer row, or to the nearest cone.
        """
        if self.path is None:
            return fit_centre_line(self.left, self.right, self.closed, self.start[:2])
        curve = _smooth(resample(self.path, STEP, self.closed)[0], self.closed)
        cones = scipy.spatial.KDTree(np.vstack([self.left, self.right]))
        return _as_spline(curve, np.asarray(cones.query(curve)[0]), self.closed)

    @property
    def rows(self) -> tuple[Array, Array]:
        """Cones of the left and the right boundary in passing order, repeated in each round."""
        if self.closed or self.path is None:
            return self.left, self.right
        return _passed(self.left, self.path), _passed(self.right, self.path)

    @property
    def cones(self) -> Array:
        return np.vstack([self.left, self.right, self.other])

    @property
    def cone_labels(self) -> IntArray:
        other = np.full(len(self.other), UNKNOWN) if self.other_labels is None else self.other_labels
        return np.concatenate([np.repeat([LEFT, RIGHT], [len(self.left), len(self.right)]), other])


def _passed(cones: Array, path: Array) -> Array:
    """Order cones (n, 2) as a path (k, 2) passes them, some repeatedly."""
    apart = np.linalg.norm(cones[:, None] - path, axis=2)
    beside = apart < 2.0 * np.median(apart.min(axis=1))  # of the distances of the nearest points
    passes = list[tuple[int, int]]()
    for cone, near in enumerate(beside):
        begins = np.flatnonzero(near & ~np.append(False, near[:-1]))
        ends = np.flatnonzero(near & ~np.append(near[1:], False)) + 1
        passes += [
            (b + int(apart[cone, b:e].argmin()), cone)
            for b, e in zip(begins.tolist(), ends.tolist(), strict=True)
        ]
    return cones[[cone for _, cone in sorted(passes)]]


def to_map_frame(track: Track) -> Track:
    """Move the track so that its start pose is (0, 0, 0): the map frame of a log that starts there."""
    ahead = direction(track.start[2])
    rotation = np.column_stack([ahead, left_of(ahead)])
    points = {name: getattr(track, name) for name in ("left", "right", "other", "path")}
    moved: dict[str, Any] = {
        name: at if at is None else (at - track.start[:2]) @ rotation for name, at in points.items()
    }
    return replace(track, **moved, start=np.zeros(3))


# --- curves of samples ------------------------------------------------------------------------------------


def ring(points: Array) -> Array:
    """Points (n, 2) of a closed curve with the first one repeated at the end (n + 1, 2)."""
    return np.vstack([points, points[:1]])


def arc_lengths(points: Array) -> Array:
    """Path length (n,) in m along a polyline (n, 2) from its first point to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def along_polyline(at: Array, s: Array, points: Array) -> Array:
    """Interpolate a polyline (n, 2) with increasing parameters `s` (n,) at the values `at` (k,): (k, 2)."""
    return np.column_stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])])


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def direction(theta: float) -> Array:
    """Unit vector (2,) of a heading in rad."""
    return np.array([np.cos(theta), np.sin(theta)])


def curvature(first: Array, second: Array) -> Array:
    """Signed curvature (n,) in 1/m, positive to the left, from both derivatives (n, 2)."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.asarray(cross / np.linalg.norm(first, axis=1) ** 3)


# --- the middle of the road --------------------------------------------------------------------------------

STEP: Final = 0.25  # distance of the samples of a curve that is fitted (m)
SMOOTHING: Final = 1.0  # sigma of the Gaussian (m), which cuts a corner of radius R by its square / 2R


@dataclass(frozen=True, eq=False)
class SmoothCurve:
    """A twice differentiable curve `c(s)` by arc length `s`, periodic where it is closed."""

    spline: CubicSpline  # points (2,) in m by s, which is the arc length to about 0.1 %
    length: float  # length of the curve, or of one lap (m)
    closed: bool
    clearance: Array  # distance to the nearer row of cones at the spline's knots (k,) in m

    def points(self, s: Array) -> Array:
        return np.asarray(self.spline(s))

    def tangents(self, s: Array) -> Array:
        return unit(np.asarray(self.spline(s, 1)))

    def normals(self, s: Array) -> Array:
        """Unit normals (n, 2) to the left."""
        return left_of(self.tangents(s))

    def curvatures(self, s: Array) -> Array:
        return curvature(np.asarray(self.spline(s, 1)), np.asarray(self.spline(s, 2)))

    def nearest(self, pose: Array) -> float:
        """Arc length of the point nearest to a pose (3,) whose tangent leads forward."""
        s = np.arange(0.0, self.length, STEP)
        distances = np.linalg.norm(self.points(s) - pose[:2], axis=1)
        ahead = self.tangents(s) @ direction(pose[2])
        return float(s[np.argmin(np.where(ahead > 0, distances, np.inf))])


def fit_centre_line(left: Array, right: Array, closed: bool, near: Array) -> SmoothCurve:
    """Fit the curve halfway between two rows of cones (n, 2) and (m, 2) in driving order.

    The rows are matched from `near` on by the triangulation of least total squared width along both.
    """
    rungs = match_rows(left, right, closed, near)
    middles = (left[rungs[:, 0]] + right[rungs[:, 1]]) / 2
    curve, rung_of = resample(middles, STEP, closed)
    curve = _smooth(curve, closed)
    index = rungs[np.rint(rung_of).astype(int) % len(rungs)].T

    def distances(curve: Array) -> list[Array]:
        return [_row_distances(curve, row, k, closed) for row, k in zip((left, right), index, strict=True)]

    for _ in range(4):  # moved to equal distances from both rows, and smoothed
        to_left, to_right = distances(curve)
        along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
        normals = left_of(unit(along if closed else np.gradient(curve, axis=0)))
        curve = _smooth(curve + normals * (to_left - to_right)[:, None] / 2, closed)
    return _as_spline(curve, np.minimum(*distances(curve)), closed)


def match_rows(left: Array, right: Array, closed: bool, near: Array) -> IntArray:
    """Match rows by index pairs (k, 2), each step advancing one, of least total squared distance."""
    if not closed:
        return _match(left, right)[1]
    best_cost, best = np.inf, np.zeros((0, 2), dtype=int)
    # the first pair is among the nearest cones
    for i in np.argsort(np.linalg.norm(left - near, axis=1))[:4]:
        for j in np.argsort(np.linalg.norm(right - near, axis=1))[:4]:
            lefts, rights = np.arange(i, i + len(left) + 1), np.arange(j, j + len(right) + 1)
            cost, rungs = _match(left[lefts % len(left)], right[rights % len(right)])
            if cost < best_cost:
                pairs = rungs[:-1] + np.array([i, j])
                best_cost, best = cost, pairs % np.array([len(left), len(right)])
    return best


def _match(left: Array, right: Array) -> tuple[float, IntArray]:
    width = np.sum((left[:, None] - right[None]) ** 2, axis=-1)
    total = np.empty_like(width)
    total[0] = np.cumsum(width[0])
    for i in range(1, len(left)):
        along = np.cumsum(width[i])
        total[i] = along + np.minimum.accumulate(total[i - 1] - along + width[i])
    i, j = len(left) - 1, len(right) - 1
    pairs = [(i, j)]
    while i or j:
        if j == 0 or (i > 0 and total[i - 1, j] <= total[i, j - 1]):
            i -= 1
        else:
            j -= 1
        pairs.append((i, j))
    return float(total[-1, -1]), np.array(pairs[::-1])


def resample(points: Array, step: float, closed: bool) -> tuple[Array, Array]:
    """Points (n, 2) about `step` apart along a polyline, and their fractional indices in it (n,)."""
    polyline = ring(points) if closed else points
    s = arc_lengths(polyline)
    count = max(int(np.ceil(s[-1] / step)), 2)
    at = np.linspace(0.0, s[-1], count + 1)[: count if closed else count + 1]
    return along_polyline(at, s, polyline), np.interp(at, s, np.arange(len(polyline), dtype=float))


def _smooth(curve: Array, closed: bool) -> Array:
    sigma = SMOOTHING / STEP
    if closed:
        return np.asarray(scipy.ndimage.gaussian_filter1d(curve, sigma, axis=0, mode="wrap"))
    pad = min(int(4 * sigma), len(curve) - 1)
    padded = np.pad(curve, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(scipy.ndimage.gaussian_filter1d(padded, sigma, axis=0)[pad:-pad])


def _row_distances(curve: Array, row: Array, index: IntArray, closed: bool) -> Array:
    """Distance of each sample to the row's segments near its matched cone `index` (n,)."""
    segments = index[:, None] + np.arange(-3, 3)
    mode: Literal["wrap", "clip"] = "wrap" if closed else "clip"
    a, b = (row.take(ends, axis=0, mode=mode) for ends in (segments, segments + 1))
    along = b - a
    length2 = np.maximum(np.sum(along**2, axis=-1), np.finfo(float).tiny)
    part = np.clip(np.sum((curve[:, None] - a) * along, axis=-1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(a + part[..., None] * along - curve[:, None], axis=-1).min(axis=1))


def _as_spline(curve: Array, clearance: Array, closed: bool) -> SmoothCurve:
    knots, index = resample(curve, 0.5, closed)
    at_knots = np.interp(index, np.arange(len(curve)), clearance)
    if closed:
        knots, at_knots = ring(knots), np.append(at_knots, at_knots[0])
    s = arc_lengths(knots)
    spline = scipy.interpolate.CubicSpline(s, knots, bc_type="periodic" if closed else "not-a-knot")
    return SmoothCurve(spline, float(s[-1]), closed, at_knots)


# --- events ------------------------------------------------------------------------------------------------

LANE: Final = 3.0  # width of the road in both events (m)


def skidpad() -> Track:
    """Skidpad: two circles, entered and left along x between them: two rounds right, two rounds left.

    Cones have the colour of their side as each circle is driven; those of the lanes are orange.
    """
    middle, inside, approach = 18.25 / 2, 15.25 / 2, 15.0  # radius driven, of the inner cones; lanes (m)
    outer = inside + LANE
    # the outer rows leave the lanes free
    gap = np.arccos((middle - LANE / 2) / outer)
    inner = _circle(inside, np.arange(16) * 2 * np.pi / 16)
    outer_row = _circle(outer, np.linspace(gap, 2 * np.pi - gap, 13))
    below, above = np.array([0.0, -middle]), np.array([0.0, middle])
    mirrored = np.array([1.0, -1.0])
    x = np.arange(-approach, -LANE - 2.0, LANE)
    lanes = [(side * at, y) for at in x for side in (1, -1) for y in (-LANE / 2, LANE / 2)]
    rounds = np.arange(0.0, 4 * np.pi, STEP / middle)
    path = [
        np.arange(-approach, 0.0, STEP)[:, None] * [1.0, 0.0],
        _circle(middle, rounds) + below,
        _circle(middle, rounds) * mirrored + above,
        np.arange(0.0, approach, STEP)[:, None] * [1.0, 0.0],
    ]
    return Track(
        left=np.concatenate([outer_row + below, inner * mirrored + above]),
        right=np.concatenate([inner + below, outer_row * mirrored + above]),
        other=np.array(lanes),
        other_labels=np.full(len(lanes), ORANGE),
        closed=False,
        start=np.array([-approach, 0.0, 0.0]),
        name="skidpad",
        path=np.concatenate(path),
    )


def _circle(radius: float, angles: Array) -> Array:
    return radius * np.column_stack([np.sin(angles), np.cos(angles)])


def acceleration() -> Track:
    """Acceleration: a straight along x with its gates, and the road on which vehicles brake."""
    stretch, spacing = 75.0, 5.0  # of the event, and of the cones along it (m); as long is the road to brake
    x = np.arange(0.0, 2 * stretch + spacing / 2, spacing)
    left = np.column_stack([x, np.full(len(x), LANE / 2)])
    gates = [(at, y) for at in (0.3, stretch + 0.3) for y in (-LANE / 2 - 0.3, LANE / 2 + 0.3)]
    right = left * [1.0, -1.0]
    labels = np.full(len(gates), BIG_ORANGE)
    return Track(left, right, np.array(gates), False, np.array([0.3, 0.0, 0.0]), "acceleration", labels)


EVENTS: Final[dict[str, Callable[[], Track]]] = {"skidpad": skidpad, "acceleration": acceleration}
"""Tracks of the events by name."""
