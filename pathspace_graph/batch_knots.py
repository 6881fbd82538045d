"""Knots of the batch's curves: as many, and where, as the cones that were sighted ask for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .batch_cones import FEWEST, sighted_cones
from .boundary import Boundary
from .cone_knots import chosen_breaks
from .knots import FitSettings, fit_spline
from .readings import Readings
from .settings import MapperSettings, SplineSettings
from .spline import BSpline
from .state import State

Array = NDArray[np.float64]


FEWER = 0.6
"""Curves of fewer control points than this share of the most aren't looked at."""


def knot_count(cones: int, share: float, least: int) -> int:
    """Control points of a boundary along which so many cones were sighted."""
    return max(least, int(share * cones))


def replace_curve(state: State, label: int, spline: BSpline, settings: MapperSettings) -> None:
    """Another curve along nearly the same way takes a boundary's place."""
    block = state.block(label)
    spline = spline if spline.periodic else spline.unclamp()
    new = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline), settings.gauge)
    new.confirmed = new.tables.high
    values = spline.distinct_control_points.ravel()
    state.vector = np.concatenate([state.vector[: block.start], values, state.vector[block.stop :]])
    state.boundaries = {**state.boundaries, label: new}


def reknot(state: State, readings: Readings, settings: MapperSettings, dense: bool = False) -> State:
    """Every curve anew, through the cones sighted along it; `dense`: on so many knots that it meets them."""
    state = replace_state(state)
    cones = {label: sighted_cones(state, readings, label, settings) for label in state.boundaries}
    share = size_share({label: len(own.points) for label, own in cones.items()}, settings)
    for label, boundary in list(state.boundaries.items()):
        points = cones[label].points
        if len(points) < FEWEST:
            continue
        if dense:
            spline = dense_through(points, boundary.periodic, settings)
        else:
            spline = fit_through(points, boundary.periodic, settings, share)
        replace_curve(state, label, spline, settings)
    return state


def size_share(cones: Mapping[int, int], settings: MapperSettings) -> float:
    """Control points by cones: the settings' own, or what keeps the budget of both boundaries together."""
    size, total = settings.batch.size, sum(cones.values())
    return settings.batch.size_share if size is None or total == 0 else size / total


def replace_state(state: State) -> State:
    """A copy whose boundaries and stations may be replaced."""
    own = State()
    own.vector, own.boundaries, own.stations = (
        state.vector.copy(),
        dict(state.boundaries),
        dict(state.stations),
    )
    return own


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
