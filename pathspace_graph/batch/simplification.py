"""Simplification: the optimum's curves on few knots, their covariance, and how far cones lie from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.graph.keys import CONTROL_LETTERS, POINT
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.knots import refit

from .association import associate, find_anywhere, locate_poses
from .cones import cones_of_curve, first_parameter
from .knots import fit_through, reknot

Array = NDArray[np.float64]

ALIKE: Final = (3.0, 0.01)
"""Parameters of two curves through the same cones differ by less than `a + b L` (m), with L their length."""


def simplify(
    state: State, covariance: Array, detections: DetectionTable, settings: MapperSettings
) -> tuple[State, Array]:
    """Returns the same poses beside curves on few knots, and the joint covariance (n, n) of their control
    points (paper: Simplification).

    `C_new = F C_old`, so the covariance is `F Sigma F'`, with Sigma the given covariance of the state's
    control points. The optimum isn't solved for on few knots: such a curve would pass its cones by a
    decimetre, on the same side in every lap, which no number of detections averages out. In the first seconds
    that turns the vehicle, and with it the whole map, by up to a degree, several times its claimed sigma.
    """
    few, change = simplified(state, detections, settings)
    locate_poses(few, settings.batch.association)
    associate(few, detections, settings, settings.batch.gate, strict=True)
    return few, change @ covariance @ change.T


def simplified(state: State, detections: DetectionTable, settings: MapperSettings) -> tuple[State, Array]:
    """Returns the same poses beside curves on few knots, and the change F (k, n) of the control points."""
    few = reknot(state, detections, settings)
    change = np.zeros((few.map_points.size, state.map_points.size))
    for label, boundary in state.boundaries.items():
        new, new_points = few.boundaries[label], few.control_points(label)
        F = new_from_old(boundary, state.control_points(label), new, new_points)
        change[map_block(few, label), map_block(state, label)] = np.kron(F, np.eye(POINT))
    return few, change


def new_from_old(old: Boundary, old_points: Array, new: Boundary, new_points: Array) -> Array:
    """Returns F (m_new, m_old): least squares over points of the old curve and their foot points on the new.

    old_points (m_old, 2) and new_points (m_new, 2) are the curves' control points. An open dense curve goes
    on beyond the ends of the new one, which doesn't count.
    """

    splines = old.spline(old_points), new.spline(new_points)
    if new.periodic:
        return refit(
            *splines, lambda u: find_anywhere(new, new_points, old.evaluate(old_points, u)).u
        ).new_from_old
    # an open curve that passes the same cones again lies on itself, so it is searched near the same place
    ends, quarter = np.array([new.tables.low, new.tables.high]), 0.25 * (old.tables.high - old.tables.low)
    low = np.array([old.tables.low, old.tables.high - quarter])
    first, last = old.find(old_points, new.evaluate(new_points, ends), low, low + quarter).u.tolist()
    room = ALIKE[0] + ALIKE[1] * (ends[1] - ends[0])

    def foot_on_new(u: Array) -> Array:
        alike = ends[0] + (u - first) * (ends[1] - ends[0]) / (last - first)
        low, high = (np.clip(alike + side * room, *ends) for side in (-1.0, 1.0))
        return new.find(new_points, old.evaluate(old_points, u), low, high).u

    return refit(*splines, foot_on_new, (first, last)).new_from_old


def map_block(state: State, label: int) -> slice:
    """Returns where the control points of a boundary are in a joint covariance of all boundaries."""
    return Layout(state.map_keys).block(CONTROL_LETTERS[label])


# --- scatter ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scatter:
    """Holds how far cones lie from the simplified curves: a variance to be added to that of the curves.

    `sigma^2(u) = seen^2 + (d / s)^2 (unseen^2 - seen^2)`, where d is the distance along the curve from u to
    the nearest detected cone, and s is the usual distance of two such cones. A detected cone is missed by
    `seen`. A cone that was never detected (d = s) is missed by as much as a detected one that is left out
    where the knots are chosen and the curve is fitted: that is a cross-validation. Without the scatter, the
    claimed covariance is right at detected cones, and several times too small at the others.
    """

    LENGTHS: ClassVar = {"seen": 1, "unseen": 1, "places": 1, "lengths": 1}

    seen: float
    """This is the root mean square distance of the detected cones from the curves (m)."""
    unseen: float
    """This is their root mean square distance from curves that are fitted without them (m)."""
    places: dict[int, Array]
    """For each boundary, these are the parameters (k,) of its detected cones (m)."""
    lengths: dict[int, float]
    """For each boundary, this is the length of a closed curve in units of its parameter, else infinity."""

    def sigma(self, label: int, u: Array) -> Array:
        """Returns the standard deviation (m,) of the scatter at parameters u (m,) of a boundary, in m."""
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


def scatter_of_cones(state: State, detections: DetectionTable, settings: MapperSettings) -> Scatter:
    """Returns the scatter of the detected cones about the curves of the state."""
    seen, unseen = [np.zeros(0)], [np.zeros(0)]
    places, lengths = {}, {}
    room = settings.batch.scatter.foot_room
    for label, boundary in state.boundaries.items():
        cones = cones_of_curve(state, detections, label, settings)
        u, share = first_parameter(state, label) + cones.u, boundary.size / max(len(cones.u), 1)
        foot = boundary.find(state.control_points(label), cones.points, u - room, u + room)
        seen.append(foot.distance)
        unseen.append(cross_validated(cones.points, boundary.periodic, settings, share))
        places[label] = foot.u
        lengths[label] = boundary.length if boundary.periodic else np.inf
    return Scatter(_rms(np.concatenate(seen)), _rms(np.concatenate(unseen)), places, lengths)


def cross_validated(points: Array, periodic: bool, settings: MapperSettings, share: float) -> Array:
    """Returns the distance of each cone (k, 2) from a curve that is fitted without it, in m, in any order.

    `share` is the number of control points per cone. The first and the last cone of an open curve are never
    left out, since nothing is known beyond them, so they have no distance.
    """
    folds, number = settings.batch.scatter.folds, np.arange(len(points))
    ends = np.zeros(len(points), bool) if periodic else (number == 0) | (number == len(points) - 1)
    distances = [np.zeros(0)]
    for fold in range(folds):
        out = (number % folds == fold) & ~ends
        if (~out).sum() < settings.batch.cones.min_count:
            continue
        spline = fit_through(points[~out], periodic, settings, share)
        low, high = (np.full(out.sum(), end) for end in spline.domain)
        step = settings.spline.search_step
        foot = foot_points(spline.tables, spline.control_points, points[out], low, high, step)
        distances.append(np.minimum(np.abs(foot.distance), settings.gate.rough))
    return np.concatenate(distances)


def _rms(values: Array) -> float:
    """Returns the root mean square, 0 of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
