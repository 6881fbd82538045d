"""The motion between two perception cycles, as the estimators are given it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BiasMeasurement:
    """Holds a measured bias of the yaw rate: what a vehicle at rest measures."""

    value: float
    """This is the mean yaw rate (rad/s)."""
    sigma: float
    """This is its standard deviation (rad/s)."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Holds the motion that leads to a cycle, and what was found out about the odometry."""

    odometry: IntegratedOdometry
    """This is the relative pose, with its covariance."""
    twists: Array
    """(k, 3) The vehicle moved with these twists since the last cycle, in m/s, m/s and rad/s."""
    doubted: bool = False
    """The flag is set where the detections contradict the odometry, and their own motion replaces it."""
    missing: bool = False
    """The flag is set where no twist was measured for long."""
    stuck: bool = False
    """The flag is set where the twist stays the same to the last digit."""
    bias: BiasMeasurement | None = None
    """This is what the vehicle has measured at rest, where it has just done so."""

    @property
    def rests(self) -> bool:
        """Return whether no twist says that the vehicle moves."""
        return not self.twists.any()

    @property
    def fault(self) -> str:
        """Returns what is wrong with the odometry in plain words; it is empty where nothing is."""
        if self.missing:
            return "there is no odometry"
        return "the detections contradict the odometry" if self.doubted else ""
