"""What a run is compared with: the landmark batch that is told all about its log."""

from dataclasses import replace

import numpy as np

from pathspace_graph.baselines.landmarks import LandmarkState, LandmarkSystem, solve_landmarks
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.io.log import Detections, Log, Truth, ray_covariances
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.settings.mapper import CalibrationSettings, MapperSettings

from .accuracy import root_mean_square


def solve_oracle_landmarks(log: Log) -> tuple[LandmarkSystem, LandmarkState]:
    """Return the landmark batch with oracle association: each detection knows its true cone, the landmark.

    It also knows the sensor's constant errors, the bend of its ranges and the true noise, where the log has
    them.
    """
    truth = truth_of(log)
    if truth.associations is None:
        raise ValueError("expected a simulated log, whose associations are known, found one without")
    settings = MapperSettings(calibration=CalibrationSettings(sensor=truth.sensor is None))
    told, associations = without_sensor_errors(with_true_covariances(log), truth.associations)
    return solve_landmarks(with_true_noise(told, associations), associations, settings)


def without_sensor_errors(log: Log, associations: IntArray) -> tuple[Log, IntArray]:
    """Return a log without its sensor's true constant errors, and the associations (R,) that are left.

    Cycles get the stamps at which they were seen; those before the first odometry are left out. A range r
    that reads `(1 + scale) r + bias + k max(r - begin, 0)^2`, and a covariance beside it, are inverted to
    first order in the noise.
    """
    truth = truth_of(log)
    if truth.sensor is None and truth.bend is None:
        return log, associations
    yaw, lateral, latency, scale, bias = np.zeros(5) if truth.sensor is None else truth.sensor
    k, begin = np.zeros(2) if truth.bend is None else truth.bend
    c, s = np.cos(yaw), np.sin(yaw)
    to_vehicle = np.array([[c, -s], [s, c]])
    parts = np.split(associations, np.cumsum([len(cycle.labels) for cycle in log.cycles])[:-1])
    cycles, left = [], []
    for cycle, part in zip(log.cycles, parts, strict=True):
        if cycle.t - latency < log.odometry.t[0]:
            continue
        measured = cycle.points_vehicle
        distance, radial = _rays(measured)
        excess = distance - bias - (1.0 + scale) * begin
        squared = (1.0 + scale) ** 2 + 4.0 * k * np.maximum(excess, 0.0)
        slope = np.sqrt(np.maximum(squared, np.finfo(float).eps))  # of the measured range by the true one
        ranges = begin + 2.0 * excess / (1.0 + scale + slope)
        across = ranges / distance
        change = to_vehicle @ (radial / slope[:, None, None] + across[:, None, None] * (np.eye(2) - radial))
        points = measured * across[:, None] @ to_vehicle.T + [0.0, lateral]
        covariances = change @ cycle.covariances @ change.transpose(0, 2, 1)
        cycles.append(Detections(cycle.t - latency, points, covariances, cycle.labels))
        left.append(part)
    return replace(log, cycles=tuple(cycles)), np.concatenate([np.zeros(0, dtype=int), *left])


def with_true_covariances(log: Log) -> Log:
    """Return a log that states the true noise of single detections, where its truth has it."""
    rays = truth_of(log).rays
    if rays is None:
        return log
    log = log.with_covariances(lambda points: ray_covariances(points, rays))
    return replace(log, odometry_stated=True, detections_stated=True)


def with_true_noise(log: Log, associations: IntArray) -> Log:
    """Return a log that states white noise as harmful as its true noise.

    The variance of the mean of n errors of a cone, of which a share stays with it for a time, is that of
    independent ones times `1 + share (sum_ij exp(-|t_i - t_j| / time) / n - 1)`. The covariances are
    multiplied by it, along the ray and across.
    """
    noise = truth_of(log).noise
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
        radial = _rays(cycle.points_vehicle)[1]
        along, across = np.sqrt(factors[row : row + size]).T[:, :, None, None]
        change = along * radial + across * (np.eye(2) - radial)
        cycles.append(replace(cycle, covariances=change @ cycle.covariances @ change))
        row += size
    return replace(log, cycles=tuple(cycles), odometry_sigma=noise[:3], odometry_drift=np.zeros(3))


def _rays(points: Array) -> tuple[Array, Array]:
    """Return the distances (m,) of points (m, 2), and the projections (m, 2, 2) on their rays."""
    distance = np.maximum(np.linalg.norm(points, axis=1), np.finfo(float).tiny)
    unit = points / distance[:, None]
    return distance, unit[:, :, None] * unit[:, None, :]


def landmark_rmse(solved: LandmarkState, truth: Truth) -> float:
    """Return sqrt(mean |l_j - cone_j|^2) in m over the cones of a boundary that were ever detected."""
    counted = np.isin(truth.cone_labels[solved.numbers], BOUNDARIES)
    errors = solved.landmarks - truth.cones[solved.numbers]
    return root_mean_square(np.linalg.norm(errors[counted], axis=1))


def truth_of(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a log with truth, found one without")
    return log.truth
