"""The start of the batch from an online run of the same log: its final map, and all of its poses there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map, wrap_angle
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunResult
from pathspace_graph.mapping.state import State
from pathspace_graph.run import CycleResult, OnlineEstimator, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary

from .association import add_drive
from .knots import exact_settings

Array = NDArray[np.float64]


class CurveMapper(OnlineEstimator, Protocol):
    """An online estimator with curves, such as `FixedLagMapper`. The batch can begin with its map."""

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Returns the curves by label, without their control points."""

    @property
    def calibration(self) -> Array:
        """Returns the calibration (2,) of the odometry: scale error [-] and yaw-rate bias [rad/s]."""

    @property
    def closed(self) -> bool:
        """Returns whether the loop has closed."""

    def control_points(self, label: int) -> Array:
        """Returns the control points (m, 2) of a boundary in m, map frame."""

    def pose_parameter(self, label: int) -> float:
        """Returns the parameter (m) of the newest pose's foot point, which goes on from lap to lap."""


@dataclass(frozen=True, eq=False)
class Place:
    """Holds the point of a curve beside the vehicle, as the curve was in one cycle."""

    cycle: int
    """This is the perception cycle."""
    u: float
    """This is the parameter of the point, which goes on from lap to lap."""
    pose: Array
    """This is the point's position and the direction of the curve there (3,): x, y (m), theta (rad)."""


class Recorder:
    """A recorder passes cycles on to an online mapper, and notes its places along the curves."""

    def __init__(self, mapper: CurveMapper) -> None:
        self.mapper = mapper
        self.places: dict[int, list[Place]] = {}
        """These are the places along each boundary, oldest first."""
        self.closed_at: int | None = None
        """This is the cycle in which the loop closed."""
        self._cycle = 0

    @property
    def settings(self) -> MapperSettings:
        """Returns the mapper's settings."""
        settings: MapperSettings = self.mapper.settings
        return settings

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Updates the mapper, and notes where it is."""
        result = self.mapper.update(odometry, detections)
        for label, boundary in self.mapper.boundaries.items():
            u = self.mapper.pose_parameter(label)
            (pose,) = curve_poses(boundary, self.mapper.control_points(label), np.array([u]))
            self.places.setdefault(label, []).append(Place(self._cycle, u, pose))
        if self.mapper.closed and self.closed_at is None:
            self.closed_at = self._cycle
        self._cycle += 1
        return result

    def map(self) -> Map:
        """Returns the mapper's map."""
        return self.mapper.map()


def start_online(log: Log, mapper: CurveMapper) -> tuple[State, RunResult]:
    """Returns the final map of an online run with all of its poses, and the run."""
    recorder = Recorder(mapper)
    run = run_online(log, recorder)
    state, batch = State(), recorder.settings.batch
    for label, boundary in mapper.boundaries.items():
        exact = exact_settings(boundary.settings, batch)
        own = Boundary(boundary.knots, boundary.periodic, exact, boundary.gauge)
        own.confirmed_end = boundary.confirmed_end
        state.add_boundary(label, own, mapper.control_points(label))
    poses = unwrap(run.trajectory)
    if recorder.closed_at is not None:
        poses = in_final_map(poses, recorder.closed_at, recorder.places, state, recorder.settings)
    add_drive(state, poses, mapper.calibration, batch.association)
    return state, run


def curve_poses(boundary: Boundary, control_points: Array, u: Array) -> Array:
    """Returns the position of a curve at parameters u (m,) and its direction there, (m, 3): x, y, theta."""
    position, tangent = (boundary.evaluate(control_points, u, order) for order in (0, 1))
    return np.column_stack([position, np.arctan2(tangent[:, 1], tangent[:, 0])])


def unwrap(poses: Array) -> Array:
    """Returns poses (n, 3) whose headings have no jump."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]) if len(poses) else poses


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
