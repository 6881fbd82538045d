"""Which readings a curve takes: those that lie on it, by the joint uncertainty of pose and curve."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry
from pathspace_graph.factors.projection import ProjectionRows, project, to_map

from .boundary import Boundary
from .labels import UNKNOWN
from .settings import MapperSettings
from .smoother import Smoother, Step
from .state import State
from .window import POSE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
T = TypeVar("T", FootPoints, ProjectionRows)

SAME_WAY = 0.5
"""Cosine of the angle between a vehicle's heading and the curve beside it, at least."""


def admit(smoother: Smoother, label: int, retest: bool) -> None:
    """Readings that are not in use and lie on the curve: `d^2 < chi^2 (sigma^2 + g' Sigma g)`.

    Those of the newest pose, whose station is found along with them; all in the window where `retest`, since
    the curve has grown. A reading of unknown colour is used only where one curve alone would have it.
    """
    readings, gate = smoother.readings, smoother.settings.gate
    rows = np.concatenate([readings.pending(label), readings.contested(label)])
    if not retest:
        rows = rows[readings.slot[rows] == len(smoother.times) - 1]
    rows, foot, projected = _near_curve(smoother, label, rows)
    if len(rows) == 0 or smoother.last_step is None:
        return
    variance, unknown = projected.sigma**2 + gate.sigma_floor**2, readings.label[rows] == UNKNOWN
    passes = foot.distance**2 < np.where(unknown, gate.chi_unknown, gate.chi) ** 2 * variance
    far = np.flatnonzero(~passes & ~unknown)
    if len(far):  # what the joint uncertainty adds matters to these only
        variance[far] += joint_variance(
            smoother, label, readings.slot[rows[far]], _take(foot, far), _take(projected, far)
        )
        passes[far] = foot.distance[far] ** 2 < gate.chi**2 * variance[far]
    taken = readings.used[rows]
    doubtful = rows[passes & taken]
    readings.used[doubtful], readings.boundary[doubtful] = False, UNKNOWN
    passes &= ~taken
    chosen = rows[passes]
    readings.used[chosen], readings.boundary[chosen] = True, label
    readings.u[chosen] = foot.u[passes]


def _near_curve(
    smoother: Smoother, label: int, rows: IntArray
) -> tuple[IntArray, FootPoints, ProjectionRows]:
    """Those of some readings that lie roughly on the visible stretch of a curve, projected on it.

    In the same search the newest pose gets its station.
    """
    readings, state, settings = smoother.readings, smoother.state, smoother.settings
    boundary, gate, slots = state.boundaries[label], settings.gate, readings.slot[rows]
    poses = state.poses[slots]
    points = to_map(readings.point[rows], poses)
    expected, behind, ahead = _expected_station(state, label, settings)
    stations = np.append(state.stations[label], expected)[slots]
    low = np.append(stations - gate.view_behind, expected - behind)
    high = boundary.believed(np.append(stations + gate.view_ahead, expected + ahead))
    sought = np.concatenate([points, state.poses[-1:, :2]])
    foot = boundary.find(state.control_points(label), sought, low, high)
    station = float(foot.u[-1])
    if _lost(foot, state.poses[-1, 2], gate.station_lateral):
        smoother.refresh()
        station = relocate(boundary, state.control_points(label), state.poses[-1], gate.station_room)
    _append_station(state, label, station)
    keep = np.flatnonzero(foot.interior[:-1] & (np.abs(foot.distance[:-1]) < gate.rough))
    rows, foot = rows[keep], _take(foot, keep)
    sigma_model = settings.spline.sigma_model
    return rows, foot, project(points[keep], readings.covariance[rows], poses[keep], foot, sigma_model)


def _expected_station(state: State, label: int, settings: MapperSettings) -> tuple[float, float, float]:
    """About where the newest pose's foot point is, and how far behind and ahead it is looked for (m)."""
    known, gate = float(state.stations[label][-1]), settings.gate
    moved = float(np.hypot(*(state.poses[-1, :2] - state.poses[-2, :2])))
    if moved < gate.station_step:
        return known, settings.spline.refine_room, settings.spline.refine_room
    return known, gate.station_behind, gate.station_ahead


def _lost(foot: FootPoints, heading: float, lateral: float) -> bool:
    """Whether the last foot point can't be the vehicle's: the curve runs against it there, or is far off."""
    along = foot.tangent_unit[-1] @ np.array([np.cos(heading), np.sin(heading)])
    return bool(along < 0.0 or abs(foot.distance[-1]) > lateral)


