"""The factors of curves in GTSAM's own classes, for the graphs of window and batch."""

from typing import Any

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import (
    smoothness_factors,
    spline_projection_factors,
    station_factors,
)
from pathspace_graph.graph.variables import POINT, pose_keys
from pathspace_graph.spline.boundary import Boundary

from .curve_map import CurveMap
from .detections import NO_STATION


def curve_factors(track: CurveMap, label: int, spacing: bool = True) -> list[gtsam.NonlinearFactor]:
    """Return the factors of the detections in use on a boundary, and the weak priors of its active points.

    A detection has a factor across the curve, and one at its station, with their Huber losses. Foot points
    may move as far as in a step, within the active part of the curve. A batch has no prior of spacing.
    """
    detections, settings, state = track.detections, track.settings, track.state
    boundary, active, rows = state.boundaries[label], state.active(label), detections.used_on(label)

    def seen(rows: IntArray) -> dict[str, Any]:
        return {
            "pose_keys": pose_keys(detections.cycle[rows]),
            "control_keys": state.control_keys(label).tolist(),
            "tables": boundary.tables,
            "points_vehicle": detections.measured[rows],
            "covariances": detections.covariance[rows],
            "twists": detections.twist[rows],
            "huber": settings.gate.huber,
            "sensor_key": state.variables.sensor_key,
        }

    u = detections.u[rows]
    before, past = _room(boundary, active, u, settings.spline.refine_room)
    factors: list[gtsam.NonlinearFactor] = [
        *spline_projection_factors(
            low=u - before,
            high=boundary.within_trusted(u + past),
            sigma_model=settings.spline.sigma_model,
            **seen(rows),
        )
    ]
    rows = rows[detections.station[rows] != NO_STATION]
    if track.stations is not None and len(rows):
        station = detections.station[rows]
        at, sigma_station = track.stations.u[station], track.stations.sigma[station]
        factors += station_factors(u=at, sigma_station=sigma_station, **seen(rows))
    return factors + _weak_priors(track, label, active, spacing)


def _weak_priors(track: CurveMap, label: int, active: IntArray, spacing: bool) -> list[gtsam.NonlinearFactor]:
    """Return spacing and smoothness, unless the map's prior has them, and the anchors of control points."""
    state, boundary = track.state, track.state.boundaries[label]
    keys, gauge, factors = state.control_keys(label), boundary.gauge_on(active), list[gtsam.NonlinearFactor]()
    if not track.held_by_prior:
        pairs = zip(keys[gauge.pairs].tolist(), gauge.nominal.tolist(), strict=True)
        for (key, following), nominal in pairs if spacing else ():
            noise = gtsam.noiseModel.Isotropic.Sigma(1, track.settings.gauge.sigma_spacing * nominal)
            factors.append(gtsam.RangeFactor2(key, following, nominal, noise))
        for triple, bending in zip(keys[gauge.triples].tolist(), gauge.bending, strict=True):
            factors += smoothness_factors(triple, bending[None], 1.0)
    anchor = gtsam.noiseModel.Isotropic.Sigma(POINT, boundary.gauge.sigma_anchor)
    points = zip(keys[active].tolist(), state.control_points(label)[active], strict=True)
    return factors + [gtsam.PriorFactorPoint2(*own, anchor) for own in points]


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
