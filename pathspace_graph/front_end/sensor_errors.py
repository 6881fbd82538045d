"""What the check of the odometry learns of the sensor: how much it is turned, and how late it is.

A sensor that is turned by psi sees each motion turned by -psi. Detections that are late by tau lie too far
ahead by `tau v`. While the vehicle goes on evenly, that is the same in every cycle, and no match of
detections shows it, but each change of the velocity does. No map is needed for either.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.sensor import SENSOR, by_sensor
from pathspace_graph.settings.calibration import CalibrationSettings
from pathspace_graph.settings.front_end import MotionSettings

Array = NDArray[np.float64]

ERRORS: Final = [SENSOR.index("yaw"), SENSOR.index("latency")]
"""These errors of a sensor are learned, as indices of its calibration."""


def by_errors(points_vehicle: Array, twist: Array) -> Array:
    """Returns the derivatives (m, 2, 2) of detections (m, 2), vehicle frame, by the yaw and by the latency.

    The vehicle moved with the twist (3,), in m/s, m/s and rad/s.
    """
    twists = np.broadcast_to(twist, (len(points_vehicle), 3))
    return by_sensor(points_vehicle, twists)[:, :, ERRORS]


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
        self._information: Array = np.diag(1.0 / np.square(settings.sigmas_errors))
        self._velocity: Array = np.zeros(3)

    @property
    def covariance(self) -> Array:
        """Returns the covariance (2, 2) of the errors, which may change a little from cycle to cycle."""
        changes = np.diag(np.square(self.settings.sigmas_changes))
        return np.asarray(np.linalg.inv(self._information) + changes)

    def contradict(self, settings: CalibrationSettings) -> bool:
        """Returns whether the errors contradict the sensor's prior, as often as `settings.doubt` says."""
        if not settings.sensor:
            return False
        prior = np.square(settings.sigmas)[ERRORS]
        return bool((self.mean**2 > settings.doubt**2 * (np.diag(self.covariance) + prior)).any())

    def follow(self, velocity: Array, dt: float) -> None:
        """Takes the velocity (3,) of a cycle, which lasted for dt (s), over into the mean velocity."""
        share = min(dt / (0.5 * self.settings.memory), 1.0)
        self._velocity = self._velocity + share * (velocity - self._velocity)

    def shifts(self, way: Array, velocity: Array) -> Array:
        """Returns the derivatives (3, 2) of how far a match is off the odometry, by the errors.

        The way (2,) and the velocity (3,) are in the vehicle frame, in m, m/s, m/s and rad/s. No vehicle
        changes its velocity by more than its accelerations: that is slip, and not to be taken for latency.
        """
        settings, turned = self.settings, np.array([way[1], -way[0], 0.0])
        possible = 0.5 * settings.memory * np.array(settings.accelerations)
        slower = np.clip(self._velocity - velocity, -possible, possible)
        return np.stack([turned, slower], axis=1)

    def update(self, off: Array, covariance: Array, shifts: Array, dt: float) -> None:
        """Learns from a match that is off the odometry by (3,), with its covariance (3, 3).

        Matches share the remembered detections. So one counts by the share of its own time, dt (s).
        """
        weighted = np.linalg.solve(covariance, shifts).T * min(dt / self.settings.memory, 1.0)
        self._information = self._information + weighted @ shifts
        self.mean = self.mean + np.linalg.solve(self._information, weighted @ off)