def relocate(boundary: Boundary, control_points: Array, pose: Array, room: float) -> float:
    """Parameter of the nearest point that runs the way of a pose (3,), to 60 degrees.

    Anywhere on a closed curve. On an open one, which grows with the vehicle, on its last `room` metres, and
    its end where nothing there runs that way.
    """
    low, high = boundary.tables.low, boundary.tables.high
    if not boundary.periodic:
        low, high = max(low, boundary.confirmed - room), float(boundary.believed(np.array(high)))
    u = np.append(np.arange(low, high, boundary.settings.search_step), high)
    offset = boundary.evaluate(control_points, u) - pose[:2]
    tangent = boundary.evaluate(control_points, u, 1)
    along = tangent @ np.array([np.cos(pose[2]), np.sin(pose[2])])
    same_way = along > SAME_WAY * np.hypot(tangent[:, 0], tangent[:, 1])
    if not same_way.any():
        return high
    distance = np.where(same_way, np.hypot(offset[:, 0], offset[:, 1]), np.inf)
    start = u[np.argmin(distance)]
    return float(boundary.refine(control_points, pose[None, :2], np.array([start])).u[0])


def _append_station(state: State, label: int, u: float) -> None:
    """The newest pose's station; on a closed curve laps add up."""
    boundary, known = state.boundaries[label], state.stations[label]
    if boundary.periodic:
        u += boundary.length * np.round((known[-1] - u) / boundary.length)
    state.stations[label] = np.append(known, u)


def _take(rows: T, keep: IntArray) -> T:
    """Some rows of a dataclass of columns."""
    return type(rows)(*(getattr(rows, column.name)[keep] for column in fields(rows)))


def joint_variance(
    smoother: Smoother, label: int, slots: IntArray, foot: FootPoints, projected: ProjectionRows
) -> Array:
    """`g_i' Sigma g_i` (m,) in m^2: variance of each row's residual by what is estimated.

    Sigma is that of the last step, which the newest pose wasn't part of: it is reached through its odometry,
    `g_last = g dx_now/dx_last`, `g_calibration = -g R G`, plus the odometry's own noise.
    """
    step, state = smoother.last_step, smoother.state
    assert step is not None
    gradient = _control_gradient(state, label, foot, projected, step)
    by_pose, extra = projected.by_pose.copy(), np.zeros(len(slots))
    newest = slots == len(smoother.times) - 1
    if newest.any():
        g = by_pose[newest]
        local = g @ _rotation(state.poses[-1, 2])
        odometry: IntegratedOdometry = smoother.odometry[-1]
        extra[newest] = np.einsum("mi,ij,mj->m", local, odometry.covariance, local)
        calibration = step.position[state.map_size : state.map_size + CALIBRATION_SIZE]
        gradient[calibration[:, None], newest] = (-local @ odometry.calibration_jacobian).T
        dx, dy = state.poses[-1, :2] - state.poses[-2, :2]
        by_pose[newest, 2] += g[:, 1] * dx - g[:, 0] * dy
        slots = np.where(newest, slots - 1, slots)
    columns = step.poses + POSE * (slots + step.dropped)[:, None] + np.arange(POSE)
    gradient[columns, np.arange(len(slots))[:, None]] += by_pose
    half, _ = lapack.dtrtrs(step.factor, gradient, lower=1, overwrite_b=1)
    return np.asarray(np.einsum("im,im->m", half, half)) + extra


def _control_gradient(
    state: State, label: int, foot: FootPoints, projected: ProjectionRows, step: Step
) -> Array:
    """(n, m) derivative of each residual by the step's system, of which only control points are filled in.

    A reading where the map was far has none: it gets no benefit of the doubt, and waits for the next cycle.
    """
    m = len(foot.u)
    gradient = np.zeros((len(step.factor), m), order="F")
    base = state.offset(label) + 2 * state.boundaries[label].columns(foot.span)
    place, row = step.position[base], np.broadcast_to(np.arange(m)[:, None], base.shape)
    known = place >= 0
    gradient[place[known], row[known]] += projected.by_control[:, :, 0][known]
    gradient[place[known] + 1, row[known]] += projected.by_control[:, :, 1][known]
    return gradient


def _rotation(theta: float) -> Array:
    """(3, 3) a pose's own tangent to the map frame's (x, y, theta)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
