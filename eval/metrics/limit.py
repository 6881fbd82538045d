"""The limit of a run: the error that remains with oracle association and curves fitted to the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Detections, Log, Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.landmark.batch import LandmarkSolution, solve_landmarks
from pathspace_graph.settings.calibration import CalibrationSettings
from pathspace_graph.settings.knots import FitSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import fit_spline

from .curves import driving_order
from .table1 import closest_points, root_mean_square

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Limit:
    """Holds the least error that a run can be expected to reach."""

    l: float  # noqa: E741 - the issue's and the paper's tables call it so
    """This is the rmse (m) in the plane of the landmark batch with oracle association."""

    f: float
    """This is the rmse (m) of the true cones to splines of the mapped size that are fitted to them."""

    @property
    def total(self) -> float:
        """Returns sqrt(l^2 + f^2) in m."""
        return float(np.hypot(self.l, self.f))


def limit(log: Log, track: Map) -> Limit:
    """Returns the limit of a simulated log and a map of it; ValueError without truth or associations."""
    truth = _truth(log)
    return Limit(l=landmark_rmse(solve_oracle_landmarks(log), truth), f=fit_rmse(track, truth))


def solve_oracle_landmarks(log: Log, *, with_covariance: bool = False) -> LandmarkSolution:
    """Returns the landmark batch with oracle association: each detection knows its true cone.

    It is also told the sensor's constant errors and the true noise, where the log has them. Landmark ids are
    indices of true cones.
    """
    truth = _truth(log)
    if truth.associations is None:
        raise ValueError("expected a simulated log, whose associations are known, found one without")
    if truth.sensor is None and truth.noise is None:
        return solve_landmarks(log, truth.associations, with_covariance=with_covariance)
    settings = MapperSettings(calibration=CalibrationSettings(sensor=truth.sensor is None))
    told, associations = without_sensor_errors(log, truth.associations)
    told = with_true_noise(told, associations)
    return solve_landmarks(told, associations, with_covariance=with_covariance, settings=settings)


def without_sensor_errors(log: Log, associations: Ints) -> tuple[Log, Ints]:
    """Returns a log without its sensor's true constant errors, and the associations (R,) that are left.

    Cycles get the stamps at which they were seen; those before the first odometry are left out. A range r
    that reads `(1 + scale) r + bias`, and a covariance beside it, are inverted to first order in the noise.
    """
    truth = _truth(log)
    if truth.sensor is None:
        return log, associations
    yaw, lateral, latency, scale, bias = truth.sensor.tolist()
    c, s = np.cos(yaw), np.sin(yaw)
    to_vehicle = np.array([[c, -s], [s, c]])
    parts = np.split(associations, np.cumsum([len(cycle.labels) for cycle in log.cycles])[:-1])
    cycles, left = [], []
    for cycle, part in zip(log.cycles, parts, strict=True):
        if cycle.t - latency < log.odometry.t[0]:
            continue
        measured = cycle.points_vehicle
        distance = np.maximum(np.linalg.norm(measured, axis=1), np.finfo(float).tiny)
        unit = measured / distance[:, None]
        radial = unit[:, :, None] * unit[:, None, :]
        across = (distance - bias) / (1.0 + scale) / distance
        change = radial / (1.0 + scale) + across[:, None, None] * (np.eye(2) - radial)
        change = to_vehicle @ change
        points = measured * across[:, None] @ to_vehicle.T + [0.0, lateral]
        covariances = change @ cycle.covariances @ change.transpose(0, 2, 1)
        cycles.append(Detections(cycle.t - latency, points, covariances, cycle.labels))
        left.append(part)
    return replace(log, cycles=tuple(cycles)), np.concatenate([np.zeros(0, dtype=int), *left])


def with_true_noise(log: Log, associations: Ints) -> Log:
    """Returns a log that states white noise as harmful as its true noise.

    The variance of the mean of n errors of a cone, of which a share stays with it for a time, is that of
    independent ones times `1 + share (sum_ij exp(-|t_i - t_j| / time) / n - 1)`. The covariances are
    multiplied by it, along the ray and across.
    """
    noise = _truth(log).noise
    if noise is None:
        return log
    stamps = np.repeat([cycle.t for cycle in log.cycles], [len(cycle.labels) for cycle in log.cycles])
    factors = np.ones((len(stamps), 2))
    for cone in np.unique(associations[associations >= 0]):
        rows = np.flatnonzero(associations == cone)
        correlations = np.exp(-np.abs(stamps[rows, None] - stamps[rows]) / noise[5])
        factors[rows] = 1.0 + noise[3:5] * (correlations.sum() / len(rows) - 1.0)
    cycles, row = [], 0
    for cycle in log.cycles:
        size = len(cycle.labels)
        distance = np.maximum(np.linalg.norm(cycle.points_vehicle, axis=1), np.finfo(float).tiny)
        unit = cycle.points_vehicle / distance[:, None]
        radial = unit[:, :, None] * unit[:, None, :]
        along, across = np.sqrt(factors[row : row + size]).T[:, :, None, None]
        change = along * radial + across * (np.eye(2) - radial)
        cycles.append(replace(cycle, covariances=change @ cycle.covariances @ change))
        row += size
    return replace(log, cycles=tuple(cycles), odometry_sigma=noise[:3])


def landmark_rmse(solution: LandmarkSolution, truth: Truth) -> float:
    """Returns sqrt(mean |l_j - cone_j|^2) in m over the cones of a boundary that were ever detected."""
    counted = np.isin(truth.cone_labels[solution.landmark_ids], BOUNDARIES)
    errors = solution.landmarks - truth.cones[solution.landmark_ids]
    return root_mean_square(np.linalg.norm(errors[counted], axis=1))


def fit_rmse(track: Map, truth: Truth) -> float:
    """Returns sqrt(mean d^2) in m, d from true cones to splines of the mapped size that are fitted to them.

    A boundary of points, or with a control point for every cone, can be exact: its distances are 0.
    Boundaries that aren't mapped don't count.
    """
    distances = [np.zeros(0)]
    for label, boundary in track.boundaries.items():
        cones = driving_order(truth, label)
        if isinstance(boundary, SplineBoundary) and boundary.size < len(cones):
            distances.append(fit_distances(cones, boundary.size, boundary.spline))
        else:
            distances.append(np.zeros(len(cones)))
    return root_mean_square(np.concatenate(distances))


def fit_distances(cones: Array, size: int, like: BSpline) -> Array:
    """Returns the distances (k,) in m of cones (k, 2), in driving order, from a spline fitted to them.

    The spline has `size` control points, and the degree and periodicity of `like`. Its knots follow the
    curvature (paper, section Simplification).
    """
    fitted = fit_spline(cones, size, like.periodic, FitSettings(degree=like.degree))
    return np.asarray(np.linalg.norm(cones - closest_points(fitted, cones).position, axis=1))


def _truth(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a log with truth, found one without")
    return log.truth
