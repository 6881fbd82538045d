"""Two maps of one track: how far apart they are when laid on each other, and where they differ in place."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import inverse, left_of, move_points, wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary
from pathspace_graph.labels import BOUNDARIES, NAMES

from .accuracy import boundary_distances, cones_of, mapped_points, mean_of, root_mean_square
from .consistency import near_pairs

DIFFERENT: Final = 0.5  # distance of both curves from which on they differ (m): more than a refinement
STEP: Final = 0.5  # distance of the points of a curve that are compared (m)
AHEAD: Final = (0.0, -4.0, -2.0, 2.0, 4.0)  # where the other drive may have started, if in the same place (m)
TURN: Final = np.deg2rad(2.0)  # step of the headings that are tried where it may have started anywhere
TURNS: Final = 3  # best ones of these that are refined
STEPS: Final = 30  # most steps of Gauss-Newton
STILL: Final = 1e-6  # largest move of a step after which there is no further one (m, rad)


@dataclass(frozen=True, eq=False)
class MapsApart:
    """Distances between two maps of one track after the rigid motion that brings them together."""

    motion: Array
    """Pose (3,) of the first map's frame in that of the second."""
    points: dict[int, Array]
    """Points (k, 2) of each boundary in the frame of the second map, those of the first map first."""
    distances: dict[int, Array]
    """Their distances (k,) from the boundary of the other map (m)."""

    @property
    def mean(self) -> float:
        """Return the mean two-way distance (m); infinite where the maps share no boundary."""
        return self.statistics()["both"]["mean"] if self.distances else np.inf

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

    def to_json(self) -> dict[str, Any]:
        """Return the motion and the statistics in plain types."""
        return {"motion": self.motion, "distances": self.statistics()}


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
    tries = []
    for start in _starts(points, others):
        motion = aligning(points, second, start)
        back, both, distances = inverse(motion), dict[int, Array](), dict[int, Array]()
        for k, label in enumerate(shared):
            moved, returned = move_points(motion, points[k]), move_points(back, others[k])
            both[label] = np.concatenate([moved, others[k]])
            ways = boundary_distances(second[k], moved), boundary_distances(first[k], returned)
            distances[label] = np.concatenate(ways)
        motion = np.append(motion[:2], wrap_angle(motion[2:]))
        tries.append(MapsApart(motion, both, distances))
    return min(tries, key=lambda one: one.mean)


def aligned_distance(track: Map, reference: Map) -> float:
    """Return the mean two-way distance (m) of two maps; it is infinite where they share no boundary."""
    shared = set(track.boundaries) & set(reference.boundaries)
    return maps_apart(track, reference).mean if shared else np.inf


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


def _starts(points: Sequence[Array], others: Sequence[Array]) -> list[Array]:
    """Return motions (3,) to begin with: about the same start, and about the same middle in any direction."""
    starts = [np.array([ahead, 0.0, 0.0]) for ahead in AHEAD]
    middle, target = (np.concatenate(of).mean(axis=0) for of in (points, others))
    trees, turned = [KDTree(own) for own in others], list[tuple[float, Array]]()
    for turn in np.arange(0.0, 2.0 * np.pi, TURN).tolist():
        shift = target - move_points(np.array([0.0, 0.0, turn]), middle[None])[0]
        motion = np.append(shift, turn)
        pairs = zip(trees, points, strict=True)
        away = [tree.query(move_points(motion, own[::2]))[0] for tree, own in pairs]
        turned.append((mean_of(np.concatenate(away)), motion))
    turned.sort(key=lambda one: one[0])
    return starts + [motion for _, motion in turned[:TURNS]]


def aligning(points: Sequence[Array], boundaries: Sequence[MapBoundary], start: Array) -> Array:
    """Return the motion (3,) that lays points (k, 2) on boundaries, by closest points within 3 m."""
    motion = start
    for _ in range(STEPS):
        rows, errors = [np.zeros((0, 3))], [np.zeros(0)]
        for own, boundary in zip(points, boundaries, strict=True):
            point, normal, position, _ = near_pairs(boundary, move_points(motion, own))
            lever = np.einsum("kd,kd->k", normal, left_of(point - motion[:2]))
            rows.append(np.column_stack([normal, lever]))
            errors.append(np.einsum("kd,kd->k", normal, position - point))
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(errors), rcond=None)[0]
        motion = motion + step
        if np.abs(step).max() < STILL:
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
    """Return the stretches of a found map that lie beside those of the known one, at scale 1."""
    stretches = list[MapDifference]()
    for label in sorted(set(found.splines) & set(known.splines)):
        points = mapped_points(found.boundaries[label], STEP)
        away = boundary_distances(known.boundaries[label], points)
        differs = away > DIFFERENT
        begins = np.flatnonzero(differs & ~np.append(False, differs[:-1]))
        for begin in begins.tolist():
            end = begin + int(np.append(differs[begin:], False).argmin())
            worst = begin + int(away[begin:end].argmax())
            x, y = points[worst].tolist()
            length = STEP * (end - begin)
            stretches.append(MapDifference(NAMES[label], x, y, length, float(away[worst])))
    return stretches
