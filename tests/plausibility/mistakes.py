"""Mistakes that people make when they write a log: wrong units, wrong frames, wrong columns, wrong clocks.

A fault is what a vehicle does; a mistake is in the file only. Each takes a good log to one with that mistake,
and leaves the truth as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT
from pathspace_graph.sim.vehicle import integrate

DEGREE: Final = float(np.pi / 180.0)  # a degree in radians


def with_cycles(log: Log, change: Callable[[Detections], dict[str, Any]]) -> Log:
    return replace(log, cycles=tuple(replace(cycle, **change(cycle)) for cycle in log.cycles))


def with_points(log: Log, change: Callable[[Array], Array]) -> Log:
    return with_cycles(log, lambda cycle: {"points_vehicle": change(cycle.points_vehicle)})


def with_covariances(log: Log, factor: float) -> Log:
    return with_cycles(log, lambda cycle: {"covariances": factor * cycle.covariances})


def with_twists(log: Log, factors: Array | tuple[float, float, float]) -> Log:
    return with_twists_of(log, log.odometry.twist * factors)


def with_twists_of(log: Log, twist: Array) -> Log:
    return replace(log, odometry=replace(log.odometry, twist=twist))


def with_stamps(log: Log, odometry: float = 1.0, detections: float = 1.0) -> Log:
    log = with_cycles(log, lambda cycle: {"t": cycle.t * detections})
    return replace(log, odometry=replace(log.odometry, t=log.odometry.t * odometry))


def turned(log: Log, to_vehicle: Array) -> Log:
    """Move detections to a frame that a matrix (2, 2) takes to the vehicle's."""
    log = with_cycles(log, lambda cycle: {"covariances": to_vehicle.T @ cycle.covariances @ to_vehicle})
    return with_points(log, lambda points: points @ to_vehicle)


def in_frame(log: Log, turn: float = 0.0, ahead: float = 0.0, left: float = 0.0) -> Log:
    """Move detections to the frame of a sensor: turned to the left (rad), and placed (m)."""
    return turned(with_points(log, lambda points: points - [ahead, left]), rotation(turn))


def camera(log: Log, height: float = 0.6, sigma: float = 0.02) -> Log:
    """Use x to the right and y down of a camera at a height (m); z ahead is lost."""
    down = np.random.default_rng(0).normal
    return with_points(log, lambda p: np.column_stack([-p[:, 1], down(height, sigma, len(p))]))


def bearings_as_degrees(log: Log) -> Log:
    """Take bearings in degrees for radians."""

    def wrong(points: Array) -> Array:
        bearings = np.arctan2(points[:, 1], points[:, 0]) / DEGREE
        unit = np.column_stack([np.cos(bearings), np.sin(bearings)])
        return np.asarray(np.hypot(*points.T)[:, None] * unit)

    return with_points(log, wrong)


def dead_reckoned(log: Log) -> Array:
    """Poses (N, 3) at the odometry's stamps, by the odometry alone."""
    return integrate(log.odometry.twist[:-1], np.diff(log.odometry.t))


def speeds_in_the_map(log: Log, start: float = 0.0) -> Log:
    """Turn speeds to the axes of a frame in which the vehicle starts at a heading (rad)."""
    (vx, vy, wz), angle = log.odometry.twist.T, dead_reckoned(log)[:, 2] + start
    v = (vx + 1j * vy) * np.exp(1j * angle)
    return with_twists_of(log, np.column_stack([v.real, v.imag, wz]))


def detections_in_the_map(log: Log) -> Log:
    poses, t = dead_reckoned(log), log.odometry.t

    def moved(cycle: Detections) -> dict[str, Any]:
        x, y, theta = (float(np.interp(cycle.t, t, column)) for column in poses.T)
        return {"points_vehicle": cycle.points_vehicle @ rotation(theta).T + [x, y]}

    return with_cycles(log, moved)


def late(log: Log, seconds: float, begin: float = -np.inf) -> Log:
    """Stamp detections after a stamp (s) too late (s); those after the end, or out of order, are dropped."""
    stamps = np.array([cycle.t + seconds * (cycle.t > begin) for cycle in log.cycles])
    kept = (stamps >= log.odometry.t[0]) & (stamps <= log.odometry.t[-1])
    kept &= stamps >= np.maximum.accumulate(stamps)
    cycles = [replace(log.cycles[k], t=float(stamps[k])) for k in np.flatnonzero(kept).tolist()]
    truth = None if log.truth is None else replace(log.truth, associations=None)
    return replace(log, cycles=tuple(cycles), truth=truth)


