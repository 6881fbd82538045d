"""Read-only queries of a road: map, track ahead, newest readings."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.variables import POINT, POSE, pose_keys
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.mapping.motion import with_size
from pathspace_graph.mapping.road import Road
from pathspace_graph.run import Readings
from pathspace_graph.spline.ahead import CurveAhead, TrackAhead, track_ahead

from .outlook import Outlook, confirmed, curves_ahead, joint_covariance_of, look_ahead


def road_map(road: Road, sigma_size: float) -> Map:
    """Return the map with the joint covariance of each boundary's control points, and the orange cones.

    `sigma_size` is the relative standard deviation of the map's size. The covariance of a closed curve
    includes the scatter of the cones about it.
    """
    with road.smoother.variables.looked_at():
        return replace(_map_of(road, sigma_size), points=road.orange_cones())


def _map_of(road: Road, sigma_size: float) -> Map:
    track, outlooks = road.smoother.map, _outlooks(road)
    if not outlooks:
        return Map(road.closed, {})
    newest = pose_keys(np.array([road.next_cycle - 1]))
    joint = road.smoother.covariance(np.concatenate([track.state.map_keys, newest]))
    lengths = np.concatenate([track.state.map_points.ravel(), road.poses[-1, :2], [0.0]])
    joint = with_size(joint, lengths, sigma_size)
    if road.closed:
        sizes, shape = [len(one.known) for one in outlooks.values()], road.settings.spline.sigma_shape
        sigmas = [track.scatter.get(b, np.full(n, shape)) for b, n in zip(outlooks, sizes, strict=True)]
        joint = joint[:-POSE, :-POSE] + np.diag(np.repeat(np.concatenate(sigmas), POINT) ** 2)
        blocks = [slice(*ends) for ends in pairwise([0, *(POINT * np.cumsum(sizes)).tolist()])]
    else:
        joint, blocks = joint_covariance_of(list(outlooks.values()), joint, road.poses[-1])
    boundaries = {
        label: SplineBoundary(
            outlook.spline, joint[block, block], outlook.confirmed_until, track.placed_cones(label)
        )
        for (label, outlook), block in zip(outlooks.items(), blocks, strict=True)
    }
    return Map(road.closed, boundaries, joint)


def road_outline(road: Road) -> Map:
    """Return the map without covariances, in a hundredth of the time of `road_map`."""
    with road.smoother.variables.looked_at():
        boundaries = {
            label: SplineBoundary(outlook.spline, NO_COVARIANCE, outlook.confirmed_until)
            for label, outlook in _outlooks(road).items()
        }
    return Map(road.closed, boundaries, points=road.orange_cones())


def _outlooks(road: Road) -> dict[int, Outlook]:
    road.smoother.refresh()
    if road.closed or road.next_cycle == 0:
        return confirmed(road.smoother.map)
    return look_ahead(road.smoother.map, road.growth.tentative, road.path, road.smoother.times[-1])


def track_ahead_of(road: Road, distance: float, step: float) -> TrackAhead:
    """Return the next `distance` metres of the track in the vehicle's frame, `step` (m) apart."""
    if not road.smoother.times:
        return track_ahead({}, np.zeros(POSE), distance, step)
    track, pose = road.smoother.map, road.poses[-1]
    if not road.closed:
        curves = curves_ahead(track, road.growth.tentative, road.path, road.smoother.times[-1])
        return track_ahead(curves, pose, distance, step)
    curves = {}
    for label, boundary in road.boundaries.items():
        points = boundary.extended(track.state.control_points(label))
        curves[label] = CurveAhead(boundary.tables, points, float(track.state.pose_u[label][-1]))
    return track_ahead(curves, pose, distance, step)


def readings_of(road: Road) -> Readings:
    """Return the used and gated detections of the newest cycle, as in `MapperEstimate.readings`."""
    track, table = road.smoother.map, road.smoother.map.detections
    newest = slice(int(table.cycle.searchsorted(road.next_cycle - 1)), None)
    used, boundary = table.used[newest].copy(), table.boundary[newest].copy()
    points = table.points_map(newest, track.variables)
    feet = np.full(points.shape, np.nan)
    for label, curve in road.boundaries.items():
        on = np.flatnonzero(used & (boundary == label))
        if len(on):
            feet[on] = curve.evaluate(track.state.control_points(label), table.u[newest][on])
    return Readings(points, boundary, used, feet)


def smoothed_at(t: Array, stamps: Array, poses: Array) -> Array:
    """Return the poses (n, 3) at t (n,) among poses (k, 3) at stamps (k,) of cycles; NaN past the last."""
    found, known = np.full((len(t), POSE), np.nan), t <= stamps.max(initial=-np.inf)
    found[known] = poses[np.maximum(stamps.searchsorted(t[known], side="right") - 1, 0)]
    return found
