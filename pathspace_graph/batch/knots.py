"""Knots of the batch's curves: about one for each cone at the optimum, few of them in the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import BatchSettings
from pathspace_graph.settings.knots import FitSettings
from pathspace_graph.settings.mapper import MapperSettings, SplineSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.cone_knots import chosen_breaks
from pathspace_graph.spline.knots import fit_spline

from .cones import cones_of_curve

Array = NDArray[np.float64]


def reknot(state: State, detections: DetectionTable, settings: MapperSettings, dense: bool = False) -> State:
    """Returns the state with every curve fitted anew through the cones along it.

    `dense` places so many knots that the curves meet the cones; else they are as few as the map has.
    """
    state = state.copy()
    cones = {label: cones_of_curve(state, detections, label, settings) for label in state.boundaries}
    share = size_share({label: len(own.u) for label, own in cones.items()}, settings.batch)
    for label, boundary in list(state.boundaries.items()):
        points = cones[label].points
        if len(points) < settings.batch.cones.min_count:
            continue
        if dense:
            beyond = 0.0 if boundary.periodic else settings.growth.merge_radius
            spline = dense_fit_through(extended(points, beyond), boundary.periodic, settings)
        else:
            spline = fit_through(points, boundary.periodic, settings, share)
        state.replace_boundary(label, *boundary_of(spline, settings))
    return state


def size_share(cones: Mapping[int, int], batch: BatchSettings) -> float:
    """Returns the control points per cone, from the numbers of cones of the boundaries.

    The result is the settings' own share, or what the settings' size leaves for both boundaries together.
    """
    total = sum(cones.values())
    return batch.size_share if batch.size is None or total == 0 else batch.size / total


def fit_through(points: Array, periodic: bool, settings: MapperSettings, share: float) -> BSpline:
    """Returns a curve through ordered cones (k, 2), which has at most `share` control points for each."""
    least_size = settings.spline.min_size
    most = max(least_size, int(share * len(points)))
    return _fit(points, periodic, settings, max(least_size, int(settings.batch.min_size_share * most)), most)


def dense_fit_through(points: Array, periodic: bool, settings: MapperSettings) -> BSpline:
    """Returns a curve through cones (k, 2) on nearly a knot for each."""
    size = max(settings.spline.min_size, int(settings.batch.dense_share * len(points)))
    return _fit(points, periodic, settings, size, size)


def extended(points: Array, beyond: float) -> Array:
    """Returns cones (k, 2) with a point before the first and one after the last, `beyond` metres straight on.

    There are at least two cones. Detections scatter about their cone, so that half of those of the last one
    lie beyond it. Without that much of the curve after it, any motion of its end would put some of them into
    use and others out of it. Nothing is added where `beyond` is zero.
    """
    if beyond == 0.0:
        return points
    ends, inner = points[[0, -1]], points[[1, -2]]
    ahead = (ends - inner) / np.maximum(np.hypot(*(ends - inner).T), np.finfo(float).tiny)[:, None]
    first, last = ends + beyond * ahead
    return np.concatenate([first[None], points, last[None]])


def _fit(points: Array, periodic: bool, settings: MapperSettings, least: int, most: int) -> BSpline:
    """Returns the curve of `least` to `most` control points that fits best.

    A closed one begins at the cone nearest to the start, so that similar cones give similar knots.
    """
    if periodic:
        points = np.roll(points, -int(np.hypot(*points.T).argmin()), axis=0)
    fit = FitSettings(degree=settings.spline.degree)
    chosen = chosen_breaks(points, periodic, fit, least, most)
    return fit_spline(points, chosen.size, periodic, fit, chosen.breaks)


def boundary_of(spline: BSpline, settings: MapperSettings) -> tuple[Boundary, Array]:
    """Returns a boundary that is the given curve, all of it confirmed, and its control points (m, 2)."""
    spline = spline if spline.periodic else spline.unclamp()
    own = exact_settings(settings.spline, settings.batch)
    boundary = Boundary(spline.knots, spline.periodic, own, settings.gauge)
    boundary.confirmed_end = boundary.tables.high
    return boundary, spline.distinct_control_points


def exact_settings(spline: SplineSettings, batch: BatchSettings) -> SplineSettings:
    """Returns a curve's settings with the foot points of the batch, which are more exact."""
    own = batch.foot_points
    return replace(
        spline,
        refine_iterations=own.refine_iterations,
        refine_room=own.refine_room,
        search_iterations=own.search_iterations,
    )
