"""Where the batch begins: at what an online run of the same log has found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import CycleRecord, RunResult
from pathspace_graph.mapping.state import State
from pathspace_graph.run import CycleResult, OnlineEstimator, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, Boundary

from .association import add_drive
from .knots import exact_settings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Place:
    """Where a curve was beside the vehicle, as it stood then."""

    cycle: int
    """Perception cycle."""
    u: float
    """Parameter of the pose's foot point, laps adding up."""
    position: Array
    """(2,) S(u), m."""
    heading: float
    """Direction of S'(u), rad."""


class CurveMapper(OnlineEstimator, Protocol):
    """An online estimator whose curves the batch can begin with, as `FixedLagMapper` is one."""

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """The curves by label, without their control points."""

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]) of the odometry."""

    @property
    def closed(self) -> bool:
        """Whether the loop has closed."""

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary, map frame, m."""

    def pose_parameter(self, label: int) -> float:
        """Parameter (m) on a boundary of the point beside the newest pose, laps adding up."""


class Recorder:
    """An online mapper that notes in each cycle where it was along its curves."""

    def __init__(self, mapper: CurveMapper) -> None:
        self.mapper = mapper
        self.places: dict[int, list[Place]] = {}
        """Of each boundary, oldest first."""
        self.closed_at: int | None = None
        """Cycle in which the loop closed."""
        self._cycle = 0

    @property
    def settings(self) -> MapperSettings:
        settings: MapperSettings = self.mapper.settings
        return settings

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """The mapper's update, and a note."""
        result = self.mapper.update(odometry, detections)
        for label, boundary in self.mapper.boundaries.items():
            u = np.array([self.mapper.pose_parameter(label)])
            points = self.mapper.control_points(label)
            position, along = (boundary.evaluate(points, u, order)[0] for order in (0, 1))
            place = Place(self._cycle, float(u[0]), position, float(np.arctan2(along[1], along[0])))
            self.places.setdefault(label, []).append(place)
        if self.mapper.closed and self.closed_at is None:
            self.closed_at = self._cycle
        self._cycle += 1
        return result

    def map(self) -> Map:
        return self.mapper.map()


def start_online(
    log: Log, mapper: CurveMapper, on_cycle: Callable[[CycleRecord], None] | None = None
) -> tuple[State, RunResult]:
    """The map that an online run ends with, and every pose of the log beside it; also the run."""
    recorder = Recorder(mapper)
    run = run_online(log, recorder, on_cycle=on_cycle)
    state = State()
    for label, boundary in recorder.mapper.boundaries.items():
        _take_over(state, label, boundary, recorder.mapper.control_points(label))
    poses = _in_final_map(recorder, state, unwrap(run.trajectory))
    add_drive(state, poses, recorder.mapper.calibration)
    return state, run


def unwrap(poses: Array) -> Array:
    """Poses (n, 3) whose headings turn on without a jump."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]) if len(poses) else poses


def _take_over(state: State, label: int, boundary: Boundary, control_points: Array) -> None:
    """A boundary of the same knots for the batch."""
    own = Boundary(boundary.knots, boundary.periodic, exact_settings(boundary.settings), boundary.gauge)
    own.confirmed_end = boundary.confirmed_end
    state.add_boundary(label, own, control_points)


def _in_final_map(recorder: Recorder, state: State, poses: Array) -> Array:
    """Poses from before the loop closed, put beside the closed curves as they were beside the open ones."""
    if recorder.closed_at is None:
        return poses
    total, count = np.zeros_like(poses), np.zeros((len(poses), 1))
    for label, boundary in state.boundaries.items():
        places = [place for place in recorder.places[label] if _beside(place, recorder, poses)]
        if not places:
            continue
        cycles = np.array([place.cycle for place in places], np.intp)
        u = np.array([place.u for place in places])
        position, along = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
        heading = np.arctan2(along[:, 1], along[:, 0])
        turn = np.angle(np.exp(1j * (heading - np.array([place.heading for place in places]))))
        offset = poses[cycles, :2] - np.array([place.position for place in places]).reshape(-1, 2)
        c, s = np.cos(turn), np.sin(turn)
        total[cycles, 0] += position[:, 0] + c * offset[:, 0] - s * offset[:, 1]
        total[cycles, 1] += position[:, 1] + s * offset[:, 0] + c * offset[:, 1]
        total[cycles, 2] += poses[cycles, 2] + turn
        count[cycles] += 1
    known = np.flatnonzero(count[:, 0])
    if len(known) == 0:
        return poses
    correction = total[known] / count[known] - poses[known]
    before = np.arange(recorder.closed_at)
    poses = poses.copy()
    for k in range(poses.shape[1]):  # what no curve was beside of moves with its neighbours
        poses[before, k] += np.interp(before, known, correction[:, k])
    return poses


def _beside(place: Place, recorder: Recorder, poses: Array) -> bool:
    """Whether a place from before the loop closed is on the stretch of curve that the vehicle drove along."""
    assert recorder.closed_at is not None
    pose = poses[place.cycle]
    away = float(np.hypot(*(pose[:2] - place.position)))
    limit = recorder.settings.growth.max_lateral
    return (
        place.cycle < recorder.closed_at and away < limit and np.cos(place.heading - pose[2]) > SAME_DIRECTION
    )
