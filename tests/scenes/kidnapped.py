"""Drives of several laps whose vehicle is put down elsewhere, or leaves the circuit by a lane of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose, inverse, left_of, move_points, to_map
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.vehicle import VehicleSettings, drive, integrate

from .drives import DT, exact_log, noisy

Array = NDArray[np.float64]


def pear_track(skew: float = 0.15, half_width: float = 1.8, gap: float = 3.0) -> Track:
    """A closed track of about 105 m around `16 (1 + cos(2 phi) / 4 + skew cos(3 phi))`, counterclockwise.

    Without the skew it looks the same after half a lap.
    """
    phi = np.linspace(0.0, 2 * np.pi, 2000)
    r = 16.0 * (1.0 + 0.25 * np.cos(2 * phi) + skew * np.cos(3 * phi))
    middle = r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    tangent = np.gradient(middle, phi, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    s = np.append(0.0, np.cumsum(np.hypot(*np.diff(middle, axis=0).T)))
    at = np.linspace(0.0, s[-1], 2 * round(0.5 * s[-1] / gap), endpoint=False)
    rows = [
        np.column_stack([np.interp(at, s, (middle + side * half_width * normal)[:, k]) for k in range(2)])
        for side in (1.0, -1.0)
    ]
    start = np.array([*middle[0], np.arctan2(tangent[0, 1], tangent[0, 0])])
    return Track(rows[LEFT], rows[RIGHT], np.zeros((0, 2)), True, start, "pear")


def laps_log(track: Track, laps: int = 3) -> Log:
    """Several laps of a track, with noise on the detections."""
    settings = VehicleSettings(speed_max=8.0, speed_start=6.0, wander=0.2)
    track = to_map_frame(track)
    driven = drive(track, laps, settings, np.random.default_rng(0))
    return noisy(exact_log(driven.twists, track.cones, track.cone_labels.astype(np.intp)), seed=5, sigma=0.05)


def put_down(log: Log, t: float, distance: float) -> Log:
    """Cuts the time out of a log in which the vehicle drives some distance (m) from a stamp t (s) on."""
    truth = log.truth
    assert truth is not None
    stamps = np.array([cycle.t for cycle in log.cycles])
    path = np.append(0.0, np.hypot(*np.diff(truth.poses[:, :2], axis=0).T).cumsum())
    driven = np.interp(stamps, truth.pose_t, path)
    first = int(stamps.searchsorted(t))
    last = int(np.searchsorted(driven, driven[first] + distance))
    begin, end = stamps[first], stamps[last]
    cycles = [replace(cycle, t=cycle.t - end + begin) for cycle in log.cycles[last + 1 :]]
    odometry, kept = log.odometry, _outside(log.odometry.t, begin, end)
    shifted = np.where(odometry.t < end - 1e-9, odometry.t, odometry.t - end + begin)
    poses = _outside(truth.pose_t, begin, end)
    pose_t = np.where(truth.pose_t < end - 1e-9, truth.pose_t, truth.pose_t - end + begin)
    return replace(
        log,
        odometry=Odometry(shifted[kept], odometry.twist[kept]),
        cycles=(*log.cycles[: first + 1], *cycles),
        truth=Truth(pose_t[poses], truth.poses[poses], truth.cones, truth.cone_labels),
    )


def _outside(t: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Returns which stamps (n,) are before `begin`, or not before `end` (s)."""
    return (t < begin - 1e-9) | (t >= end - 1e-9)


# --- a lane beside the circuit ---------------------------------------------------------------------------

HALF_WIDTH, GAP, SPEED = 1.8, 3.0, 7.0
"""Half the width of the lane, the distance of its cones (m), and the speed on it (m/s)."""


@cache
def circuit_with_lane(radius: float = 18.0, leaves: float = 25.0) -> tuple[Log, float, float]:
    """Return the log of a lap and `leaves` metres, of a round on a lane to the right, and of the next lap.

    The lane is a circle (radius in m) from and to the same place of the circuit. Return the stamps (s) at
    which the vehicle leaves and is back, too.
    """
    track = to_map_frame(pear_track())
    settings = VehicleSettings(speed_max=8.0, speed_start=6.0)
    twists = drive(track, 3, settings, np.random.default_rng(0)).twists
    road = integrate(twists[:-1], DT)
    lap = np.mean([_stations(np.append(row, row[:1], axis=0))[-1] for row in (track.left, track.right)])
    first = int(_stations(road[:, :2]).searchsorted(lap + leaves))
    count = round(2.0 * np.pi * radius / SPEED / DT)
    lane = np.tile([SPEED, 0.0, -2.0 * np.pi / (count * DT)], (count, 1))
    on_lane = integrate(lane, DT)
    at = on_lane[_stations(on_lane[:, :2]).searchsorted(np.arange(0.0, 2.0 * np.pi * radius - GAP / 2, GAP))]
    across = HALF_WIDTH * left_of(np.column_stack([np.cos(at[:, 2]), np.sin(at[:, 2])]))
    rows = [to_map(at[:, :2] + side * across, road[first, None]) for side in (1.0, -1.0)]
    new, new_labels = np.concatenate(rows), np.repeat([LEFT, RIGHT], len(at))
    free = _away(track.cones, to_map(on_lane[:, :2], road[first, None])) > 0.8 * HALF_WIDTH
    new_free = (_away(new, road[:first, :2]) > 0.8 * HALF_WIDTH) & (_away(new, track.cones) > 1.0)
    cones = np.concatenate([track.cones[free], new[new_free]])
    labels = np.concatenate([track.cone_labels[free], new_labels[new_free]]).astype(np.intp)
    log = exact_log(np.concatenate([twists[:first], lane, twists[first:]]), cones, labels)
    return noisy(log, seed=5, sigma=0.05), first * DT, (first + count) * DT


def _stations(points: Array) -> Array:
    return np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())


def _away(points: Array, line: Array) -> Array:
    return np.asarray(np.hypot(*(points[:, None] - line).transpose(2, 0, 1)).min(axis=1))


def begun_later(log: Log, t: float) -> tuple[Log, Array]:
    """Cuts off a log before a stamp t (s); returns the rest in the frame of its first pose, and that pose."""
    truth, first = log.truth, int(log.odometry.t.searchsorted(t))
    assert truth is not None
    begin, kept = truth.poses[int(truth.pose_t.searchsorted(t))], truth.pose_t >= t
    back = inverse(begin)
    poses = np.array([compose(back, pose) for pose in truth.poses[kept]])
    cones = move_points(back, truth.cones)
    rest = replace(
        log,
        odometry=Odometry(log.odometry.t[first:], log.odometry.twist[first:]),
        cycles=tuple(cycle for cycle in log.cycles if cycle.t >= t),
        truth=Truth(truth.pose_t[kept], poses, cones, truth.cone_labels),
    )
    return rest, begin
