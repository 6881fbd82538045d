"""Which readings of a log belong to which curve: every one tested anew against where the curves are now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import CALIBRATION_KEY, pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import GateSettings, MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


OTHER_DIRECTION = 100.0
"""A curve that leads another way counts as so much farther (m): taken only where no other does."""
POSE_U_STEP = 1.0
"""Step (m) along a curve at which stations are looked for."""


def add_drive(state: State, poses: Array, calibration: Array) -> None:
    """The poses (P, 3) of all cycles and the calibration (2,) beside curves that are there already."""
    state.variables.insert(np.array([CALIBRATION_KEY]), calibration)
    state.variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    locate_poses(state)


def locate_poses(state: State) -> None:
    """Stations: the parameter of the nearest point of each curve that leads the way each pose heads.

    Without the heading, the inside of a hairpin is as near at its far leg. Laps of a closed curve add up.
    """
    for label, boundary in state.boundaries.items():
        low, length = boundary.tables.low, boundary.length
        u = low + length * (np.arange(int(np.ceil(length / POSE_U_STEP))) + 0.5) / np.ceil(
            length / POSE_U_STEP
        )
        position, tangent = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
        tangent /= np.maximum(np.hypot(*tangent.T), np.finfo(float).tiny)[:, None]
        poses = state.poses
        offset_x = poses[:, :1] - position[:, 0]
        offset_y = poses[:, 1:2] - position[:, 1]
        heading = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        square = offset_x**2 + offset_y**2
        square[heading @ tangent.T < SAME_DIRECTION] += OTHER_DIRECTION**2
        nearest = u[square.argmin(axis=1)]
        state.pose_u[label] = np.unwrap(nearest, period=length) if boundary.periodic else nearest


def associate(
    state: State, detections: DetectionTable, settings: MapperSettings, gate: float, strict: bool
) -> int:
    """Put every reading into use that lies within `gate` sigmas of its curve; gives how many changed.

    Searched for in the stretch that is visible from the reading's pose; where `strict`, what isn't explained
    there is searched for on the whole curve: across the infield a sensor sees stretches that come much later.
    A label is believed; a reading of unknown colour goes to the curve that it fits better, but not before
    curves are where they belong: cones of no boundary stand beside them.
    """
    before = np.where(detections.used, detections.boundary, UNKNOWN)
    boundary_of, u = np.full(len(detections), UNKNOWN), detections.u.copy()
    for whole in (False, True) if strict else (False,):
        left = boundary_of == UNKNOWN
        best = np.full(len(detections), gate)
        for label in state.boundaries:
            named = (detections.label == label) | (strict & (detections.label == UNKNOWN))
            rows = np.flatnonzero(left & named)
            misfit, foot_u = _misfit(state, detections, settings, label, rows, whole)
            nearer = misfit < best[rows]
            chosen = rows[nearer]
            best[chosen], boundary_of[chosen], u[chosen] = misfit[nearer], label, foot_u[nearer]
    detections.release(np.arange(len(detections)))
    used = np.flatnonzero(boundary_of != UNKNOWN)
    detections.take(used, boundary_of[used], u[used])
    return int((before != boundary_of).sum())


def _misfit(
    state: State,
    detections: DetectionTable,
    settings: MapperSettings,
    label: int,
    rows: IntArray,
    whole: bool,
) -> tuple[Array, Array]:
    """(m,) distance of readings from a curve in sigmas, infinite where it isn't theirs; foot points (m,)."""
    boundary, poses = state.boundaries[label], state.variables.poses_at(detections.cycle[rows])
    points = to_map(detections.point[rows], poses)
    if whole:
        low, high = np.full(len(rows), boundary.tables.low), np.full(len(rows), boundary.tables.high)
        foot = boundary.find(state.control_points(label), points, low, high)
    else:
        begin = _nearest_in_view(state, detections.cycle[rows], points, label, settings.gate)
        foot = boundary.refine(state.control_points(label), points, begin)
    projected = project(points, detections.covariance[rows], poses, foot, settings.spline.sigma_model)
    possible = foot.interior & (np.abs(foot.distance) < settings.gate.rough)
    return np.where(possible, np.abs(foot.distance) / projected.sigma, np.inf), foot.u


def _nearest_in_view(state: State, cycles: IntArray, points: Array, label: int, gate: GateSettings) -> Array:
    """(m,) the parameter nearest to each point (m, 2) among those that its pose sees, a step apart."""
    boundary = state.boundaries[label]
    ahead = np.arange(-gate.view_behind, gate.view_ahead + POSE_U_STEP, POSE_U_STEP)
    u = state.pose_u[label][:, None] + ahead
    seen = boundary.evaluate(state.control_points(label), u.ravel()).reshape(*u.shape, 2)
    square = (seen[cycles, :, 0] - points[:, :1]) ** 2
    square += (seen[cycles, :, 1] - points[:, 1:]) ** 2
    return np.asarray(u[cycles, square.argmin(axis=1)])