def side_late(log: Log, seconds: float) -> Log:
    """Stamp the cones on the right of the vehicle too late (s), in cycles of their own."""
    halves = [
        cycle.where((cycle.points_vehicle[:, 1] < 0.0) == is_right)
        for is_right in (False, True)
        for cycle in (late(log, seconds) if is_right else log).cycles
    ]
    cycles = sorted((half for half in halves if len(half.labels)), key=lambda half: half.t)
    return replace(log, cycles=tuple(cycles), truth=None)


def wrapped(log: Log) -> Log:
    """Difference a yaw in (-pi, pi]."""
    yaw = np.angle(np.exp(1j * dead_reckoned(log)[:, 2]))
    return with_twists_of(log, np.column_stack([log.odometry.twist[:, :2], np.gradient(yaw, log.odometry.t)]))


def in_millimetres(log: Log) -> Log:
    """State all lengths in mm: positions, covariances and speeds."""
    return with_twists(with_covariances(with_points(log, lambda p: 1e3 * p), 1e6), (1e3, 1e3, 1.0))


y_to_the_right: Final = partial(turned, to_vehicle=np.diag([1.0, -1.0]))

MISTAKES: Final[dict[str, Callable[[Log], Log]]] = {
    "positions in millimetres": partial(with_points, change=lambda points: 1e3 * points),
    "speeds in mm/s": partial(with_twists, factors=(1e3, 1e3, 1.0)),
    "all lengths in millimetres": in_millimetres,
    "yaw rate in degrees per second": partial(with_twists, factors=(1.0, 1.0, 1.0 / DEGREE)),
    "bearings in degrees": bearings_as_degrees,
    "y to the right": y_to_the_right,
    "stamps in nanoseconds": partial(with_stamps, odometry=1e9, detections=1e9),
    "stamps of the odometry in nanoseconds": partial(with_stamps, odometry=1e9),
    "stamps of the detections in nanoseconds": partial(with_stamps, detections=1e9),
    "sensor frame: x to the right, y ahead": partial(in_frame, turn=-0.5 * np.pi),
    "sensor frame: x to the left": partial(in_frame, turn=0.5 * np.pi),
    "sensor frame: x to the rear": partial(in_frame, turn=np.pi),
    "sensor frame: camera, z ahead": camera,
    "sensor frame: x and y swapped": partial(turned, to_vehicle=np.array([[0.0, 1.0], [1.0, 0.0]])),
    "positions in centimetres": partial(with_points, change=lambda points: 1e2 * points),
    "speeds in km/h": partial(with_twists, factors=(3.6, 3.6, 1.0)),
    "speeds always 0": partial(with_twists, factors=(0.0, 0.0, 1.0)),
    "yaw rate to the right": partial(with_twists, factors=(1.0, 1.0, -1.0)),
    "yaw rate always 0": partial(with_twists, factors=(1.0, 0.0, 0.0)),
    "stamps in milliseconds": partial(with_stamps, odometry=1e3, detections=1e3),
    "odometry is a pose": lambda log: with_twists_of(log, dead_reckoned(log)),
    "odometry of a yaw that wraps": wrapped,
    "speeds in the map frame": speeds_in_the_map,
    "speeds in the map frame, start at 137 degrees": partial(speeds_in_the_map, start=137.0 * DEGREE),
    "detections in the map frame": detections_in_the_map,
    "detections 1 s late": partial(late, seconds=1.0),
    "detections 1 s late from the middle on": lambda log: late(log, 1.0, float(log.odometry.t.mean())),
    "sides: the right one 50 ms late": partial(side_late, seconds=0.05),
    "covariances in mm^2": partial(with_covariances, factor=1e6),
    "covariances of zero": partial(with_covariances, factor=0.0),
    "all labels left": partial(
        with_cycles, change=lambda cycle: {"labels": np.full(len(cycle.labels), LEFT)}
    ),
    "y to the right, yaw rate in degrees": lambda log: with_twists(
        y_to_the_right(log), (1.0, 1.0, 1.0 / DEGREE)
    ),
}
"""Mistakes by name."""
