"""Places of poses along the curves: they say where earlier poses go when the loop closes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map, wrap_angle
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Place:
    """Holds the point of a curve beside the vehicle, as the curve was in one cycle."""

    cycle: int
    """This is the perception cycle."""
    u: float
    """This is the parameter of the point, which goes on from lap to lap."""
    pose: Array
    """This is the point's position and the direction of the curve there (3,): x, y (m), theta (rad)."""


def curve_poses(boundary: Boundary, control_points: Array, u: Array) -> Array:
    """Returns the position of a curve at parameters u (m,) and its direction there, (m, 3): x, y, theta."""
    values, span = boundary.tables.evaluate(u, 1)
    position, tangent = np.einsum("omj,mjd->omd", values, control_points[boundary.columns(span)])
    return np.column_stack([position, np.arctan2(tangent[:, 1], tangent[:, 0])])


def in_final_map(
    poses: Array,
    closed_at: int,
    places: Mapping[int, Sequence[Place]],
    state: State,
    settings: MapperSettings,
) -> Array:
    """Returns the poses (P, 3), those before the loop closed moved with the curves beside them.

    A loop closure bends the map, but an online estimator keeps its earlier poses as they were. Each of them
    is put beside the final curves as it was beside the curves of its own cycle: the place on the curve is
    moved rigidly to the same parameter of the final curve. The result is the mean over both boundaries. A
    pose that was beside no curve is corrected as much as its neighbours are.
    """
    total, count = np.zeros_like(poses), np.zeros((len(poses), 1))
    for label, boundary in state.boundaries.items():
        own = [place for place in places[label] if place.cycle < closed_at]
        own = [place for place in own if _is_beside(place, poses[place.cycle], settings)]
        if not own:
            continue
        cycles = np.array([place.cycle for place in own], np.intp)
        before = np.array([place.pose for place in own])
        after = curve_poses(boundary, state.control_points(label), np.array([place.u for place in own]))
        after[:, 2] = wrap_angle(after[:, 2] - before[:, 2])
        total[cycles, :2] += to_map(poses[cycles, :2] - before[:, :2], after)
        total[cycles, 2] += poses[cycles, 2] + after[:, 2]
        count[cycles] += 1
    known = np.flatnonzero(count[:, 0])
    if len(known) == 0:
        return poses
    correction = total[known] / count[known] - poses[known]
    earlier, poses = np.arange(closed_at), poses.copy()
    for k in range(poses.shape[1]):
        poses[earlier, k] += np.interp(earlier, known, correction[:, k])
    return poses


def _is_beside(place: Place, pose: Array, settings: MapperSettings) -> bool:
    """Returns whether the vehicle at a pose (3,) drove along the curve at a place."""
    distance = float(np.hypot(*(pose[:2] - place.pose[:2])))
    same_direction = np.cos(place.pose[2] - pose[2]) > SAME_DIRECTION
    return bool(distance < settings.growth.max_lateral and same_direction)
