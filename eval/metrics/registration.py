"""The end of a drive registered on its beginning, where it comes back to it: a reference without truth."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise, huber_weights
from pathspace_graph.factors.se2 import compose, left_of, move_points, rotated, wrap_angle
from pathspace_graph.front_end.sightings import ConeTracker, SeenCycle
from pathspace_graph.labels import BOUNDARIES

LEAST: Final = 6  # least number of cones of a registration, and of cycles in which a vehicle stands
NEAR: Final = 12.0  # range within which cones tell that a vehicle stands (m)
FAR: Final = 30.0  # range within which they are registered (m): farther ones scatter by metres
GATES: Final = (2.5, 2.0, 1.5, 1.5, 1.5)  # distances of paired cones (m)
SEEN_SHARE: Final = 0.2  # least share of the cycles in which a cone is seen
HUBER: Final = 1.5  # whitened distance beyond which Huber's loss reduces the weight of a cone
DRIFTED: Final = (2.0, 2.0, 0.1)  # standard deviations of dead reckoning at the end of a lap (m, m, rad)
STAYS: Final = 0.5  # most median distance of a cycle's cones from those of one of the last (m)
TOGETHER: Final = 9  # cycles that are looked at together
MOST_STANDING: Final = 100  # most cycles in which it stands
NOT_STANDING: Final = "the vehicle stands at the {} for fewer than " + str(LEAST) + " cycles"
TOO_FEW: Final = f"fewer than {LEAST} cones are seen standing at the start and at the end"


def end_by_registration(cycles: Sequence[SeenCycle], noise: MeasuredNoise) -> Array | str:
    """Return the last pose (3,) of a drive, by the cones seen standing at its end and at its start.

    The closest points of the same colour are paired, from starts around dead reckoning, and the near ones
    weigh most. No motion, latency or odometry is in the result: odometry misses the first decimetres of a
    start, and goes on after a stop. The constant errors of the sensor are taken out. A text says why there is
    no result.
    """
    sides = {"start": standing(cycles[::-1]), "end": standing(cycles)}
    for side, own in sides.items():
        if not own:
            return NOT_STANDING.format(side)
    start, end = ([_cones(own, label, noise) for label in BOUNDARIES] for own in sides.values())
    tries = [
        _registered(start, end, compose(cycles[-1].pose, np.array(offset)))
        for offset in product((-4.0, -2.0, 0.0, 2.0, 4.0), (-2.0, 0.0, 2.0), (-0.1, 0.0, 0.1))
    ]
    score, pose = max(tries, key=lambda one: one[0] - _drifted(one[1], cycles[-1].pose))
    return np.append(pose[:2], wrap_angle(pose[2:])) if score > 0.0 else TOO_FEW


def standing(cycles: Sequence[SeenCycle]) -> list[SeenCycle]:
    """Return the last of these cycles in which near cones stay where they are.

    Odometry may go on while the vehicle stands, so the cones decide. Empty where they are too few cycles.
    """
    near = [cycle.detections.points_vehicle for cycle in cycles[-MOST_STANDING:]]
    near = [points[np.hypot(*points.T) < NEAR] for points in near]
    most = KDTree(max(near[-TOGETHER:], key=len))
    moved = [np.median(most.query(points)[0]) if most.n and len(points) else np.inf for points in near]
    stays = median_filter(np.array(moved) < STAYS, TOGETHER, mode="nearest")  # single cycles see few cones
    count = int(np.argmin(stays[::-1])) - TOGETHER // 2 if not stays.all() else len(stays)
    return list(cycles[-count:]) if count >= LEAST else []


def _drifted(pose: Array, reckoned: Array) -> float:
    """Squared distance of a pose (3,) from dead reckoning, in its standard deviations."""
    off = pose - reckoned
    off[2] = wrap_angle(off[2])
    return float(np.square(off / DRIFTED).sum())


def _cones(cycles: Sequence[SeenCycle], label: int, noise: MeasuredNoise) -> tuple[Array, Array]:
    """Return the cones (k, 2) of a vehicle that stands, vehicle frame, and their covariances (k, 2, 2)."""
    own = []
    for cycle in cycles:
        seen = cycle.detections
        chosen = (seen.labels == label) & (np.hypot(*seen.points_vehicle.T) < FAR)
        own.append(replace(cycle, detections=seen.where(chosen), pose=np.zeros(3), twist=np.zeros(3)))
    table = ConeTracker(noise).follow(sorted(own, key=lambda one: one.detections.t))
    numbers, counts = np.unique(table.cone, return_counts=True)
    points, seen_again = noise.corrected(table.point, np.zeros(3)), counts > SEEN_SHARE * len(cycles)
    means = [points[table.cone == cone].mean(axis=0) for cone in numbers[seen_again]]
    cones, count = np.array(means).reshape(-1, 2), int(np.median(counts[seen_again])) if means else 1
    covariances = replace(noise, count=count).covariances(cones, inflated=True)
    assert covariances is not None
    return cones, covariances / count


def _registered(
    start: list[tuple[Array, Array]], end: list[tuple[Array, Array]], pose: Array
) -> tuple[float, Array]:
    """Return the score of a registration and its pose (3,), by Gauss-Newton on nearest cones.

    Each paired cone adds 9 less its squared distance in sigmas.
    """
    score = 0.0
    for gate in GATES:
        information, vector, score, count = 1e-9 * np.eye(3), np.zeros(3), 0.0, 0
        for (known, known_covariance), (seen, seen_covariance) in zip(start, end, strict=True):
            if not len(known) or not len(seen):
                continue
            points = move_points(pose, seen)
            distance, nearest = map(np.asarray, KDTree(known).query(points))
            rows = np.flatnonzero(distance < gate)
            off = points[rows] - known[nearest[rows]]
            W = np.linalg.inv(known_covariance[nearest[rows]] + rotated(seen_covariance[rows], pose[None, 2]))
            square = np.einsum("ki,kij,kj->k", off, W, off)
            W *= huber_weights(np.sqrt(square), HUBER)[:, None, None]
            J = np.concatenate(
                [np.tile(np.eye(2), (len(rows), 1, 1)), left_of(points[rows] - pose[:2])[:, :, None]], axis=2
            )
            information += np.einsum("kia,kij,kjb->ab", J, W, J)
            vector += np.einsum("kia,kij,kj->a", J, W, off)
            score, count = score + float(np.maximum(9.0 - square, 0.0).sum()), count + len(rows)
        if count < LEAST:
            return 0.0, pose
        pose = pose - np.linalg.solve(information, vector)
    return score, pose


def motion_onto(points: Array, onto: Array) -> Array:
    """Return the motion (3,) that leads points (n, 2) onto others, by least squares (Umeyama 1991)."""
    middle, goal = points.mean(axis=0), onto.mean(axis=0)
    a, b = (points - middle) @ [1.0, 1j], (onto - goal) @ [1.0, 1j]
    turn = float(np.angle(np.vdot(a, b)))
    turned = complex(*middle) * np.exp(1j * turn)
    return np.array([goal[0] - turned.real, goal[1] - turned.imag, turn])
