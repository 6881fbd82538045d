"""The factors of curves in GTSAM's own classes, for the graphs of window and batch."""

from collections.abc import MutableSequence
from typing import Any

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import (
    fill,
    smoothness_factors,
    spline_projection_factors,
    station_factors,
)
from pathspace_graph.graph.variables import POINT, pose_key, pose_keys
from pathspace_graph.spline.boundary import Boundary

from .curve_map import CurveMap
from .detections import NO_STATION
from .weak_priors import WeakPriors


def curve_factors(track: CurveMap, label: int) -> list[gtsam.NonlinearFactor]:
    """Return the factors of the detections in use on a boundary, and the weak priors of its control points.

    A detection has a factor across the curve, and one at its station, with their Huber losses. Foot points
    may move as far as in a step, within the active part of the curve.
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
    weak = track.weak.get(label)
    if weak is not None:
        factors += [factor_beside(weak, j) for j in range(len(weak.keys))]
        for triple, bending in zip(weak.triples.tolist(), weak.bending, strict=True):
            factors += smoothness_factors(triple, bending[None], 1.0) if bending.any() else []
    return factors


def factor_beside(one: WeakPriors, j: int) -> gtsam.CustomFactor:
    """Build the factor that keeps a control point where it is, as seen from its pose."""
    point_key, cycle = int(one.keys[j]), int(one.cycle[j])
    place, whitener = one.place[j], one.whitener[j]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose, by_pose, by_point = (
            values.atPose2(pose_key(cycle)),
            np.zeros((2, 3), order="F"),
            np.zeros((2, 2), order="F"),
        )
        seen = pose.transformTo(values.atPoint2(point_key), by_pose, by_point)
        if H is not None:
            fill(H, [whitener @ by_point, whitener @ by_pose])
        return np.asarray(whitener @ (seen - place))

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(POINT), [point_key, pose_key(cycle)], error)


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
