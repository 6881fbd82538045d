"""The window of a road as GTSAM's own factors and values."""

import gtsam
import numpy as np

from pathspace_graph.factors import gtsam_factors
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import control_keys, pose_keys
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.detections import NO_STATION
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import GaugeSettings
from pathspace_graph.spline.boundary import Boundary


def window_graph(road: Road) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a road on its active variables, as in `MapperEstimate.graph`."""
    smoother, track, settings = road.smoother, road.smoother.map, road.settings
    factors: list[gtsam.NonlinearFactor] = []
    anchor = gtsam.noiseModel.Isotropic.Sigma(2, settings.gauge.sigma_anchor)
    for label, boundary in road.boundaries.items():
        active = track.state.active(label)
        factors += [*_detection_factors(track, label, active), *_station_factors(track, label)]
        if not track.held_by_prior:
            factors += _gauge_factors(label, boundary, active, settings.gauge)
        keys = control_keys(label, boundary.first + active).tolist()
        points = track.state.control_points(label)[active]
        factors += [gtsam.PriorFactorPoint2(*pair, anchor) for pair in zip(keys, points, strict=True)]
    intervals = enumerate(smoother.window.odometry.intervals, start=smoother.first_cycle)
    factors += [odometry_factor(cycle, interval) for cycle, interval in intervals]
    factors += smoother.user_factors.factors
    prior = factors_of(smoother.absolute_prior())
    factors += [as_nonlinear(factor, smoother.variables) for factor in prior]
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _detection_factors(track: CurveMap, label: int, active: IntArray) -> list[gtsam.CustomFactor]:
    """Return a spline-projection factor for each cycle with detections in use on a boundary.

    Foot points may move as far as in a step, within the active part of the curve.
    """
    detections, settings = track.detections, track.settings
    boundary, rows = track.state.boundaries[label], detections.used_on(label)
    u = detections.u[rows]
    before, past = _room(boundary, active, u, settings.spline.refine_room)
    return gtsam_factors.spline_projection_factors(
        pose_keys(detections.cycle[rows]),
        control_keys(label, boundary.numbers).tolist(),
        boundary.tables,
        points_vehicle=detections.measured[rows],
        covariances=detections.covariance[rows],
        low=u - before,
        high=boundary.within_trusted(u + past),
        sigma_model=settings.spline.sigma_model,
        huber=settings.gate.huber,
        sensor_key=track.variables.sensor_key,
        twists=detections.twist[rows],
    )


def _station_factors(track: CurveMap, label: int) -> list[gtsam.CustomFactor]:
    """Return a station factor for each cycle with such detections on a boundary."""
    detections, stations = track.detections, track.stations
    rows = detections.used_on(label)
    rows = rows[detections.station[rows] != NO_STATION]
    if stations is None or len(rows) == 0:
        return []
    boundary, station = track.state.boundaries[label], detections.station[rows]
    return gtsam_factors.station_factors(
        pose_keys(detections.cycle[rows]),
        control_keys(label, boundary.numbers).tolist(),
        boundary.tables,
        u=stations.u[station],
        sigma_station=track.sigma_stations(station),
        points_vehicle=detections.measured[rows],
        covariances=detections.covariance[rows],
        twists=detections.twist[rows],
        huber=track.settings.gate.huber,
        sensor_key=track.variables.sensor_key,
    )


def _room(boundary: Boundary, active: IntArray, u: Array, room: float) -> tuple[Array, Array]:
    """Return the lengths (m,) of active curve before and past parameters u (m,), at most `room` (m)."""
    if len(active) == boundary.size:
        return np.full(len(u), room), np.full(len(u), room)
    p, begin = boundary.degree, boundary.knots[active[0] + boundary.degree]
    span = active[0] + np.arange(p, len(active))
    span = np.where(span >= boundary.size + p, span - boundary.size, span) if boundary.periodic else span
    widths = np.diff(boundary.knots)[span]
    after = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin
    return np.minimum(after, room), np.minimum(widths.sum() - after, room)


def _gauge_factors(
    label: int, boundary: Boundary, active: IntArray, settings: GaugeSettings
) -> list[gtsam.NonlinearFactor]:
    """Return spacing and smoothness factors between the active control points of a boundary."""
    gauge = boundary.gauge_on(active)
    keys = control_keys(label, boundary.first + np.arange(boundary.size)).tolist()
    factors: list[gtsam.NonlinearFactor] = []
    for pair, nominal in zip(gauge.pairs.tolist(), gauge.nominal[:, None], strict=True):
        sigma = settings.sigma_spacing * nominal
        factors += gtsam_factors.spacing_factors([keys[j] for j in pair], nominal, sigma, False)
    for triple, bending in zip(gauge.triples.tolist(), gauge.bending, strict=True):
        factors += gtsam_factors.smoothness_factors([keys[j] for j in triple], bending[None], 1.0)
    return factors
