"""Constellations: cones, merged and without identity, in one frame, as they are seen or known."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Final, Self

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import (
    difference,
    left_of,
    move_points,
    path_lengths,
    rotated,
    to_map,
    to_vehicle,
)
from pathspace_graph.labels import BOUNDARIES, UNKNOWN
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.tracks import Tracks
from pathspace_graph.settings.mapper import GrowthSettings
from pathspace_graph.spline.bspline import BSpline

FIT_SIGMA: Final = 0.25  # standard deviation added to a cone's covariance, for slow errors of the sensor (m)
FIT_GATE: Final = 9.0  # cap of a cone's square (sigmas^2); beyond it, the cone lies on no other
VOTE_CELL: Final = 0.5  # cell size of the votes (m)
VOTE_TURN: Final = 0.05  # step of the headings (rad)
PLACES_APART: Final = 1.0  # least distance of two different places (m)
PLACES: Final = 10  # largest number of places for each heading, and a third of those refined
MATCHING: Final = 2.0
"""Expected square of a matching cone in 2D: the largest mean at a place, and cost of a cone out of view."""
FAILED: Final = 20.0  # largest cost of the distance from a prior: twice the log odds against its failure
FIT_LIMITS: Final = (FIT_SIGMA, FIT_GATE, VOTE_CELL, VOTE_TURN, PLACES_APART, float(PLACES), MATCHING, FAILED)
REACH: Final = (6.0, 0.2)  # largest distance and angle of a place from a pose on a path (m, rad)
MERGE_RANGE: Final = 16.0  # largest range of merged detections (m)
VIEWED: Final = 0.95  # share of the detections within the range and the bearing of a view
PATH_STEP: Final = 2.0  # distance of neighbouring poses from which cones are seen, or a place is tried (m)
LINE_WEIGHT: Final = 0.25
"""Weight of a point of a line, merged to about 1 m: neighbours on a line say the same for 4 m."""

CURVE_SIGMA: Final = 0.12  # standard deviation added across a curve, which passes slow errors by (m)
CURVE_STEP: Final = 0.2  # step of the sampled curves (m)
BEGINNING: Final = 60.0  # length of open curves that counts as their beginning (m)
BEGINNING_SHARE: Final = 0.6  # largest share of a short curve that counts as its beginning
REGULAR: Final[Array] = np.diag([1e-2, 1e-2, 1.0])  # information without any curve (1/m^2, 1/m^2, 1/rad^2)
CURVE_GATES: Final = (3.0, 2.0, 1.2, 0.7)  # largest distance from a curve, by iteration (m)

ConeArrays = tuple[Array, Array, IntArray]
"""Points (n, 2), covariances (n, 2, 2) and labels (n,) of cones."""
EVERYWHERE: Final[Array] = np.array([[0.0, 0.0, 0.0, inf, inf]])
"""View of a complete constellation."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Poses at which a vehicle may be, equally likely, each a Gaussian of the same covariance."""

    poses: Array  # (k, 3) map frame
    information: Array  # (3, 3) map frame
    reach: tuple[float, float] = REACH  # largest distance and angle from a pose that is tried (m, rad)
    failed: float = FAILED  # cost of the vehicle at none of them: twice the log odds against it
    along: Array | None = None  # (j, 3) poses that are tried, where `poses` is a single one

    @classmethod
    def about(
        cls,
        poses: Array,
        sigmas: tuple[float, float, float],
        reach: tuple[float, float] = REACH,
        failed: float = FAILED,
    ) -> Self:
        """Return a prior with standard deviations (m, m, rad)."""
        return cls(np.atleast_2d(poses), np.diag(np.array(sigmas) ** -2.0), reach, failed)

    @property
    def tried(self) -> Array:
        """Poses (j, 3) about which places are searched."""
        return self.poses if self.along is None else self.along

    @property
    def means(self) -> Array:
        """Means (j, 3) of the Gaussians at the poses that are tried."""
        return np.ascontiguousarray(np.broadcast_to(self.poses, self.tried.shape))


