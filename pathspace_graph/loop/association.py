"""The association of detections with curves, gated by the joint uncertainty of pose and curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.projection import ProjectionRows, project, sigma_across
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.rows import Rows
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import relocate

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Gating:
    """Holds the coloured detections of the newest pose, as they were tested."""

    rows: IntArray
    """(k,) These are the detections, by row of the table."""
    in_view: NDArray[np.bool_]
    """(k,) The flag is set when the detection lies beside the part of its curve that the pose sees."""
    innovation: Array
    """(k,) This is the distance of each from its curve before the update, in standard deviations of it."""


def associate(smoother: CurveSmoother, retest: frozenset[int], use: bool = True) -> Gating:
    """Puts detections into use that lie on a curve: `d^2 < chi^2 (sigma^2 + g' Sigma g)`.

    d is the signed distance, sigma its own standard deviation, and g its gradient by pose and control points,
    whose joint covariance is Sigma. The newest pose's detections are tested, and for the labels in `retest`,
    whose curves have grown, all of the window that are not in use. A detection of unknown colour is used only
    if exactly one curve accepts it. The newest pose's parameter on each curve is found in the same search.
    Without `use`, no detection is tested, and only that parameter is found.
    """
    detections, state = smoother.map.detections, smoother.map.state
    rows, curve = _untested(smoother, retest)
    points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
    foot = _find(smoother, rows, curve, points)
    if len(rows) == 0 or smoother.last_step is None or not use:
        return Gating(rows[:0], np.zeros(0, bool), np.zeros(0))
    innovation = _accept(smoother, rows, curve, points, foot)
    newest = detections.cycle[rows] == smoother.next_cycle - 1
    judged = newest & (detections.label[rows] != UNKNOWN)
    return Gating(rows[judged], foot.interior[judged], innovation[judged])


def associate_late(smoother: CurveSmoother, new: slice) -> None:
    """Puts those of the late detections, which are the rows `new`, into use that lie on a curve.

    They are gated as the newest ones are in `associate`.
    """
    detections, state = smoother.map.detections, smoother.map.state
    if smoother.last_step is None:
        return
    own = [detections.open_to(label, new.start) for label in state.curves.labels.tolist()]
    own = [rows[rows < new.stop] for rows in own]
    rows, curve = np.concatenate(own), np.repeat(np.arange(len(own)), [len(one) for one in own])
    points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
    pose_u = np.array([state.pose_u[label] for label in state.boundaries])
    low, high = _view(smoother, rows, curve, pose_u)
    _accept(smoother, rows, curve, points, state.curves.find(state.map_points, points, curve, low, high))


def reassociate(smoother: CurveSmoother) -> None:
    """Associates all detections of the window anew, after the curves were replaced.

    The poses must have their parameters on the new curves. The uncertainty is that of the prior and the
    odometry alone, since no detection is in use.
    """
    detections, state = smoother.map.detections, smoother.map.state
    detections.release(np.arange(len(detections)))
    smoother.factorize()
    rows, curve = _untested(smoother, frozenset(state.boundaries))
    points = to_map(detections.point[rows], state.variables.poses_at(detections.cycle[rows]))
    pose_u = np.array([state.pose_u[label] for label in state.boundaries])
    low, high = _view(smoother, rows, curve, pose_u)
    _accept(smoother, rows, curve, points, state.curves.find(state.map_points, points, curve, low, high))


def _view(smoother: CurveSmoother, rows: IntArray, curve: IntArray, pose_u: Array) -> tuple[Array, Array]:
    """Returns the stretch [low, high] of its curve (m,) that each detection may belong to.

    `pose_u` (k, P) are the parameters of the window's poses on every curve.
    """
    gate = smoother.map.settings.gate
    seen_from = pose_u[curve, smoother.map.detections.cycle[rows] - smoother.first_cycle]
    return seen_from - gate.view_behind, seen_from + gate.view_ahead


def _accept(
    smoother: CurveSmoother, rows: IntArray, curve: IntArray, points: Array, foot: FootPoints
) -> Array:
    """Puts those detections (m,) into use that pass the gate of their curve (m,).

    Returns the distance of each from its curve, in standard deviations (m,).
    """
    detections, state, gate = smoother.map.detections, smoother.map.state, smoother.map.settings.gate
    poses = state.variables.poses_at(detections.cycle[rows])
    covariances, sigma_model = detections.covariance[rows], smoother.map.settings.spline.sigma_model
    sigma = sigma_across(foot.normal_unit, covariances, poses, sigma_model)
    variance, unknown = sigma**2 + gate.sigma_floor**2, detections.label[rows] == UNKNOWN
    near, square = foot.interior & (np.abs(foot.distance) < gate.rough), foot.distance**2
    accepted = near & (square < np.where(unknown, gate.chi_unknown, gate.chi) ** 2 * variance)
    doubtful = np.flatnonzero(near & ~accepted & ~unknown)
    if len(doubtful):  # the joint uncertainty is costly, and only these need it
        feet = foot.where(doubtful)
        projected = project(points[doubtful], covariances[doubtful], poses[doubtful], feet, sigma_model)
        variance[doubtful] += joint_variance(smoother, rows[doubtful], feet, projected)
        accepted[doubtful] = square[doubtful] < gate.chi**2 * variance[doubtful]
    _decide(detections, rows[accepted], state.curves.labels[curve[accepted]], foot.u[accepted])
    return np.asarray(foot.distance / np.sqrt(variance))


def _untested(smoother: CurveSmoother, retest: frozenset[int]) -> tuple[IntArray, IntArray]:
    """Returns the detections (m,) to test, and the index (m,) of the curve that each is tested for."""
    detections, curves = smoother.map.detections, smoother.map.state.curves
    newest = int(detections.cycle.searchsorted(smoother.next_cycle - 1))
    rows = [detections.open_to(label, 0 if label in retest else newest) for label in curves.labels.tolist()]
    return np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(own) for own in rows])


def _decide(detections: DetectionTable, rows: IntArray, labels: IntArray, u: Array) -> None:
    """Puts detections (m,) into use on the boundaries that accept them, and those that two accept on none."""
    ambiguous = detections.used[rows] | (np.bincount(rows)[rows] > 1)
    detections.take(rows, labels, u)
    detections.release(rows[ambiguous])


def _find(smoother: CurveSmoother, rows: IntArray, curve: IntArray, points: Array) -> FootPoints:
    """Finds the foot points of detections at points (m, 2), each on its own curve (m,) and in its view.

    The newest pose's foot point on every curve is found in the same search and appended to `pose_u`.
    """
    state, gate = smoother.map.state, smoother.map.settings.gate
    curves, pose = state.curves, state.poses[-1]
    pose_u = np.array([state.pose_u[label] for label in state.boundaries])
    pose_u = np.append(pose_u, pose_u[:, -1:], axis=1)  # the newest pose is near the one before
    (low, high), all_curves = _view(smoother, rows, curve, pose_u), np.arange(len(pose_u))
    behind, ahead = _search_room(state, smoother.map.settings)
    foot = curves.find(
        state.map_points,
        np.concatenate([points, np.broadcast_to(pose[:2], (len(pose_u), 2))]),
        np.append(curve, all_curves),
        np.append(low, pose_u[:, -1] - behind),
        np.append(high, pose_u[:, -1] + ahead),
    )
    beside = foot.where(slice(len(rows), None))
    along = beside.tangent_unit @ np.array([np.cos(pose[2]), np.sin(pose[2])])
    lost = (along < 0.0) | (np.abs(beside.distance) > gate.station_lateral)
    for label, u, is_lost in zip(state.boundaries, beside.u.tolist(), lost.tolist(), strict=True):
        _append_pose_u(state, label, _relocated(smoother, label) if is_lost else u)
    return foot.where(slice(len(rows)))


def _search_room(state: State, settings: MapperSettings) -> tuple[float, float]:
    """Returns how far behind and ahead (m) of its last parameter the vehicle's foot point is searched."""
    gate = settings.gate
    moved = float(np.hypot(*(state.poses[-1, :2] - state.poses[-2, :2])))
    if moved < gate.station_step:
        return settings.spline.refine_room, settings.spline.refine_room
    return gate.station_behind, gate.station_ahead


