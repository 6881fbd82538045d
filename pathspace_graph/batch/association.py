"""Where the poses are along the curves, and which detections of a log belong to which curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.projection import project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import AssociationSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def add_drive(state: State, poses: Array, calibration: Array, settings: AssociationSettings) -> None:
    """Adds the poses (P, 3) of all cycles to a state that has its curves already.

    The calibration is that of the odometry (2,), or of odometry and sensor (7,).
    """
    state.variables.insert_calibrations(calibration)
    state.variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    locate_poses(state, settings)


def locate_poses(state: State, settings: AssociationSettings) -> None:
    """Sets `pose_u`: the parameter of each curve's nearest point that runs in the direction of each pose.

    Without the heading, a pose in a hairpin could be put beside the other leg. On a closed curve the
    parameter goes on from lap to lap. On an open one it goes on with the drive: where the curve has drifted
    over a stretch of itself, the poses are not put beside that stretch.
    """
    for label, boundary in state.boundaries.items():
        count = int(np.ceil(boundary.length / settings.step))
        u = boundary.tables.low + boundary.length * (np.arange(count) + 0.5) / count
        position, tangent = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
        tangent /= np.maximum(np.hypot(*tangent.T), np.finfo(float).tiny)[:, None]
        poses = state.poses
        offset_x = poses[:, :1] - position[:, 0]
        offset_y = poses[:, 1:2] - position[:, 1]
        heading = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        square = offset_x**2 + offset_y**2
        square[heading @ tangent.T < SAME_DIRECTION] += settings.direction_penalty**2
        if boundary.periodic:
            state.pose_u[label] = np.unwrap(u[square.argmin(axis=1)], period=boundary.length)
        else:
            driven = np.hypot(*np.diff(poses[:, :2], axis=0).T) + settings.room
            state.pose_u[label] = u[_along(square, driven * count / boundary.length)]


def _along(square: Array, steps: Array) -> IntArray:
    """Returns the samples (P,) beside which the poses are, of least total squared distance (P, n).

    From a pose to the next, the sample changes by no more than the next of `steps` (P - 1,).
    """
    total, reach = square.copy(), np.ceil(steps).astype(np.intp)
    for k in range(1, len(total)):
        total[k] += minimum_filter1d(total[k - 1], 2 * int(reach[k - 1]) + 1, mode="nearest")
    samples = np.empty(len(total), np.intp)
    samples[-1:] = total[-1:].argmin(axis=1)
    for k in range(len(total) - 1, 0, -1):
        low = max(samples[k] - reach[k - 1], 0)
        samples[k - 1] = low + total[k - 1, low : samples[k] + reach[k - 1] + 1].argmin()
    return samples


def associate(
    state: State, detections: DetectionTable, settings: MapperSettings, gate: float, strict: bool
) -> None:
    """Associates every detection anew: it is used where it lies within `gate` sigmas of its curve.

    A detection is searched for on the stretch of the curve that its pose sees.
    `strict` means that the curves are about where they belong. Then a detection that fits nowhere in that
    stretch is searched for on the whole of a closed curve, since the sensor sees much later stretches across
    the infield. An open curve has drifted against itself by more than the gate from one stretch to a far one.
    A detection that happened to fit there would say that it has not, so it isn't compared.
    And a detection of unknown colour goes to the curve that it fits better. It isn't used before, since
    cones that belong to no boundary stand beside the track. A known colour is always believed.
    """
    boundary_of, u = np.full(len(detections), UNKNOWN), detections.u.copy()
    for whole in (False, True) if strict else (False,):
        unexplained = boundary_of == UNKNOWN
        best = np.full(len(detections), gate)
        for label, boundary in state.boundaries.items():
            if whole and not boundary.periodic:
                continue
            possible = (detections.label == label) | (strict & (detections.label == UNKNOWN))
            rows = np.flatnonzero(unexplained & possible)
            misfit, foot_u = _misfit(state, detections, settings, label, rows, whole)
            nearer = misfit < best[rows]
            chosen = rows[nearer]
            best[chosen], boundary_of[chosen], u[chosen] = misfit[nearer], label, foot_u[nearer]
    detections.release(np.arange(len(detections)))
    used = np.flatnonzero(boundary_of != UNKNOWN)
    detections.take(used, boundary_of[used], u[used])


def _misfit(
    state: State,
    detections: DetectionTable,
    settings: MapperSettings,
    label: int,
    rows: IntArray,
    whole: bool,
) -> tuple[Array, Array]:
    """Returns how far each of the rows (m,) is from a curve, in sigmas (m,), and its foot point u (m,).

    The distance is infinite where the detection can't belong to the curve. `whole` searches the whole curve.
    """
    boundary, poses = state.boundaries[label], state.variables.poses_at(detections.cycle[rows])
    points = to_map(detections.point[rows], poses)
    if whole:
        foot = find_anywhere(boundary, state.control_points(label), points)
    else:
        begin = _nearest_in_view(state, detections.cycle[rows], points, label, settings)
        foot = boundary.refine(state.control_points(label), points, begin)
    projected = project(points, detections.covariance[rows], poses, foot, settings.spline.sigma_model)
    possible = foot.interior & (np.abs(foot.distance) < settings.gate.rough)
    return np.where(possible, np.abs(foot.distance) / projected.sigma, np.inf), foot.u


def find_anywhere(boundary: Boundary, control_points: Array, points: Array) -> FootPoints:
    """Returns the foot points of points (m, 2) on a whole curve."""
    low, high = (np.full(len(points), end) for end in (boundary.tables.low, boundary.tables.high))
    return boundary.find(control_points, points, low, high)


def _nearest_in_view(
    state: State, cycles: IntArray, points: Array, label: int, settings: MapperSettings
) -> Array:
    """Returns the parameter (m,) nearest to each point (m, 2) on the stretch that its cycle's pose sees."""
    boundary, gate, step = state.boundaries[label], settings.gate, settings.batch.association.step
    ahead = np.arange(-gate.view_behind, gate.view_ahead + step, step)
    u = state.pose_u[label][:, None] + ahead
    seen = boundary.evaluate(state.control_points(label), u.ravel()).reshape(*u.shape, 2)
    square = (seen[cycles, :, 0] - points[:, :1]) ** 2
    square += (seen[cycles, :, 1] - points[:, 1:]) ** 2
    return np.asarray(u[cycles, square.argmin(axis=1)])