@dataclass(frozen=True, eq=False)
class Fits:
    """Poses at which seen cones fit on known ones, each by its n seen cones."""

    poses: Array  # (k, 3) map frame
    information: Array  # (k, 3, 3) of the pose, from the cones that lie on others, without the prior
    squares: Array  # (k,) sum of the capped squares of the cones in view of what is known
    counts: Array  # (k,) number of these cones
    away: Array  # (k,) squared Mahalanobis distance from the prior

    @classmethod
    def joined(cls, fits: list["Fits"]) -> "Fits":
        columns = zip(*(vars(one).values() for one in fits), strict=True)
        return cls(*map(np.concatenate, columns))


@dataclass(frozen=True, eq=False)
class Constellation:
    """Cones in one frame, or points of lines."""

    points: Array  # (n, 2) in m
    covariances: Array  # (n, 2, 2) in m^2
    labels: IntArray  # (n,)
    views: Array = field(default_factory=EVERYWHERE.copy)
    """(k, 5) poses from which cones were detected, with range (m) and largest bearing (rad) of a view."""
    weight: float = 1.0  # weight of each cone or point in the sum of squares

    @classmethod
    def of(
        cls,
        table: DetectionColumns,
        poses: Array,
        settings: GrowthSettings,
        *,
        of_lines: bool = False,
    ) -> Self:
        """Merge detections, the most certain first, to cones in the map frame, by poses (P, 3) of cycles."""
        point = table.point
        rows = np.flatnonzero((table.label != UNKNOWN) & (np.hypot(*point.T) < MERGE_RANGE))
        rows = rows[np.argsort(np.trace(table.covariance[rows], axis1=1, axis2=2), kind="stable")]
        at = poses[table.cycle[rows]]
        points, covariances = to_map(point[rows], at), rotated(table.covariance[rows], at[:, 2])
        tracks = Tracks(settings.merge_radius, np.inf)
        tracks.add(points, covariances, table.label[rows], np.arange(len(rows), dtype=float))
        seen = np.concatenate([tracks.confirmed(label, settings.sightings) for label in BOUNDARIES])
        labels = tracks.votes[seen].argmax(axis=1)
        covariances = np.asarray(np.linalg.inv(tracks.information[seen]), np.float64)
        views = _views(poses[np.unique(table.cycle)], point[rows])
        return cls(tracks.points[seen], covariances, labels, views, LINE_WEIGHT if of_lines else 1.0)

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def cones(self) -> ConeArrays:
        return self.points, self.covariances, self.labels

    def seen_from(self, pose: Array) -> Self:
        """Transform the cones to the frame of a pose (3,)."""
        turned = rotated(self.covariances, np.full(len(self), -pose[2]))
        return replace(self, points=to_vehicle(self.points, pose[None]), covariances=turned)

    def relabelled(self, labels: Mapping[int, int]) -> Self:
        """Return the same cones with other labels."""
        return replace(self, labels=np.array([labels[label] for label in self.labels.tolist()], np.intp))

    def fits(self, seen: "Constellation", prior: Prior) -> Fits:
        """Fit cones seen in the vehicle frame on these, about each pose of a prior.

        All pairs of a seen and a known cone of one label vote for the pose that lays one on the other. The
        poses with most votes near the prior's are refined on a sum of capped squares.
        """
        searched = prior.tried, prior.means, prior.information, prior.reach
        return Fits(*kernels.laid(seen.cones, self.cones, self.views, *searched, FIT_LIMITS))


