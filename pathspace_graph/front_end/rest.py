"""A vehicle at rest: nothing moves, and the yaw rate that is measured is its bias."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Odometry
from pathspace_graph.mapping.motion import BiasMeasurement
from pathspace_graph.settings.front_end import MotionSettings

Array = NDArray[np.float64]


class Rest:
    """Tells from the odometry whether the vehicle stands, and averages the yaw rate meanwhile."""

    def __init__(self, sigma: Array, settings: MotionSettings) -> None:
        """Keeps the settings, and the standard deviations (3,) of a twist (m/s, m/s, rad/s)."""
        self.settings = settings
        self.sigma = sigma
        self._since: float | None = None
        self._sum: Array = np.zeros(3)
        self._count = 0
        self._measured_since = 0.0
        self._rate_sum, self._rate_count = 0.0, 0

    def believe(self, sigma: Array) -> None:
        """Takes other standard deviations (3,) of a twist (m/s, m/s, rad/s) from now on."""
        self.sigma = sigma

    def update(self, odometry: Odometry, t: float) -> bool:
        """Returns whether the vehicle has stood for long enough at t (s), by the twists since the last cycle.

        Its mean twist must be zero within its own noise, and within the limits of a vehicle that stands.
        """
        twists = odometry.twist[1:] if len(odometry.twist) > 1 else odometry.twist  # the first one is held
        if (
            len(twists) == 0
            or twists[:, 0].min() > self.settings.rest_speed + self.settings.rest_sigmas * self.sigma[0]
            or not self._is_still(twists.mean(axis=0), len(twists))
        ):
            self.end()
            return False
        if self._since is None:
            self._since = self._measured_since = float(odometry.t[0])
        self._sum, self._count = self._sum + twists.sum(axis=0), self._count + len(twists)
        self._rate_sum += float(twists[:, 2].sum())
        self._rate_count += len(twists)
        stands = self._is_still(self._sum / self._count, self._count)
        return stands and t - self._since >= self.settings.rest

    def end(self) -> None:
        """Notes that the vehicle moves."""
        self._since, self._sum, self._count = None, np.zeros(3), 0
        self._rate_sum, self._rate_count = 0.0, 0

    def bias(self, t: float) -> BiasMeasurement | None:
        """Returns the bias that was measured since the last call, if that is long enough ago at t (s)."""
        if t - self._measured_since < self.settings.rest:
            return None
        measured = BiasMeasurement(
            self._rate_sum / self._rate_count, float(self.sigma[2]) / np.sqrt(self._rate_count)
        )
        self._measured_since, self._rate_sum, self._rate_count = t, 0.0, 0
        return measured

    def _is_still(self, mean: Array, count: int) -> bool:
        """Returns whether a mean twist (3,) of this number of readings is that of a vehicle at rest."""
        settings = self.settings
        limit = np.array([settings.rest_speed, settings.rest_speed, settings.rest_rate])
        return bool((np.abs(mean) < limit + settings.rest_sigmas * self.sigma / np.sqrt(count)).all())
