"""The end of a drive registered on its beginning, where it comes back to it: a reference without truth."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import compose, move_points, to_map, to_vehicle
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.front_end.sightings import ConeTracker, SeenCycle
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.sim.curves import arc_lengths

FIRST, LAST = 25.0, 14.0  # lengths of the beginning of a drive, and of its end that is registered on it (m)
LEAST: Final = 6  # least number of cones of a registration, and of cycles in which a vehicle stands
NEAR: Final = 12.0  # range within which cones tell that a vehicle stands (m)
STAYS: Final = 0.5  # most median distance of a cycle's cones from those of one of the last (m)
TOGETHER: Final = 9  # cycles that are looked at together
MOST_STANDING: Final = 100  # most cycles in which it stands


def end_by_registration(cycles: Sequence[SeenCycle], noise: MeasuredNoise) -> Array | None:
    """Return the last pose (3,) of a drive, by the cones of its end laid on those of its beginning.

    The closest points of the same colour are paired, from starts around dead reckoning. The end is where the
    vehicle stands, or else the last metres; the beginning is short enough for odometry. The constant errors
    of the sensor are taken out.
    """
    poses = np.array([cycle.pose for cycle in cycles])
    path = arc_lengths(poses[:, :2])
    if path[-1] < FIRST + LAST:
        return None
    first = [cycle for cycle, s in zip(cycles, path, strict=True) if s <= FIRST]
    last = standing(cycles) or [c for c, s in zip(cycles, path, strict=True) if s >= path[-1] - LAST]
    start = [_cones(first, label, noise, np.zeros(3)) for label in BOUNDARIES]
    end = [_cones(last, label, noise, poses[-1]) for label in BOUNDARIES]
    tries = [
        _registered(start, end, compose(poses[-1], np.array(offset)))
        for offset in product((-4.0, -2.0, 0.0, 2.0, 4.0), (-2.0, 0.0, 2.0), (-0.1, 0.0, 0.1))
    ]
    count, _, pose = max(tries, key=lambda one: one[:2])
    return pose if count >= LEAST else None


def standing(cycles: Sequence[SeenCycle]) -> list[SeenCycle]:
    """Return the newest cycles in which near cones stay where they are, all at the last pose.

    Odometry may go on while the vehicle stands, so the cones decide. Empty where they are too few cycles.
    """
    near = [cycle.detections.points_vehicle for cycle in cycles[-MOST_STANDING:]]
    near = [points[np.hypot(*points.T) < NEAR] for points in near]
    most = KDTree(max(near[-TOGETHER:], key=len))
    moved = [np.median(most.query(points)[0]) if most.n and len(points) else np.inf for points in near]
    stays = median_filter(np.array(moved) < STAYS, TOGETHER, mode="nearest")  # single cycles see few cones
    count = int(np.argmin(stays[::-1])) if not stays.all() else len(stays)
    return [replace(one, pose=cycles[-1].pose) for one in cycles[-count:]] if count >= LEAST else []


def _cones(cycles: Sequence[SeenCycle], label: int, noise: MeasuredNoise, frame: Array) -> Array:
    """Return the cones (k, 2) of a label in the frame of a pose (3,), each the mean of those within 15 m."""
    own = []
    for cycle in cycles:
        seen = cycle.detections
        chosen = (seen.labels == label) & (np.hypot(*seen.points_vehicle.T) < 15.0)
        own.append(replace(cycle, detections=seen.where(chosen)))
    table = ConeTracker(noise).follow(own)
    corrected = table.point + by_sensor(table.point, table.twist) @ noise.sensor
    points = to_vehicle(to_map(corrected, table.pose), np.tile(frame, (len(table.t), 1)))
    weights = 1.0 / np.maximum(np.hypot(*table.point.T), 1.0) ** 2
    again = [rows for cone in np.unique(table.cone) if (rows := table.cone == cone).sum() > 1]
    means = [np.average(points[rows], axis=0, weights=weights[rows]) for rows in again]
    return np.array(means).reshape(-1, 2)


def _registered(start: list[Array], end: list[Array], pose: Array) -> tuple[int, float, Array]:
    """Return the number of paired cones, minus their mean distance, and the pose (3,) for it."""
    count, distance = 0, np.inf
    for gate in (2.0, 1.5, 1.0, 1.0, 0.7, 0.7):
        pairs = []
        for known, seen in zip(start, end, strict=True):
            if len(known) and len(seen):
                away, nearest = KDTree(known).query(move_points(pose, seen))
                near = away < gate
                pairs.append((seen[near], known[np.asarray(nearest)[near]]))
        points, targets = (np.concatenate([np.zeros((0, 2)), *side]) for side in zip(*pairs, strict=True))
        count = len(points)
        if count < LEAST:
            return 0, -np.inf, pose
        pose = motion_onto(points, targets)
        distance = float(np.hypot(*(move_points(pose, points) - targets).T).mean())
    return count, -distance, pose


def motion_onto(points: Array, onto: Array) -> Array:
    """Return the motion (3,) that leads points (n, 2) onto others, by least squares (Umeyama 1991)."""
    middle, goal = points.mean(axis=0), onto.mean(axis=0)
    a, b = (points - middle) @ [1.0, 1j], (onto - goal) @ [1.0, 1j]
    turn = float(np.angle(np.vdot(a, b)))
    turned = complex(*middle) * np.exp(1j * turn)
    return np.array([goal[0] - turned.real, goal[1] - turned.imag, turn])
