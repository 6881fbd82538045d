"""Knots of the batch's curves: about one for each cone at the optimum, few in the map.

Simplification: the curves of the optimum on few knots, their covariance, and the scatter of cones about them.
"""

from dataclasses import dataclass, fields, replace
from typing import ClassVar, Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.graph.variables import CONTROL_LETTERS, POINT, Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import ExactSplineSettings, MapperSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import (
    ENERGY_WEIGHT,
    BSpline,
    LeastSquares,
    chosen_breaks,
    fewest_breaks,
    fit_spline,
    sparse_rows,
)

from .association import ROW_CONES, associate, cones_of_curve, feet_of_cones, locate_poses

MIN_SIZE_SHARE: Final = 0.6  # least number of control points tried, relative to the largest
NEED_STEP: Final = 1.0  # distance of the points of a line's curve that determine its number of knots (m)
MOST_NEEDED: Final = 400  # largest number of these points; bounds the time
FOLDS: Final = 4  # groups of the cross-validation, interleaved so that the neighbours of a cone remain


def reknot(state: State, detections: DetectionTable, settings: MapperSettings) -> State:
    """Fit every curve of a state again, on knots enough to meet the cones along it."""
    state = state.copy()
    for label, boundary in list(state.boundaries.items()):
        points = cones_of_curve(state, detections, label, settings).points
        if len(points) < ROW_CONES:
            continue
        if not boundary.periodic:
            points = extended(points, settings.growth.merge_radius)
        spline, _ = fit_through(points, boundary.periodic, settings, settings.batch.dense_share, 1.0)
        state.replace_boundary(label, *boundary_of(spline, settings))
    return state


def fit_through(
    points: Array, periodic: bool, settings: MapperSettings, share: float, least_share: float = MIN_SIZE_SHARE
) -> tuple[BSpline, Array]:
    """Fit the best curve through ordered cones (k, 2), with at most `share` control points for each.

    It has at least the share `least_share` of that number. A closed curve begins at the cone nearest to the
    start, so that similar cones give similar knots. The second result are the cones' parameters (k,).
    """
    smallest, degree = settings.spline.min_size, settings.spline.degree
    most = max(smallest, int(share * len(points)))
    first = int(np.hypot(*points.T).argmin()) if periodic else 0
    points = np.roll(points, -first, axis=0)
    chosen = chosen_breaks(points, periodic, degree, max(smallest, int(least_share * most)), most)
    spline, u = fit_spline(points, chosen.breaks, periodic, degree)
    return spline, np.roll(u, first)


def fit_line(points: Array, periodic: bool, settings: SplineSettings) -> tuple[BSpline, Array]:
    """Fit the curve on fewest knots that follows points (k, 2) of a line within half of `sigma_shape`.

    This increases the standard deviation by an eighth. A line has no cones to determine its number of knots.
    The second result are the points' parameters (k,).
    """
    chosen = fewest_breaks(points, periodic, settings.degree, settings.min_size, 0.5 * settings.sigma_shape)
    return fit_spline(points, chosen.breaks, periodic, settings.degree)


def extended(points: Array, beyond: float) -> Array:
    """Add a point before the first and after the last of cones (k, 2), `beyond` (m) straight ahead.

    Half of the last cone's detections lie beyond it. If the curve ended there, its motion would drop some.
    """
    ends, inner = points[[0, -1]], points[[1, -2]]
    ahead = (ends - inner) / np.maximum(np.hypot(*(ends - inner).T), np.finfo(float).tiny)[:, None]
    first, last = ends + beyond * ahead
    return np.concatenate([first[None], points, last[None]])


def boundary_of(spline: BSpline, settings: MapperSettings) -> tuple[Boundary, Array]:
    """Convert a curve to a confirmed boundary; return it and its control points (m, 2)."""
    spline = spline if spline.periodic else spline.unclamp()
    boundary = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline))
    boundary.confirmed_end = boundary.tables.high
    return boundary, spline.distinct_control_points


def exact_settings(spline: SplineSettings) -> ExactSplineSettings:
    """Return a curve's settings with more exact foot points than online, as an optimum needs."""
    return ExactSplineSettings(**{entry.name: getattr(spline, entry.name) for entry in fields(spline)})


def own_settings(settings: MapperSettings) -> MapperSettings:
    """Return the settings with the batch's values in the groups that it shares with online mapping."""
    batch = settings.batch
    return replace(
        settings,
        spline=replace(settings.spline, sigma_model=batch.sigma_model),
        gauge=replace(settings.gauge, sigma_smoothness=batch.sigma_smoothness),
    )


