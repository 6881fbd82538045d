"""Mistakes that people make when they write a log: wrong units, wrong frames, wrong columns.

A fault is what a vehicle does; a mistake is in the file only. Each takes a good log to one with that mistake,
and leaves the truth as it is.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT

from .vehicle import integrate

Mistake = Callable[[Log], Log]

DEGREE: Final = float(np.pi / 180.0)  # a degree in radians


def with_cycles(log: Log, change: Callable[[Detections], dict[str, Any]]) -> Log:
    return replace(log, cycles=tuple(replace(cycle, **change(cycle)) for cycle in log.cycles))


def with_points(log: Log, change: Callable[[Array], Array]) -> Log:
    return with_cycles(log, lambda cycle: {"points_vehicle": change(cycle.points_vehicle)})


def with_covariances(log: Log, change: Callable[[Array], Array]) -> Log:
    return with_cycles(log, lambda cycle: {"covariances": change(cycle.covariances)})


def with_twists(log: Log, factors: Array | tuple[float, float, float]) -> Log:
    return with_twists_of(log, log.odometry.twist * factors)


def with_twists_of(log: Log, twist: Array) -> Log:
    return replace(log, odometry=replace(log.odometry, twist=twist))


def with_stamps(log: Log, odometry: float = 1.0, detections: float = 1.0) -> Log:
    log = with_cycles(log, lambda cycle: {"t": cycle.t * detections})
    return replace(log, odometry=replace(log.odometry, t=log.odometry.t * odometry))


def turned(log: Log, to_vehicle: Array) -> Log:
    """Move detections to a frame that a matrix (2, 2) takes to the vehicle's."""
    log = with_covariances(log, lambda covariances: to_vehicle.T @ covariances @ to_vehicle)
    return with_points(log, lambda points: points @ to_vehicle)


def in_frame(log: Log, turn: float = 0.0, ahead: float = 0.0, left: float = 0.0) -> Log:
    """Move detections to the frame of a sensor: turned to the left (rad), and placed (m)."""
    c, s = np.cos(turn), np.sin(turn)
    return turned(with_points(log, lambda points: points - [ahead, left]), np.array([[c, -s], [s, c]]))


def camera(log: Log, height: float = 0.6, sigma: float = 0.02) -> Log:
    """Use x to the right and y down of a camera at a height (m); z ahead is lost."""
    rng = np.random.default_rng(0)
    return with_points(
        log, lambda points: np.column_stack([-points[:, 1], rng.normal(height, sigma, len(points))])
    )


def bearings_as_degrees(log: Log) -> Log:
    """Take bearings in degrees for radians."""

    def wrong(points: Array) -> Array:
        ranges, bearings = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0]) / DEGREE
        return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])

    return with_points(log, wrong)


def dead_reckoned(log: Log) -> Array:
    """Poses (N, 3) at the odometry's stamps, by the odometry alone."""
    return integrate(log.odometry.twist[:-1], np.diff(log.odometry.t))


def speeds_in_the_map(log: Log) -> Log:
    heading, (vx, vy, wz) = dead_reckoned(log)[:, 2], log.odometry.twist.T
    c, s = np.cos(heading), np.sin(heading)
    return with_twists_of(log, np.column_stack([c * vx - s * vy, s * vx + c * vy, wz]))


def detections_in_the_map(log: Log) -> Log:
    poses, t = dead_reckoned(log), log.odometry.t

    def moved(cycle: Detections) -> dict[str, Any]:
        x, y, theta = (float(np.interp(cycle.t, t, column)) for column in poses.T)
        c, s = np.cos(theta), np.sin(theta)
        return {"points_vehicle": cycle.points_vehicle @ np.array([[c, s], [-s, c]]) + [x, y]}

    return with_cycles(log, moved)


def late(log: Log, seconds: float) -> Log:
    """Stamp detections too late (s); those after the end are dropped."""
    first, last = log.odometry.t[[0, -1]]
    log = with_cycles(log, lambda cycle: {"t": cycle.t + seconds})
    truth = None if log.truth is None else replace(log.truth, associations=None)
    return replace(log, cycles=tuple(c for c in log.cycles if first <= c.t <= last), truth=truth)


def in_millimetres(log: Log) -> Log:
    """State all lengths in mm: positions, covariances and speeds."""
    log = with_covariances(with_points(log, lambda points: 1e3 * points), lambda K: 1e6 * K)
    return with_twists(log, (1e3, 1e3, 1.0))


y_to_the_right: Final = partial(turned, to_vehicle=np.diag([1.0, -1.0]))

MISTAKES: Final[dict[str, Mistake]] = {
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
    "sensor frame: turned by 30 degrees": partial(in_frame, turn=30.0 * DEGREE),
    "sensor frame: turned by 10 degrees": partial(in_frame, turn=-10.0 * DEGREE),
    "sensor frame: camera, z ahead": camera,
    "sensor frame: x and y swapped": partial(turned, to_vehicle=np.array([[0.0, 1.0], [1.0, 0.0]])),
    "sensor frame: 2 m ahead": partial(in_frame, ahead=2.0),
    "positions in centimetres": partial(with_points, change=lambda points: 1e2 * points),
    "speeds in km/h": partial(with_twists, factors=(3.6, 3.6, 1.0)),
    "yaw rate to the right": partial(with_twists, factors=(1.0, 1.0, -1.0)),
    "stamps in milliseconds": partial(with_stamps, odometry=1e3, detections=1e3),
    "odometry is a pose": lambda log: with_twists_of(log, dead_reckoned(log)),
    "speeds in the map frame": speeds_in_the_map,
    "detections in the map frame": detections_in_the_map,
    "detections 1 s late": partial(late, seconds=1.0),
    "covariances in mm^2": partial(with_covariances, change=lambda K: 1e6 * K),
    "covariances of zero": partial(with_covariances, change=lambda K: 0.0 * K),
    "all labels left": partial(
        with_cycles, change=lambda cycle: {"labels": np.full(len(cycle.labels), LEFT)}
    ),
    "y to the right, yaw rate in degrees": lambda log: with_twists(
        y_to_the_right(log), (1.0, 1.0, 1.0 / DEGREE)
    ),
}
"""Mistakes by name; those up to `2 m ahead` are the common ones."""