def _relocated(smoother: CurveSmoother, label: int) -> float:
    """Returns the parameter of a vehicle that was not found beside the curve in the ordinary search."""
    state, room = smoother.map.state, smoother.map.settings.gate.station_room
    boundary, points = state.boundaries[label], state.control_points(label)
    low = np.array([boundary.confirmed_end - room - boundary.settings.refine_room])
    if boundary.periodic or boundary.tables.locate(low)[0][0] < state.active(label)[0]:
        smoother.refresh()  # the search reaches inactive control points, which may be out of date
    return relocate(boundary, points, state.poses[-1], room)


def _append_pose_u(state: State, label: int, u: float) -> None:
    """Appends the newest pose's parameter; on a closed curve the parameter increases from lap to lap."""
    boundary, known = state.boundaries[label], state.pose_u[label]
    if boundary.periodic:
        u += boundary.length * np.round((known[-1] - u) / boundary.length)
    state.pose_u[label] = np.append(known, u)


def joint_variance(
    smoother: CurveSmoother, rows: IntArray, foot: FootPoints, projected: ProjectionRows
) -> Array:
    """Returns `g_i' Sigma g_i` (m,) in m^2: the variance of each residual of detections (m,).

    It comes from the uncertainty of the pose, of the control points and of the sensor's calibration.
    """
    track, cycles = smoother.map, smoother.map.detections.cycle[rows]
    poses, sensor = smoother.variables.poses_at(cycles), smoother.variables.sensor
    keys = np.concatenate([track.measuring_keys(cycles), track.state.curves.keys[foot.columns]], axis=1)
    by = track.detections.sensor_rows(rows, foot.normal_unit, projected.residual, poses, sensor)
    by_control = projected.by_control.reshape(len(cycles), -1)
    jacobian = np.concatenate([projected.by_pose, by.by_sensor, by_control], axis=1)
    return smoother.predicted_covariance(Rows(keys, jacobian, projected.residual, cycles))[:, 0, 0]
