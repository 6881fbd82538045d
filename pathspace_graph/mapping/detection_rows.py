"""The model of a detection, for window and batch: rows across a curve, and along it at a station."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.graph.drives import Drives
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import FIRST_POSE, SENSOR_KEY, Variables

from .detections import DetectionTable
from .state import State


@dataclass(frozen=True, eq=False)
class DetectionRows:
    """One row for each of m detections on [pose | sensor | control points], not whitened."""

    rows: IntArray  # (m,) detections, by row of the table
    keys: IntArray  # (m, k)
    residual: Array  # (m,) distance from the curve or from the station, in m
    sigma: Array  # (m,) its standard deviation in m; infinite for a detection without information
    jacobian: Array  # (m, n)

    @property
    def whitened(self) -> Array:
        """Residuals (m,) in sigmas."""
        return np.asarray(self.residual / self.sigma)

    def scale(self, weights: Array) -> Array:
        """Factors (m,) that whiten the rows and apply robust weights (m,), in 1/m."""
        return np.asarray(np.sqrt(weights) / self.sigma)

    def weighted(self, weights: Array, owner: IntArray) -> Rows:
        """Whiten the rows and apply robust weights (m,); each row is part of the factor `owner` (m,)."""
        scale = self.scale(weights)
        return Rows(self.keys, self.jacobian * scale[:, None], self.residual * scale, owner)


NO_ROWS: Final = DetectionRows(
    np.zeros(0, np.intp), np.zeros((0, 0), np.intp), np.zeros(0), np.zeros(0), np.zeros((0, 0))
)


def rows_across(
    state: State,
    detections: DetectionTable,
    rows: IntArray,
    points: Array,
    foot: FootPoints,
    sigma_model: float,
) -> DetectionRows:
    """Linearize `n . (R z + t - S(u))` for detections (m,) at points (m, 2), map frame.

    Foot points are on `State.curves`. The terms are those of `factors._kernels:detection_rows`.
    """
    cycle, variables = detections.cycle[rows], state.variables
    measuring = measuring_keys(cycle, variables, state.drives)
    keys = np.concatenate([measuring, state.curves.keys[foot.columns]], axis=1)

    def terms(own: IntArray | slice, sensor: Array) -> tuple[Array, Array, Array]:
        chosen = rows[own]
        return kernels.detection_rows(
            points[own],
            detections.covariance[chosen],
            variables.poses_at(cycle[own]),
            foot.normal_unit[own],
            foot.distance[own],
            foot.basis[own],
            detections.measured[chosen],
            detections.twist[chosen],
            sensor,
            sigma_model,
        )

    return DetectionRows(rows, keys, *state.drives.by_sensor(terms, cycle, variables.sensor))


def measuring_keys(cycle: IntArray, variables: Variables, drives: Drives) -> IntArray:
    """Keys (m, 1) of the poses of cycles (m,), or (m, 2) with the sensor's calibration."""
    sensors = np.asarray(drives.sensors)[drives.of(cycle)]
    keys = np.column_stack([FIRST_POSE + cycle, SENSOR_KEY + sensors])
    return np.asarray(keys[:, : 2 if len(variables.sensor) else 1])
