"""The window as a nonlinear GTSAM graph, of factors that can be part of any other graph."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import (
    smoothness_factors,
    spacing_factors,
    spline_projection_factors,
)
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.keys import control_keys, pose_keys
from pathspace_graph.graph.odometry import odometry_factor
from pathspace_graph.graph.user_factors import as_nonlinear
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.settings.mapper import GaugeSettings, MapperSettings
from pathspace_graph.spline.boundary import Boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def window_graph(smoother: CurveSmoother) -> gtsam.NonlinearFactorGraph:
    """Returns projection, spacing, smoothness, odometry, user and prior factors on the active variables.

    Linearized at the estimate, the graph is the mapper's own system in GTSAM's tangents of the poses.
    """
    state, detections, settings = smoother.map.state, smoother.map.detections, smoother.map.settings
    graph = gtsam.NonlinearFactorGraph()
    for label, boundary in state.boundaries.items():
        active = state.active(label)
        rows = detections.used_on(label)
        room = _room(boundary, active, detections.u[rows], settings.spline.refine_room)
        sensor_key = smoother.variables.sensor_key
        _add(graph, detection_factors(label, boundary, detections, rows, settings, room, sensor_key))
        if not smoother.map.held_by_prior:
            _add(graph, gauge_factors(label, boundary, active, settings.gauge))
        anchor = gtsam.noiseModel.Isotropic.Sigma(2, settings.gauge.sigma_anchor)
        points = state.control_points(label)[active]
        for key, point in zip(control_keys(label, boundary.first + active).tolist(), points, strict=True):
            graph.add(gtsam.PriorFactorPoint2(key, point, anchor))
    for slot, interval in enumerate(smoother.window.odometry.intervals):
        graph.add(odometry_factor(smoother.first_cycle + slot, interval))
    _add(graph, smoother.user_factors.factors)
    _add(
        graph, [as_nonlinear(factor, smoother.variables) for factor in factors_of(smoother.absolute_prior())]
    )
    return graph


def _add(graph: gtsam.NonlinearFactorGraph, factors: Sequence[gtsam.NonlinearFactor]) -> None:
    """Adds factors to a graph."""
    for factor in factors:
        graph.add(factor)


def detection_factors(
    label: int,
    boundary: Boundary,
    detections: DetectionTable,
    rows: IntArray,
    settings: MapperSettings,
    room: tuple[Array, Array],
    sensor_key: int | None = None,
) -> list[gtsam.CustomFactor]:
    """Returns a spline-projection factor for each cycle of some detections (m,) on a boundary.

    `room` (m,), (m,) limits how far before and past its present parameter each foot point may move. The
    detections are corrected by the sensor's calibration where it has a key.
    """
    u = detections.u[rows]
    return spline_projection_factors(
        pose_keys(detections.cycle[rows]),
        control_keys(label, boundary.numbers).tolist(),
        boundary.tables,
        points_vehicle=detections.measured[rows],
        covariances=detections.covariance[rows],
        low=u - room[0],
        high=boundary.believed(u + room[1]),
        sigma_model=settings.spline.sigma_model,
        huber=settings.gate.huber,
        sensor_key=sensor_key,
        twists=detections.twist[rows],
    )


def _room(boundary: Boundary, active: IntArray, u: Array, room: float) -> tuple[Array, Array]:
    """Returns how far before and past parameters (m,) the curve is active, at most `room`."""
    if len(active) == boundary.size:
        return np.full(len(u), room), np.full(len(u), room)
    p, begin = boundary.degree, boundary.knots[active[0] + boundary.degree]
    span = active[0] + np.arange(p, len(active))
    span = np.where(span >= boundary.size + p, span - boundary.size, span) if boundary.periodic else span
    widths = np.diff(boundary.knots)[span]
    after = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin
    return np.minimum(after, room), np.minimum(widths.sum() - after, room)


def gauge_factors(
    label: int, boundary: Boundary, active: IntArray, settings: GaugeSettings
) -> list[gtsam.NonlinearFactor]:
    """Returns spacing and smoothness factors between the active control points of a boundary."""
    gauge = boundary.gauge_on(active)
    keys = control_keys(label, boundary.first + np.arange(boundary.size)).tolist()
    factors: list[gtsam.NonlinearFactor] = []
    for (first, second), nominal in zip(gauge.pairs.tolist(), gauge.nominal, strict=True):
        sigma = np.array([settings.sigma_spacing * nominal])
        factors += spacing_factors([keys[first], keys[second]], np.array([nominal]), sigma, False)
    for triple, bending in zip(gauge.triples.tolist(), gauge.bending, strict=True):
        factors += smoothness_factors([keys[j] for j in triple], bending[None], 1.0)
    return factors
