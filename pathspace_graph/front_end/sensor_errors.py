"""What the check of the odometry learns of the sensor: how much it is turned, and how late it is.

A sensor that is turned by psi sees each motion turned by -psi. Detections that are late by tau lie too far
ahead by `tau v`. While the vehicle goes on evenly, that is the same in every cycle, and no match of
detections shows it, but each change of the velocity does. No map is needed for either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import left_of
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.settings.calibration import CalibrationSettings
from pathspace_graph.settings.front_end import MotionSettings

Array = NDArray[np.float64]

ERRORS: Final = [SENSOR.index("yaw"), SENSOR.index("latency")]
"""These errors of a sensor are learned, as indices of its calibration."""
MINUTE: Final = 60.0
"""This is a minute in seconds."""


def by_errors(points_vehicle: Array, twist: Array) -> Array:
    """Returns the derivatives (m, 2, 2) of detections (m, 2), vehicle frame, by the yaw and by the latency.

    The vehicle moved with the twist (3,), in m/s, m/s and rad/s. They are two columns of
    `factors.sensor:by_sensor`.
    """
    columns = np.empty((len(points_vehicle), 2, len(ERRORS)))
    columns[:, :, 0] = left_of(points_vehicle)
    columns[:, :, 1] = -twist[:2] - twist[2] * columns[:, :, 0]
    return columns


@dataclass(frozen=True, eq=False)
class Difference:
    """Says how far a match of detections is off the odometry, in the vehicle frame."""

    off: Array
    """(3,) It is off by this, in m, m and rad."""
    covariance: Array
    """(3, 3) This is the covariance of that, for a sensor without errors."""
    shifts: Array
    """(3, 2) These are the derivatives by the errors of the sensor."""


class SensorErrors:
    """Estimates the errors e = (yaw, latency) of the sensor, in rad and s, by a Kalman filter.

    Detections are corrected by the mean. What is left of the errors shifts a match by

        (d_y, -d_x, 0) (yaw),   mean v - v (latency)

    in the vehicle frame, where d is the way from the place from which the remembered detections were seen in
    the mean, v the velocity, and mean v that while they were seen.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.settings = settings
        self.mean: Array = np.zeros(len(ERRORS))
        """(2,) These are the yaw (rad, to the left) and the latency (s)."""
        self.covariance: Array = np.diag(np.square(settings.sigmas_errors))
        """(2, 2) This is their covariance."""
        self._drift: Array = np.diag(np.square(settings.sigmas_changes)) / MINUTE
        self._velocity: Array = np.zeros(3)
        self._possible: Array = 0.5 * settings.memory * np.array(settings.accelerations)

    def contradict(self, settings: CalibrationSettings) -> bool:
        """Returns whether the errors contradict the sensor's prior, as often as `settings.doubt` says."""
        if not settings.sensor:
            return False
        limit, prior = settings.doubt**2, settings.sigmas
        known = zip(self.mean.tolist(), self.covariance.diagonal().tolist(), ERRORS, strict=True)
        return any(mean**2 > limit * (variance + prior[at] ** 2) for mean, variance, at in known)

    def covariance_of(self, difference: Difference) -> Array:
        """Returns the covariance (3, 3) of a difference, with what is not known of the errors."""
        shifts = difference.shifts
        return np.asarray(difference.covariance + shifts @ self.covariance @ shifts.T)

    def follow(self, velocity: Array, dt: float) -> None:
        """Takes the velocity (3,) of a cycle, which lasted for dt (s), over into the mean velocity."""
        share = min(dt / (0.5 * self.settings.memory), 1.0)
        self._velocity = self._velocity + share * (velocity - self._velocity)

    def shifts(self, way: Array, velocity: Array) -> Array:
        """Returns the derivatives (3, 2) of how far a match is off the odometry, by the errors.

        The way (2,) and the velocity (3,) are in the vehicle frame, in m, m/s, m/s and rad/s. No vehicle
        changes its velocity by more than its accelerations: that is slip, and not to be taken for latency.
        """
        shifts = np.empty((3, len(ERRORS)))
        shifts[:, 0] = way[1], -way[0], 0.0
        shifts[:, 1] = np.clip(self._velocity - velocity, -self._possible, self._possible)
        return shifts

    def update(self, difference: Difference, dt: float) -> None:
        """Learns from a match that agrees with the odometry, dt (s) after the last cycle.

        Matches share the remembered detections. So one counts by the share of its own time.
        """
        shifts, share = difference.shifts, min(dt / self.settings.memory, 1.0)
        weighted = share * np.linalg.solve(difference.covariance, shifts).T
        information = np.linalg.inv(self.covariance + dt * self._drift) + weighted @ shifts
        self.covariance = np.asarray(np.linalg.inv(information))
        self.mean = self.mean + self.covariance @ weighted @ difference.off
