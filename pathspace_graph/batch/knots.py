"""Knots of the batch's curves: nearly one for each cone for the optimum, few for the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import CONTROL_LETTERS
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.knots import FitSettings
from pathspace_graph.settings.mapper import MapperSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.cone_knots import chosen_breaks
from pathspace_graph.spline.knots import fit_spline, refit

from .association import associate, locate_poses
from .cones import FEWEST, cone_clusters

Array = NDArray[np.float64]


FEWER = 0.6
"""Curves of fewer control points than this share of the most aren't looked at."""


def knot_count(cones: int, share: float, least: int) -> int:
    """Control points of a boundary along which so many cones were sighted."""
    return max(least, int(share * cones))


def on_knots_of(spline: BSpline, settings: MapperSettings) -> tuple[Boundary, Array]:
    """A boundary that is this curve, all of it confirmed, and its control points (m, 2)."""
    spline = spline if spline.periodic else spline.unclamp()
    boundary = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline), settings.gauge)
    boundary.confirmed_end = boundary.tables.high
    return boundary, spline.distinct_control_points


def reknot(state: State, detections: DetectionTable, settings: MapperSettings, dense: bool = False) -> State:
    """Every curve anew, through the cones sighted along it; `dense`: on so many knots that it meets them."""
    state = state.copy()
    cones = {label: cone_clusters(state, detections, label, settings) for label in state.boundaries}
    share = size_share({label: len(own.points) for label, own in cones.items()}, settings)
    for label, boundary in list(state.boundaries.items()):
        points = cones[label].points
        if len(points) < FEWEST:
            continue
        if dense:
            spline = dense_through(points, boundary.periodic, settings)
        else:
            spline = fit_through(points, boundary.periodic, settings, share)
        state.replace_boundary(label, *on_knots_of(spline, settings))
    return state


def size_share(cones: Mapping[int, int], settings: MapperSettings) -> float:
    """Control points by cones: the settings' own, or what keeps the budget of both boundaries together."""
    size, total = settings.batch.size, sum(cones.values())
    return settings.batch.size_share if size is None or total == 0 else size / total


def fit_through(points: Array, periodic: bool, settings: MapperSettings, share: float) -> BSpline:
    """A curve through cones (k, 2) in the order of travel, of so many control points by cones.

    A closed one is counted from the cone nearest to the start, so that nearly the same cones give nearly the
    same knots.
    """
    most = knot_count(len(points), share, settings.spline.min_size)
    return _through(points, periodic, settings, max(settings.spline.min_size, int(FEWER * most)), most)


def dense_through(points: Array, periodic: bool, settings: MapperSettings) -> BSpline:
    """The same on nearly a knot for each cone."""
    size = knot_count(len(points), settings.batch.dense_share, settings.spline.min_size)
    return _through(points, periodic, settings, size, size)


def _through(points: Array, periodic: bool, settings: MapperSettings, least: int, most: int) -> BSpline:
    if periodic:
        points = np.roll(points, -int(np.hypot(*points.T).argmin()), axis=0)
    fit = FitSettings(degree=settings.spline.degree, rounds=1)
    chosen = chosen_breaks(points, periodic, fit, least, most)
    return fit_spline(points, chosen.size, periodic, fit, chosen.breaks)


def exact_settings(spline: SplineSettings) -> SplineSettings:
    """Foot points are followed as far as it takes: an optimum needs exact ones."""
    return replace(spline, refine_iterations=2, refine_room=8.0, search_iterations=4)


def simplified(
    state: State, covariance: Array, detections: DetectionTable, settings: MapperSettings
) -> tuple[State, Array]:
    """The same poses beside curves on the knots that the cones ask for, and their joint covariance (n, n).

    `C_new = F C_old`, so `F Sigma F'` with the given covariance Sigma of the state's control points. Solved
    for on few knots, a curve would pass its cones by a decimetre on the same side in every lap, which no
    number of readings averages out: in the first seconds that turns the vehicle, and with it the whole map,
    by up to a degree, several times what its covariance says.
    """
    following = reknot(state, detections, settings)
    change = np.zeros((following.map_points.size, state.map_points.size))
    for label, boundary in state.boundaries.items():
        new, points = following.boundaries[label], following.control_points(label)
        by_points = new_from_old(boundary, state.control_points(label), new, points)
        change[map_block(following, label), map_block(state, label)] = np.kron(by_points, np.eye(2))
    locate_poses(following)
    associate(following, detections, settings, settings.batch.gate, strict=True)
    return following, change @ covariance @ change.T


def new_from_old(old: Boundary, old_points: Array, new: Boundary, new_points: Array) -> Array:
    """F (m_new, m_old), least squares over points of the old curve and their foot points on the new one."""

    def foot_on_new(u: Array) -> Array:
        low, high = np.full(len(u), new.tables.low), np.full(len(u), new.tables.high)
        return new.find(new_points, old.evaluate(old_points, u), low, high).u

    return refit(old.spline(old_points), new.spline(new_points), foot_on_new).new_from_old


def map_block(state: State, label: int) -> slice:
    """Where the control points of a boundary are in a covariance of all of them."""
    return Layout(state.map_keys).block(CONTROL_LETTERS[label])
