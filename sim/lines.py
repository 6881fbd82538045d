"""A sensor of lines, kerbs or walls: points of both boundaries, at different places in each cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
import scipy  # which imports its modules when they are used
from numpy.random import Generator

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.checked import AT_LEAST_0, AtLeast0, Checked

from .curves import STEP, SmoothCurve, arc_lengths, direction, left_normals, ring
from .sensor import SensorSettings, false_positives, polar_detections, seen_from
from .track import Track

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class LineSettings(Checked, group="line"):
    """Which points of the boundaries a sensor of lines sees."""

    spacing: AtLeast0 = 0.0
    """Mean distance of a cycle's points along each boundary (m); with 0 the sensor detects cones instead."""
    sigma_across: AtLeast0 = 0.0
    """Standard deviation of a point across its boundary beside the noise of range and bearing (m)."""
    gaps: Annotated[int, AT_LEAST_0] = 0
    """Number of stretches of a boundary in which nothing is detected, drawn once for a log."""
    gap_length: AtLeast0 = 10.0
    """Length of each of them (m)."""


LINE: Final = SensorSettings(
    detection_probability=1.0,
    detection_falloff=0.0,
    blind_fraction=0.0,
    wrong_colour=0.0,
    false_positives=0.3,
)
"""Range, field and noise of the plain sensor; 1 % of the points are clutter where they are 1 m apart."""


def curve_through(points: Array, closed: bool) -> SmoothCurve:
    """Smooth curve through the points (n, 2) of a boundary in driving order, by its arc length."""
    by_chord = _through(points, closed)
    s = np.linspace(0.0, by_chord.x[-1], int(np.ceil(by_chord.x[-1] / STEP)) + 1)
    spline = _through(np.asarray(by_chord(s))[: len(s) - closed], closed)
    return SmoothCurve(spline, float(spline.x[-1]), closed, np.zeros(len(spline.x)))


def _through(points: Array, closed: bool) -> CubicSpline:
    points = ring(points) if closed else points
    s = arc_lengths(points)
    new = np.diff(s, prepend=-1.0) > 0.0
    ends: Literal["periodic", "not-a-knot"] = "periodic" if closed else "not-a-knot"
    return scipy.interpolate.CubicSpline(s[new], points[new], bc_type=ends)


def as_lines(track: Track) -> Track:
    """Replace the cones of a track by points of smooth curves through them."""
    if track.path is not None:
        raise SettingsError(f"line.spacing: expected a track between two boundaries, found the {track.name}")
    rows = []
    for cones in (track.left, track.right):
        curve = curve_through(cones, track.closed)
        count = int(np.ceil(curve.length))  # points are a metre apart at most
        rows.append(curve.points(np.linspace(0.0, curve.length, count + 1)[: count + (not track.closed)]))
    return replace(track, left=rows[0], right=rows[1], other=np.zeros((0, 2)), other_labels=None)


class LineSensor:
    """Points anywhere along both boundaries, drawn independently in each cycle.

    A covariance is that of the noise of range and bearing, and of the scatter across the boundary: the
    variance of the distance across is exact. Along the boundary a point lies anywhere, and the covariance
    says nothing of that.
    """

    def __init__(
        self, track: Track, labels: IntArray, settings: SensorSettings, line: LineSettings, rng: Generator
    ) -> None:
        """Take a track of `as_lines` in the map frame, and the label of each of its points."""
        gap_rng, self._place_rng, self._noise_rng, self._false_rng, self._drop_rng = rng.spawn(5)
        self._settings, self._line, self._labels = settings, line, labels
        self._curves = [curve_through(row, track.closed) for row in (track.left, track.right)]
        self._counts = (len(track.left), len(track.right))
        sides = gap_rng.integers(0, len(self._curves), line.gaps)
        self.gaps = [(int(side), float(gap_rng.uniform(0.0, self._curves[side].length))) for side in sides]
        """Boundary of each gap, and the place along it where the gap begins (m)."""

    def detect(
        self, t: float, pose: Array, scale: float = 0.0, bias: float = 0.0
    ) -> tuple[Detections, IntArray]:
        """Detect a cycle from a pose [x, y, theta], where a range r reads `(1 + scale) r + bias`.

        The second result is the point of the true boundary nearest to each detection (m,).
        """
        settings = self._settings
        ranges, bearings, labels, nearest, normals = self._detect_lines(pose, scale, bias)
        found = polar_detections(t, ranges, bearings, labels, settings)
        ahead = direction(pose[2])
        vehicle = np.column_stack([ahead, left_normals(ahead)])  # turns rows of the map frame into it
        scatter = self._line.sigma_across * normals @ vehicle
        found = replace(found, covariances=found.covariances + scatter[:, :, None] * scatter[:, None, :])
        ranges, bearings, labels, none = false_positives(settings, self._false_rng)
        found = found.with_others(polar_detections(t, ranges, bearings, labels, settings))
        index = np.concatenate([nearest, none])
        kept = np.full(len(index), self._drop_rng.random() >= settings.dropped_cycles)
        return found.where(kept), index[kept]

    def _detect_lines(
        self, pose: Array, scale: float, bias: float
    ) -> tuple[Array, Array, IntArray, IntArray, Array]:
        """Measured ranges and bearings, labels, nearest true points and normals (m, 2)."""
        settings, rng = self._settings, self._noise_rng
        points, normals, nearest = self._draw()
        chance, colour = rng.random((2, len(points)))
        along, bearing, across = rng.standard_normal((3, len(points)))
        points = points + normals * (self._line.sigma_across * across)[:, None]
        ranges, bearings = seen_from(pose, points)
        seen = settings.is_inside(ranges, bearings) & (chance < settings.probabilities(ranges))
        ranges = (1.0 + scale) * ranges + bias + settings.systematic_errors(ranges)
        ranges = ranges + settings.range_sigmas(ranges) * along
        bearings = bearings + settings.bearing_sigma * bearing
        labels = self._labels[nearest]
        labels = np.where(colour < settings.wrong_colour, LEFT + RIGHT - labels, labels)
        return ranges[seen], bearings[seen], labels[seen], nearest[seen], normals[seen]

    def _draw(self) -> tuple[Array, Array, IntArray]:
        """Draw points (m, 2) of both boundaries, with their normals and the nearest true points (m,)."""
        drawn = []
        for side, curve in enumerate(self._curves):
            count = int(self._place_rng.poisson(curve.length / self._line.spacing))
            s = self._place_rng.uniform(0.0, curve.length, count)
            for gap_side, begin in self.gaps:
                beyond = (s - begin) % curve.length if curve.closed else s - begin
                s = s[(side != gap_side) | (beyond < 0.0) | (beyond >= self._line.gap_length)]
            share = s / curve.length
            nearest = np.rint(share * self._counts[side]).astype(int) % self._counts[side]
            drawn.append((curve.points(s), curve.normals(s), nearest + side * self._counts[0]))
        points, normals, index = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        return points, normals, index
