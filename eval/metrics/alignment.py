"""Two maps of one track: how far apart they are when laid on each other, and where they differ in place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import ClassVar, Final

import gtsam
import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise, huber_weights
from pathspace_graph.factors.se2 import left_of, move_points, wrap_angle
from pathspace_graph.front_end.measurement import SeenCycle, Sightings
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary
from pathspace_graph.labels import BOUNDARIES, NAMES

from .accuracy import boundary_distances, cones_of, mapped_points, mean_of, near_pairs, root_mean_square

STEP: Final = 0.5  # distance of the points of a curve that are compared (m)


@dataclass(frozen=True, eq=False)
class MapsApart:
    """Distances between two maps of one track after the rigid motion that brings them together."""

    motion: Array
    """Pose (3,) of the first map's frame in that of the second."""
    points: dict[int, Array]
    """Points (k, 2) of each boundary in the frame of the second map, those of the first map first."""
    distances: dict[int, Array]
    """Their distances (k,) from the boundary of the other map (m)."""

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return mean, rms, 95th percentile and largest distance (m), of both boundaries and of each."""
        each = {NAMES[label]: own for label, own in sorted(self.distances.items())}
        both = np.concatenate([np.zeros(0), *self.distances.values()])
        return {
            name: {
                "mean": mean_of(own),
                "rms": root_mean_square(own),
                "p95": float(np.percentile(own, 95.0)),
                "max": float(own.max()),
            }
            for name, own in {"both": both, **each}.items()
        }


def maps_apart(track: Map, reference: Map) -> MapsApart:
    """Lay a map on another one of the same cones, and return how far apart they are.

    Each drive has its own map frame, and may have started anywhere. The least mean distance by closest points
    from several starts counts. SettingsError where the maps share no boundary.
    """
    shared = sorted(set(track.boundaries) & set(reference.boundaries))
    if not shared:
        raise SettingsError("maps: expected a boundary that both have, found none")
    first, second = ([of.boundaries[label] for label in shared] for of in (track, reference))
    points, others = ([mapped_points(boundary, STEP) for boundary in of] for of in (first, second))
    # about the same start, and about the same middle in the three best of all directions
    starts = [np.array([ahead, 0.0, 0.0]) for ahead in (0.0, -4.0, -2.0, 2.0, 4.0)]
    middle, target = (np.concatenate(of).mean(axis=0) for of in (points, others))
    trees, turned = [KDTree(own) for own in others], list[tuple[float, Array]]()
    for turn in np.arange(0.0, 2.0 * np.pi, np.deg2rad(2.0)).tolist():
        shift = target - move_points(np.array([0.0, 0.0, turn]), middle[None])[0]
        motion = np.append(shift, turn)
        pairs = zip(trees, points, strict=True)
        away = [tree.query(move_points(motion, own[::2]))[0] for tree, own in pairs]
        turned.append((mean_of(np.concatenate(away)), motion))
    turned.sort(key=lambda one: one[0])
    tries = []
    for start in starts + [motion for _, motion in turned[:3]]:
        motion = aligning(points, second, start)
        back, both, distances = se2.inverse(motion), dict[int, Array](), dict[int, Array]()
        for k, label in enumerate(shared):
            moved, returned = move_points(motion, points[k]), move_points(back, others[k])
            both[label] = np.concatenate([moved, others[k]])
            ways = boundary_distances(second[k], moved), boundary_distances(first[k], returned)
            distances[label] = np.concatenate(ways)
        motion = np.append(motion[:2], wrap_angle(motion[2:]))
        tries.append(MapsApart(motion, both, distances))
    return min(tries, key=lambda one: one.statistics()["both"]["mean"])


def aligned_distance(track: Map, reference: Map) -> float:
    """Return the mean two-way distance (m) of two maps; it is infinite where they share no boundary."""
    shared = set(track.boundaries) & set(reference.boundaries)
    return maps_apart(track, reference).statistics()["both"]["mean"] if shared else np.inf


def shape_rmse(track: Map, truth: Truth) -> float:
    """Return the rms distance (m) of the true cones from a map, after a rigid alignment.

    So the frame doesn't count, which the first pose fixes, but the shape alone.
    """
    labels = [label for label in BOUNDARIES if label in track.boundaries]
    cones, boundaries = [cones_of(truth, one) for one in labels], [track.boundaries[one] for one in labels]
    motion = aligning(cones, boundaries, np.zeros(3))
    pairs = zip(boundaries, cones, strict=True)
    distances = [boundary_distances(boundary, move_points(motion, own)) for boundary, own in pairs]
    return root_mean_square(np.concatenate([np.zeros(0), *distances]))


def aligning(points: Sequence[Array], boundaries: Sequence[MapBoundary], start: Array) -> Array:
    """Return the motion (3,) that lays points (k, 2) on boundaries, by closest points within 3 m."""
    motion = start
    for _ in range(30):
        rows, errors = [np.zeros((0, 3))], [np.zeros(0)]
        for own, boundary in zip(points, boundaries, strict=True):
            point, normal, position, _ = near_pairs(boundary, move_points(motion, own))
            lever = np.einsum("kd,kd->k", normal, left_of(point - motion[:2]))
            rows.append(np.column_stack([normal, lever]))
            errors.append(np.einsum("kd,kd->k", normal, position - point))
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(errors), rcond=None)[0]
        motion = motion + step
        if np.abs(step).max() < 1e-6:
            break
    return motion


@dataclass(frozen=True)
class MapDifference:
    """A stretch of a boundary that is not where the known map has it."""

    LENGTHS: ClassVar = {"x": 1, "y": 1, "length": 1, "distance": 1}

    boundary: str
    x: float
    """Place of the largest distance, m, map frame."""
    y: float
    length: float
    """Length of the stretch, m."""
    distance: float
    """Largest distance of the curve from the known one, m."""

    @property
    def line(self) -> str:
        place = f"at x = {self.x:.1f} m, y = {self.y:.1f} m"
        off = f"up to {self.distance:.2f} m from the known map"
        return f"the {self.boundary} boundary is {off} on {self.length:.0f} m, {place}"


def differences(known: Map, found: Map) -> list[MapDifference]:
    """Return the stretches of a found map that lie beside those of the known one, at scale 1.

    They are more than half a metre off, which is more than a refinement.
    """
    stretches = list[MapDifference]()
    for label in sorted(set(found.splines) & set(known.splines)):
        points = mapped_points(found.boundaries[label], STEP)
        away = boundary_distances(known.boundaries[label], points)
        differs = away > 0.5
        begins = np.flatnonzero(differs & ~np.append(False, differs[:-1]))
        for begin in begins.tolist():
            end = begin + int(np.append(differs[begin:], False).argmin())
            worst = begin + int(away[begin:end].argmax())
            x, y = points[worst].tolist()
            length = STEP * (end - begin)
            stretches.append(MapDifference(NAMES[label], x, y, length, float(away[worst])))
    return stretches


# --- registration of two maps ----------------------------------------------------------------------------


LEAST: Final = 6  # least number of cones of a registration, and of cycles in which a vehicle stands


def end_by_registration(cycles: Sequence[SeenCycle], noise: MeasuredNoise | None) -> Array | None:
    """Return the last pose (3,) of a drive, by the cones seen standing at its end and at its start.

    The closest points of the same colour are paired, from starts around dead reckoning, and the near ones
    weigh most. No motion, latency or odometry is in the result: odometry misses the first decimetres of a
    start, and goes on after a stop. The constant errors of the sensor are taken out. None where the vehicle
    does not stand, too few cones are seen meanwhile, or the noise was not measured.
    """
    sides = standing(cycles[::-1]), standing(cycles)
    if noise is None or not all(sides):
        return None
    start, end = ([_cones(own, label, noise) for label in BOUNDARIES] for own in sides)
    tries, reckoned = list[tuple[float, float, Array]](), cycles[-1].pose
    drifted = (2.0, 2.0, 0.1)  # standard deviations of dead reckoning at the end of a lap (m, m, rad)
    for offset in product((-4.0, -2.0, 0.0, 2.0, 4.0), (-2.0, 0.0, 2.0), (-0.1, 0.0, 0.1)):
        score, pose = _registered(start, end, se2.compose(reckoned, np.array(offset)))
        drift = float(np.square(se2.difference(pose, reckoned) / drifted).sum())
        tries.append((score - drift, score, pose))
    _, score, pose = max(tries, key=lambda one: one[0])
    return np.append(pose[:2], wrap_angle(pose[2:])) if score > 0.0 else None


def standing(cycles: Sequence[SeenCycle]) -> list[SeenCycle]:
    """Return the last of these cycles, at most 100, in which cones within 12 m stay where they are.

    Odometry may go on while the vehicle stands, so the cones decide: their median distance from those of one
    of the last cycles is under 0.5 m. Empty where they are too few cycles.
    """
    together = 9  # cycles that are looked at together, since single ones see few cones
    near = [cycle.detections.points_vehicle for cycle in cycles[-100:]]
    near = [points[np.hypot(*points.T) < 12.0] for points in near]
    most = KDTree(max(near[-together:], key=len))
    moved = [np.median(most.query(points)[0]) if most.n and len(points) else np.inf for points in near]
    stays = median_filter(np.array(moved) < 0.5, together, mode="nearest")
    count = int(np.argmin(stays[::-1])) - together // 2 if not stays.all() else len(stays)
    return list(cycles[-count:]) if count >= LEAST else []


def _cones(cycles: Sequence[SeenCycle], label: int, noise: MeasuredNoise) -> tuple[Array, Array]:
    """Return the cones (k, 2) of a vehicle that stands, vehicle frame, and their covariances (k, 2, 2).

    They are within 30 m, since farther ones scatter by metres, and are seen in a fifth of the cycles.
    """
    table = Sightings.of(sorted(cycles, key=lambda one: one.detections.t))
    table = table.where((table.cone == label) & (np.hypot(*table.point.T) < 30.0))
    table = replace(table, pose=0.0 * table.pose, twist=0.0 * table.twist).tracked(noise)
    numbers, counts = np.unique(table.cone, return_counts=True)
    points, seen_again = noise.corrected(table.point, np.zeros(3)), counts > 0.2 * len(cycles)
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
    for gate in (2.5, 2.0, 1.5, 1.5, 1.5):  # distance of paired cones (m)
        information, vector, score, count = 1e-9 * np.eye(3), np.zeros(3), 0.0, 0
        for (known, known_covariance), (seen, seen_covariance) in zip(start, end, strict=True):
            if not len(known) or not len(seen):
                continue
            points = move_points(pose, seen)
            distance, nearest = map(np.asarray, KDTree(known).query(points))
            rows = np.flatnonzero(distance < gate)
            off = points[rows] - known[nearest[rows]]
            W = np.linalg.inv(
                known_covariance[nearest[rows]] + se2.rotated(seen_covariance[rows], pose[None, 2])
            )
            square = np.einsum("ki,kij,kj->k", off, W, off)
            W *= huber_weights(np.sqrt(square), 1.5)[:, None, None]
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
    motion = gtsam.Pose2.Align(np.asfortranarray(onto.T), np.asfortranarray(points.T))
    assert motion is not None
    return np.array([motion.x(), motion.y(), motion.theta()])