def _views(poses: Array, points: Array) -> Array:
    """Views (k, 5) from poses (P, 3), `PATH_STEP` apart, with the limits of the detections (m, 2)."""
    if len(points) == 0:
        return np.zeros((0, 5))
    far, wide = np.quantile(np.abs([np.hypot(*points.T), np.arctan2(*points.T[::-1])]), VIEWED, axis=1)
    _, first = np.unique(path_lengths(poses) // PATH_STEP, return_index=True)
    return np.column_stack([poses[first], np.tile([far, wide], (len(first), 1))])


# --- known curves ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SampledCurves:
    """Known curves by label, `CURVE_STEP` apart, for lines and where no cones are known."""

    points: Mapping[int, Array]  # (n, 2) in m, map frame
    normals: Mapping[int, Array]  # (n, 2) unit normals
    trees: Mapping[int, KDTree]
    open: bool  # whether a point beyond an end is out of view

    @classmethod
    def of(cls, splines: Mapping[int, BSpline], ends: Mapping[int, float] | None = None) -> Self:
        """Sample curves, or the beginning of open ones with confirmed ends (m)."""
        points, normals = dict[int, Array](), dict[int, Array]()
        for label, spline in splines.items():
            low, high = spline.domain
            end = high if ends is None else min(high, beginning_of(ends[label]))
            u = np.linspace(low, end, max(int((end - low) / CURVE_STEP), 1) + 1)
            points[label], normals[label] = spline.evaluate(u), left_of(spline.tangent_unit(u))
        trees = {label: KDTree(curve) for label, curve in points.items()}
        is_open = ends is not None or not all(spline.periodic for spline in splines.values())
        return cls(points, normals, trees, is_open)

    def relabelled(self, labels: Mapping[int, int]) -> Self:
        """Return the same curves with other labels."""
        points = {labels[label]: one for label, one in self.points.items()}
        normals = {labels[label]: one for label, one in self.normals.items()}
        trees = {labels[label]: one for label, one in self.trees.items()}
        return type(self)(points, normals, trees, self.open)

    def fits(self, seen: Constellation, prior: Prior) -> Fits:
        """Fit cones or points of lines, seen in the vehicle frame, on the curves from each pose of a prior.

        Iterated closest points minimize the sum of squares across the curves, with the prior.
        """
        pairs = zip(prior.tried, prior.means, strict=True)
        return Fits.joined([self._fit(seen, start, mean, prior.information) for start, mean in pairs])

    def _fit(self, seen: Constellation, start: Array, mean: Array, information: Array) -> Fits:
        pose, H = start, np.zeros((3, 3))
        for gate in CURVE_GATES:
            off, jacobian, variance, inside = self._rows(seen, pose)
            weight = np.where(inside & (np.abs(off) < gate), seen.weight / variance, 0.0)
            H = np.asarray((jacobian * weight[:, None]).T @ jacobian)
            gradient = jacobian.T @ (weight * off) + information @ difference(pose, mean)
            pose = pose - np.linalg.solve(H + information, gradient)
        off, _, variance, inside = self._rows(seen, pose)
        squares = np.minimum(off**2 / variance, FIT_GATE)[inside]
        away = difference(pose, mean)
        return Fits(
            pose[None],
            (H + REGULAR)[None],
            np.array([seen.weight * squares.sum()]),
            np.array([seen.weight * inside.sum()]),
            np.array([away @ information @ away]),
        )

    def _rows(self, seen: Constellation, pose: Array) -> tuple[Array, Array, Array, BoolArray]:
        """Return signed distances (n,) across, derivatives (n, 3), variances (n,), and which are in view."""
        points = move_points(pose, seen.points)
        covariances = rotated(seen.covariances, np.full(len(seen), pose[2]))
        off, normal, inside = np.zeros(len(seen)), np.zeros((len(seen), 2)), np.zeros(len(seen), bool)
        for label, tree in self.trees.items():
            own = np.flatnonzero(seen.labels == label)
            if len(own) == 0:
                continue
            _, nearest = tree.query(points[own])
            normal[own] = self.normals[label][nearest]
            off[own] = ((points[own] - self.points[label][nearest]) * normal[own]).sum(axis=1)
            last = len(self.points[label]) - 1
            inside[own] = (not self.open) | ((nearest > 0) & (nearest < last))
        turning = (normal * left_of(points - pose[:2])).sum(axis=1)
        variance = np.einsum("mi,mij,mj->m", normal, covariances, normal) + CURVE_SIGMA**2
        return off, np.column_stack([normal, turning]), variance, inside


def beginning_of(end: float) -> float:
    """Return the length (m) of the beginning of an open curve that is confirmed up to an end (m)."""
    return min(BEGINNING, BEGINNING_SHARE * end)


Known = Constellation | SampledCurves
