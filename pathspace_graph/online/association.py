"""Which readings a curve takes: those that lie on it, by the joint uncertainty of pose and curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.projection import ProjectionRows, project, sigma_across
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import relocate

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def associate(smoother: CurveSmoother, retest: frozenset[int]) -> None:
    """Readings that are not in use and lie on a curve: `d^2 < chi^2 (sigma^2 + g' Sigma g)`.

    Those of the newest pose, whose stations are found along with them; all in the window of the labels
    `retest`, whose curves have grown. A reading of unknown colour is used only where one curve alone would
    have it.
    """
    detections, state, gate = smoother.map.detections, smoother.map.state, smoother.map.settings.gate
    rows, curve = _untested(smoother, retest)
    poses = state.variables.poses_at(detections.cycle[rows])
    points = to_map(detections.point[rows], poses)
    foot = _find(smoother, rows, curve, points)
    if len(rows) == 0 or smoother.last_step is None:
        return
    covariances, sigma_model = detections.covariance[rows], smoother.map.settings.spline.sigma_model
    sigma = sigma_across(foot.normal_unit, covariances, poses, sigma_model)
    variance, unknown = sigma**2 + gate.sigma_floor**2, detections.label[rows] == UNKNOWN
    near, square = foot.interior & (np.abs(foot.distance) < gate.rough), foot.distance**2
    passes = near & (square < np.where(unknown, gate.chi_unknown, gate.chi) ** 2 * variance)
    far = np.flatnonzero(near & ~passes & ~unknown)
    if len(far):  # what the joint uncertainty adds matters to these only
        beside = foot.where(far)
        projected = project(points[far], covariances[far], poses[far], beside, sigma_model)
        variance[far] += joint_variance(smoother, detections.cycle[rows[far]], beside, projected)
        passes[far] = square[far] < gate.chi**2 * variance[far]
    _decide(detections, rows[passes], state.curves.labels[curve[passes]], foot.u[passes])


def _untested(smoother: CurveSmoother, retest: frozenset[int]) -> tuple[IntArray, IntArray]:
    """Readings to be tested, and on which curve (m,) each."""
    detections, curves = smoother.map.detections, smoother.map.state.curves
    newest = int(detections.cycle.searchsorted(smoother.next_cycle - 1))
    rows = [detections.open_to(label, 0 if label in retest else newest) for label in curves.labels.tolist()]
    return np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(of) for of in rows])


def _decide(detections: DetectionTable, rows: IntArray, labels: IntArray, u: Array) -> None:
    """What passes is used on the boundary (m,) that takes it; what two would have, on neither."""
    doubtful = detections.used[rows] | (np.bincount(rows)[rows] > 1)
    detections.take(rows, labels, u)
    detections.release(rows[doubtful])


def _find(smoother: CurveSmoother, rows: IntArray, curve: IntArray, points: Array) -> FootPoints:
    """Foot points of readings, at points (m, 2), on the visible stretch of each one's curve.

    In the same search the newest pose gets its station on every curve.
    """
    state, gate = smoother.map.state, smoother.map.settings.gate
    curves, pose = state.curves, state.poses[-1]
    known = np.array([state.pose_u[label] for label in state.boundaries])
    known = np.append(known, known[:, -1:], axis=1)  # about where the newest pose is
    behind, ahead = _search_room(state, smoother.map.settings)
    seen_from, all_curves = (
        known[curve, smoother.map.detections.cycle[rows] - smoother.first_cycle],
        np.arange(len(known)),
    )
    foot = curves.find(
        state.map_points,
        np.concatenate([points, np.broadcast_to(pose[:2], (len(known), 2))]),
        np.append(curve, all_curves),
        np.append(seen_from - gate.view_behind, known[:, -1] - behind),
        np.append(seen_from + gate.view_ahead, known[:, -1] + ahead),
    )
    beside = foot.where(slice(len(rows), None))
    along = beside.tangent_unit @ np.array([np.cos(pose[2]), np.sin(pose[2])])
    lost = (along < 0.0) | (np.abs(beside.distance) > gate.station_lateral)
    for label, u, is_lost in zip(state.boundaries, beside.u.tolist(), lost.tolist(), strict=True):
        _append_pose_u(state, label, _sought_again(smoother, label) if is_lost else u)
    return foot.where(slice(len(rows)))


def _search_room(state: State, settings: MapperSettings) -> tuple[float, float]:
    """How far behind and ahead (m) of the last station the newest pose's foot point is looked for."""
    gate = settings.gate
    moved = float(np.hypot(*(state.poses[-1, :2] - state.poses[-2, :2])))
    if moved < gate.station_step:
        return settings.spline.refine_room, settings.spline.refine_room
    return gate.station_behind, gate.station_ahead


def _sought_again(smoother: CurveSmoother, label: int) -> float:
    """Station of a vehicle that the curve runs against, or is far off, where it was looked for."""
    state, room = smoother.map.state, smoother.map.settings.gate.station_room
    boundary, points = state.boundaries[label], state.control_points(label)
    low = np.array([boundary.confirmed_end - room - boundary.settings.refine_room])
    if boundary.periodic or boundary.tables.locate(low)[0][0] < state.active(label)[0]:
        smoother.refresh()  # else what is looked at is active, which is up to date
    return relocate(boundary, points, state.poses[-1], room)


def _append_pose_u(state: State, label: int, u: float) -> None:
    """The newest pose's station; on a closed curve laps add up."""
    boundary, known = state.boundaries[label], state.pose_u[label]
    if boundary.periodic:
        u += boundary.length * np.round((known[-1] - u) / boundary.length)
    state.pose_u[label] = np.append(known, u)


def joint_variance(
    smoother: CurveSmoother, cycles: IntArray, foot: FootPoints, projected: ProjectionRows
) -> Array:
    """`g_i' Sigma g_i` (m,) in m^2: variance of each row's residual by what is estimated, of cycles (m,)."""
    keys = np.concatenate([pose_keys(cycles)[:, None], smoother.map.state.curves.keys[foot.columns]], axis=1)
    by_control = projected.by_control.reshape(len(cycles), -1)
    jacobian = np.concatenate([projected.by_pose, by_control], axis=1)
    return smoother.predicted_covariance(Rows(keys, jacobian, projected.residual, cycles))[:, 0, 0]
