"""A vehicle that follows the middle of a track: true poses and the true twist of its body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
import scipy  # which imports its modules when they are used
from numpy.random import Generator

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.settings.checked import AtLeast0, Checked, Signed

from .track import SmoothCurve, Track, arc_lengths, curvature, direction

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

SETTLING: Final = 5.0  # distance over which the vehicle moves from its start pose to the middle (m)


@dataclass(frozen=True)
class VehicleSettings(Checked):
    """How the vehicle drives."""

    speed_max: float = 12.0
    """Greatest speed (m/s)."""
    speed_start: AtLeast0 = 0.0
    """Speed at the start pose (m/s)."""
    acceleration_lateral: float = 5.0
    """Greatest lateral acceleration (m/s^2), which limits the speed in corners."""
    acceleration: float = 3.0
    """Greatest longitudinal acceleration (m/s^2)."""
    deceleration: float = 4.0
    """Greatest longitudinal deceleration (m/s^2)."""
    wander: AtLeast0 = 0.3
    """Largest distance of the smooth lateral wander from the middle (m)."""
    overrun: Signed = 10.0
    """Distance driven beyond the last lap's end (m); where it is negative, the road stays open."""
    rest: AtLeast0 = 0.0
    """Time at the start pose before the vehicle drives (s)."""
    stand: AtLeast0 = 0.0
    """Time for which the vehicle stands at the end of the drive, after braking (s); it drives on if 0."""
    rate: float = 50.0
    """Rate of the odometry and of the true poses (Hz)."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The true motion of a drive."""

    t: Array  # stamps (N,) in s, from 0
    poses: Array  # true poses [x, y, theta] (N, 3), map frame, from (0, 0, 0); theta is not wrapped
    twists: Array  # true body twists [vx, vy, wz] (N, 3), each held until the next stamp


def drive(track: Track, laps: int, settings: VehicleSettings, rng: Generator) -> Trajectory:
    """Drive `laps` laps of a track in the map frame and a little more, or once along an open one."""
    path = _driven_path(track, laps, settings, rng)
    s = _stations(path, _speed_profile(path, settings), settings.rate)
    derivative = path(s, 1)
    headings = np.unwrap(np.arctan2(derivative[:, 1], derivative[:, 0]))
    twists = _twists(np.column_stack([path(s), headings]), 1.0 / settings.rate)
    rest, stand = (np.zeros((round(time * settings.rate), 3)) for time in (settings.rest, settings.stand))
    twists = np.concatenate([rest, twists, stand])
    t = np.arange(len(twists)) / settings.rate
    return Trajectory(t, integrate(twists[:-1], 1.0 / settings.rate), twists)


def integrate(twists: Array, dt: float | Array) -> Array:
    """Integrate body twists (N, 3), each constant for `dt`, to poses (N + 1, 3) from 0 by SE(2)'s exp."""
    theta = np.concatenate([[0.0], np.cumsum(twists[:, 2] * dt)])
    steps = displacements(theta[:-1], twists, dt)[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), theta])


def displacements(theta: Array, twists: Array, dt: float | Array) -> Array:
    """Displacements (N, 3) by body twists (N, 3), each constant for `dt`, from headings theta (N,)."""
    a, b = _exponential(twists[:, 2] * dt)
    dx = (a * twists[:, 0] - b * twists[:, 1]) * dt
    dy = (b * twists[:, 0] + a * twists[:, 1]) * dt
    cos, sin = np.cos(theta), np.sin(theta)
    return np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy, twists[:, 2] * dt])


def _twists(poses: Array, dt: float) -> Array:
    """Body twists (N, 3), each of which leads to the next pose in `dt` (SE(2) logarithm)."""
    step = np.diff(poses, axis=0)
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    dx, dy = cos * step[:, 0] + sin * step[:, 1], -sin * step[:, 0] + cos * step[:, 1]
    a, b = _exponential(step[:, 2])
    scale = 1.0 / ((a * a + b * b) * dt)
    twists = np.column_stack([(a * dx + b * dy) * scale, (a * dy - b * dx) * scale, step[:, 2] / dt])
    return np.vstack([twists, twists[-1:]])


def _exponential(angle: Array) -> tuple[Array, Array]:
    """`sin(angle) / angle` and `(1 - cos(angle)) / angle`, also at 0."""
    half = np.sinc(angle / (2 * np.pi))
    return np.sinc(angle / np.pi), np.sin(angle / 2) * half


