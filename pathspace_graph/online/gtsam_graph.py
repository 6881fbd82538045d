"""The window of a road as GTSAM's own factors and values."""

import gtsam
import numpy as np

from pathspace_graph.factors import gtsam_factors
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.detections import NO_STATION
from pathspace_graph.mapping.gtsam_graph import seen_on, weak_priors
from pathspace_graph.mapping.road import Road
from pathspace_graph.spline.boundary import Boundary


def window_graph(road: Road) -> gtsam.NonlinearFactorGraph:
    """Return the factors of a road on its active variables, as in `MapperEstimate.graph`."""
    smoother, track = road.smoother, road.smoother.map
    factors: list[gtsam.NonlinearFactor] = []
    for label, boundary in road.boundaries.items():
        active, keys = track.state.active(label), track.state.control_keys(label)
        factors += _detection_factors(track, label, active)
        factors += weak_priors(track.state, label, active, smooth=not track.held_by_prior)
        gauge = boundary.gauge_on(active)
        pairs = zip(keys[gauge.pairs].tolist(), gauge.nominal.tolist(), strict=True)
        for (key, following), nominal in () if track.held_by_prior else pairs:
            noise = gtsam.noiseModel.Isotropic.Sigma(1, road.settings.gauge.sigma_spacing * nominal)
            factors.append(gtsam.RangeFactor2(key, following, nominal, noise))
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
    """Return factors across a boundary and at its stations, for each cycle with such detections in use.

    Foot points may move as far as in a step, within the active part of the curve.
    """
    detections, settings, state = track.detections, track.settings, track.state
    boundary, rows = state.boundaries[label], detections.used_on(label)
    u, covariances, huber = detections.u[rows], detections.covariance[rows], settings.gate.huber
    before, past = _room(boundary, active, u, settings.spline.refine_room)
    across = gtsam_factors.spline_projection_factors(
        low=u - before,
        high=boundary.within_trusted(u + past),
        sigma_model=settings.spline.sigma_model,
        **seen_on(state, detections, label, rows, covariances, huber),
    )
    rows = rows[detections.station[rows] != NO_STATION]
    if track.stations is None or len(rows) == 0:
        return across
    station = detections.station[rows]
    return across + gtsam_factors.station_factors(
        u=track.stations.u[station],
        sigma_station=track.sigma_stations(station),
        **seen_on(state, detections, label, rows, detections.covariance[rows], huber),
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
