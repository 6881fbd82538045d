"""The start of the batch from an online run of the same log: its final map, and all of its poses there."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult
from pathspace_graph.mapping.state import State
from pathspace_graph.run import OnlineEstimator, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary

from .association import add_drive
from .knots import exact_settings

Array = NDArray[np.float64]


class CurveMapper(OnlineEstimator, Protocol):
    """An online estimator with curves, such as `FixedLagMapper`. The batch can begin with its map."""

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Returns the curves by label, without their control points."""

    @property
    def calibrations(self) -> Array:
        """Returns the calibration of the odometry (2,), or of odometry and sensor (7,)."""

    @property
    def closed(self) -> bool:
        """Returns whether the loop has closed."""

    def control_points(self, label: int) -> Array:
        """Returns the control points (m, 2) of a boundary in m, map frame."""

    @property
    def corrected_poses(self) -> Array:
        """Returns the poses (k, 3) of the first k cycles as the closing of the loop has corrected them."""


def start_online(log: Log, mapper: CurveMapper) -> tuple[State, RunResult]:
    """Returns the final map of an online run with all of its poses, and the run."""
    run = run_online(log, mapper)
    settings: MapperSettings = mapper.settings
    state, batch = State(), settings.batch
    for label, boundary in mapper.boundaries.items():
        exact = exact_settings(boundary.settings, batch)
        own = Boundary(boundary.knots, boundary.periodic, exact, boundary.gauge)
        own.confirmed_end = boundary.confirmed_end
        state.add_boundary(label, own, mapper.control_points(label))
    corrected = mapper.corrected_poses
    poses = unwrap(np.concatenate([corrected, run.trajectory[len(corrected) :]]))
    add_drive(state, poses, mapper.calibrations, batch.association)
    return state, run


def unwrap(poses: Array) -> Array:
    """Returns poses (n, 3) whose headings have no jump."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]) if len(poses) else poses
