"""A corridor between walls, driven by a car of 1:10 with a scanner of ranges and odometry of its wheels."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pathspace_graph.io.log import Odometry
from pathspace_graph.sim.sensor import OdometryNoise, as_lines, measure_twists
from pathspace_graph.sim.track import ring, to_map_frame
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import VehicleSettings, drive

from .drives import SHORT

SIZE = 0.57
"""A track of Formula Student is shrunk by this to a corridor of 2 m."""
BEAMS = np.linspace(-2.35, 2.35, 541)
"""Angles (rad) of the beams of a scan."""
RANGE_MAX = 10.0
SIGMA_RANGE = 0.02
MOUNTING = (0.27, 0.0, 0.0)
"""Pose of the scanner in the vehicle frame (m, m, rad)."""
SIGMA_ODOMETRY = (0.05, 0.02, 0.03)
PERIOD = 0.1
"""Time (s) from one scan to the next."""


@dataclass(frozen=True, eq=False)
class Corridor:
    left: np.ndarray  # (n, 2) points of the left wall in the map frame (m), closed
    right: np.ndarray
    odometry: Odometry
    poses: np.ndarray  # (m, 3) true poses at the scans
    scan_t: np.ndarray  # (m,) stamps (s)
    ranges: np.ndarray  # (m, k) ranges of each scan (m), infinite where a beam has hit nothing


def corridor(seed: int = 4, laps: int = 2) -> Corridor:
    """Two laps of a corridor at up to 3 m/s."""
    rng = np.random.default_rng(seed)
    track = to_map_frame(generate_track(np.random.default_rng(seed), SHORT))
    walls = as_lines(track)
    driven = drive(track, laps, VehicleSettings(speed_max=5.0, overrun=6.0), rng)
    size = np.array([SIZE, SIZE, 1.0])
    poses, twists = driven.poses * size, driven.twists * size
    noise = OdometryNoise(white=SIGMA_ODOMETRY, scale=0.005, gyro_bias=0.002)
    measured, _ = measure_twists(twists, 0.02, noise, rng)
    every = slice(None, None, round(PERIOD / 0.02))
    left, right = ring(walls.left * SIZE), ring(walls.right * SIZE)
    ranges = np.array([scanned(pose, (left, right)) for pose in poses[every]])
    ranges += SIGMA_RANGE * rng.standard_normal(ranges.shape)
    return Corridor(left, right, Odometry(driven.t, measured), poses[every], driven.t[every], ranges)


def scanned(pose: np.ndarray, walls: tuple[np.ndarray, ...]) -> np.ndarray:
    """The distances (k,) along the beams from a pose to the first wall, infinite beyond RANGE_MAX."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    origin = pose[:2] + MOUNTING[0] * np.array([c, s])
    rays = np.column_stack([np.cos(BEAMS + pose[2]), np.sin(BEAMS + pose[2])])
    begin = np.concatenate([wall[:-1] for wall in walls]) - origin
    step = np.concatenate([np.diff(wall, axis=0) for wall in walls])
    # begin + u step = r ray, by crossing both sides with the ray and with the step
    across = rays[:, :1] * step[:, 1] - rays[:, 1:] * step[:, 0]
    u = (rays[:, 1:] * begin[:, 0] - rays[:, :1] * begin[:, 1]) / across
    r = (begin[:, 0] * step[:, 1] - begin[:, 1] * step[:, 0]) / across
    r = np.where((u >= 0.0) & (u <= 1.0) & (r > 0.0), r, np.inf).min(axis=1)
    return np.where(r <= RANGE_MAX, r, np.inf)


def write_json_lines(scene: Corridor, file: Path) -> Path:
    """The record as JSON lines with scans."""
    lines = [
        {"t": t, "twist": twist}
        for t, twist in zip(scene.odometry.t.tolist(), scene.odometry.twist.tolist(), strict=True)
    ]
    angles = {"angle_min": float(BEAMS[0]), "angle_increment": float(BEAMS[1] - BEAMS[0])}
    for t, ranges in zip(scene.scan_t.tolist(), scene.ranges, strict=True):
        found = [round(r, 4) if np.isfinite(r) else None for r in ranges.tolist()]
        lines.append({"t": t, "scan": {**angles, "range_max": RANGE_MAX, "ranges": found}})
    file.write_text("\n".join(map(json.dumps, sorted(lines, key=lambda line: line["t"]))) + "\n")
    return file