def _driven_path(track: Track, laps: int, settings: VehicleSettings, rng: Generator) -> CubicSpline:
    """Path from the start pose on, nearly by arc length: the centre line with an offset."""
    line = track.centre_line
    start = line.nearest(track.start)
    total = laps * line.length + settings.overrun if line.closed else line.length - start
    if total <= 0.0:
        raise SettingsError(f"vehicle.overrun: expected a drive, found none of {total:g} m")
    s = np.linspace(0.0, total, max(int(total / 0.25), 10))
    at = (start + s) % line.length if line.closed else start + s
    normals = line.normals(at)
    period = line.length if line.closed else None
    clearance = np.interp(at, line.spline.x, line.clearance, period=period)
    offset = _wander(s, clearance, settings.wander, rng) + _settling(line, start, track.start, s)
    points = line.points(at) + normals * offset[:, None]
    points += (track.start[:2] - points[0]) * np.exp(-s / SETTLING)[:, None]
    return scipy.interpolate.CubicSpline(
        arc_lengths(points), points, bc_type=((1, direction(track.start[2])), "not-a-knot")
    )


def _settling(line: SmoothCurve, start: float, pose: Array, s: Array) -> Array:
    """Lateral offset (n,) that begins with the start pose's offset and slope and dies away."""
    point, tangent = line.points(np.array([start]))[0], line.tangents(np.array([start]))[0]
    normal = left_of(tangent)
    offset = float(normal @ (pose[:2] - point))
    heading = direction(pose[2])
    stretch = 1.0 - line.curvatures(np.array([start]))[0] * offset
    slope = stretch * float(normal @ heading) / float(tangent @ heading)
    return np.asarray((offset + (slope + offset / SETTLING) * s) * np.exp(-s / SETTLING))


def _wander(s: Array, clearance: Array, most: float, rng: Generator) -> Array:
    """Draw the lateral wander (n,) by at most so many metres: a sum of eight sines of 15 to 60 m."""
    wavenumbers, phases = 2 * np.pi * rng.uniform(1 / 60.0, 1 / 15.0, 8), rng.uniform(0.0, 2 * np.pi, 8)
    wave = np.sin(s[:, None] * wavenumbers + phases).sum(axis=1) / np.sqrt(8)
    room = np.clip(clearance - 0.75 - 0.25, 0.0, most)  # half the vehicle's width, and as far from the cones
    begin = -np.expm1(-((s / SETTLING) ** 2))
    return np.asarray(np.tanh(wave) * room * begin)


def _speed_profile(path: CubicSpline, settings: VehicleSettings) -> Array:
    """Speeds (n,) at the path's knots that keep the acceleration limits, by two passes."""
    s = path.x
    bend = np.abs(curvature(np.asarray(path(s, 1)), np.asarray(path(s, 2))))
    cornering2 = settings.acceleration_lateral / np.maximum(bend, np.finfo(float).tiny)
    speed2 = np.minimum(cornering2, settings.speed_max**2)
    speed2[0] = min(speed2[0], settings.speed_start**2)
    speed2[-1] = 0.0 if settings.stand else speed2[-1]
    gain, loss = 2 * settings.acceleration * np.diff(s), 2 * settings.deceleration * np.diff(s)
    for i in range(len(gain)):
        speed2[i + 1] = min(speed2[i + 1], speed2[i] + gain[i])
    for i in range(len(loss))[::-1]:
        speed2[i] = min(speed2[i], speed2[i + 1] + loss[i])
    return np.sqrt(speed2)


def _stations(path: CubicSpline, speeds: Array, rate: float) -> Array:
    s = path.x
    durations = 2 * np.diff(s) / (speeds[1:] + speeds[:-1])
    knots_t = np.concatenate([[0.0], np.cumsum(durations)])
    t = np.arange(int(knots_t[-1] * rate) + 1) / rate
    index = np.clip(np.searchsorted(knots_t, t, side="right") - 1, 0, len(durations) - 1)
    since = t - knots_t[index]
    acceleration = (speeds[index + 1] - speeds[index]) / durations[index]
    return np.asarray(s[index] + speeds[index] * since + acceleration * since**2 / 2)