# --- scatter ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scatter:
    """Distance of cones from the simplified curves, a variance to add to that of the curves.

    `sigma^2(u) = seen^2 + (d / s)^2 (unseen^2 - seen^2)`, where d is the distance along the curve from u to
    the nearest detected cone, and s the median distance of two such cones. A cone that was never detected (d
    = s) is missed by as much as a detected one that is left out of knots and fit.
    """

    LENGTHS: ClassVar = {"seen": 1, "unseen": 1, "places": 1, "lengths": 1}

    seen: float  # rms distance of the detected cones from the curves (m)
    unseen: float  # rms distance of the same cones from curves that are fitted without them (m)
    places: dict[int, Array]  # (k,) parameters of the detected cones of each boundary (m)
    lengths: dict[int, float]  # length of each curve in its parameter (m); infinite if open

    def sigma(self, label: int, u: Array) -> Array:
        """Standard deviation (m,) of the scatter at parameters u (m,) of a boundary, in m."""
        places = self.places.get(label, np.zeros(0))
        if len(places) < 2:
            return np.full(len(u), self.unseen)
        distance = np.abs(u[:, None] - places)
        length = self.lengths[label]
        if np.isfinite(length):
            distance = np.mod(distance, length)
            distance = np.minimum(distance, length - distance)
        share = distance.min(axis=1) / np.median(np.diff(np.sort(places)))
        return np.asarray(np.sqrt(self.seen**2 + share**2 * max(self.unseen**2 - self.seen**2, 0.0)))

    def of_control_points(self, label: int, boundary: Boundary) -> Array:
        """Standard deviation (m,) of control points that gives a boundary's curve the scatter, in m.

        A point of a curve is a mean of control points with weights beta, which reduces their independent
        errors by `sqrt(sum beta^2)`.
        """
        u = boundary.abscissae
        (basis,), _ = boundary.tables.evaluate(u)
        return np.asarray(self.sigma(label, u) / np.sqrt((basis**2).sum(axis=1)))


def scatter_about(state: State, detections: DetectionTable, settings: MapperSettings) -> Scatter:
    """Compute the scatter of the detected cones about the curves of the state.

    A line has points in place of cones (`association:points_along`), and none in a gap.
    """
    seen, unseen, places, lengths = [], [], {}, {}
    for label, boundary in state.boundaries.items():
        lengths[label] = boundary.length if boundary.periodic else np.inf
        cones = cones_of_curve(state, detections, label, settings)
        foot, share = feet_of_cones(state, cones, label), boundary.size / max(len(cones.u), 1)
        seen.append(foot.distance)
        unseen.append(cross_validated(cones.points, boundary.periodic, settings, share))
        places[label] = foot.u
    return Scatter(_rms(seen), _rms(unseen), places, lengths)


def cross_validated(points: Array, periodic: bool, settings: MapperSettings, share: float) -> Array:
    """Distances of cones (k, 2) from curves that are fitted without them, in m, in any order."""
    number = np.arange(len(points))
    ends = np.zeros(len(points), bool) if periodic else (number == 0) | (number == len(points) - 1)
    distances = [np.zeros(0)]
    for fold in range(FOLDS):
        out = (number % FOLDS == fold) & ~ends
        if (~out).sum() < ROW_CONES:
            continue
        spline, _ = fit_through(points[~out], periodic, settings, share)
        low, high = (np.full(out.sum(), end) for end in spline.domain)
        step = settings.spline.search_step
        foot = foot_points(spline.tables, spline.control_points, points[out], low, high, step)
        distances.append(np.minimum(np.abs(foot.distance), settings.gate.rough))
    return np.concatenate(distances)


def _rms(parts: list[Array]) -> float:
    values = np.concatenate([np.zeros(0), *parts])
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


# --- simplification --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Simplified:
    """The poses of an optimum with curves on few knots."""

    state: State
    change: Array  # F (k, n) of all control points
    detections: DetectionTable  # copy, associated with these curves
    scatter: Scatter


def simplified(state: State, detections: DetectionTable, settings: MapperSettings) -> Simplified:
    """Return the same poses with curves on few knots (paper: Simplification).

    The fit is linear in the points that it follows, and so in the old control points: `C_new = F C_old`, and
    the covariance is `F Sigma F'`. The points are those of the old curve beside the cones, some of which are
    outliers. The optimum itself is not solved on few knots: such a curve misses its cones by a decimetre, on
    the same side in every lap, which rotates vehicle and map by up to a degree in the first seconds. The
    detections are associated with the new curves.
    """
    few, changes = state.copy(), {}
    for label, boundary in state.boundaries.items():
        old, periodic, changes[label] = state.spline(label), boundary.periodic, np.eye(boundary.size)
        cones = cones_of_curve(state, detections, label, settings)
        if len(cones.points) < ROW_CONES:
            continue
        if settings.of_lines:
            step = max(NEED_STEP, old.length() / MOST_NEEDED)
            u = np.linspace(*old.domain, max(int(boundary.length / step), 1) + 1)[: -1 if periodic else None]
            new, w = fit_line(old.evaluate(u), periodic, settings.spline)
        else:
            u = feet_of_cones(state, cones, label).u
            new, w = fit_through(old.evaluate(u), periodic, settings, settings.batch.size_share)
        replaced, points = boundary_of(new, settings)
        fit = LeastSquares(replaced.spline(points), w, ENERGY_WEIGHT)
        changes[label] = fit.solve(sparse_rows(*old.local_basis(u), old.size))
        few.replace_boundary(label, replaced, points)
    change = np.zeros((few.map_points.size, state.map_points.size))
    for label, F in changes.items():
        change[map_block(few, label), map_block(state, label)] = np.kron(F, np.eye(POINT))
    detections = detections.copy()
    locate_poses(few)
    associate(few, detections, settings, settings.batch.gate, strict=True)
    return Simplified(few, change, detections, scatter_about(few, detections, settings))


def map_block(state: State, label: int) -> slice:
    """Block of a boundary's control points in a joint covariance of all boundaries."""
    return Layout(state.map_keys).block(CONTROL_LETTERS[label])
