"""Drives of several laps whose vehicle is put down elsewhere, which its odometry does not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.vehicle import VehicleSettings, drive

from .drives import exact_log, noisy


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
