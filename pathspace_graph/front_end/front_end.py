"""The front end of all estimators: what they are given of each cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from .gate import Admitted, Gate
from .log_odometry import LogOdometry, chained
from .motion import MotionCheck
from .sides import SideJudge

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
SWAPPED: Final = {
    True: "the cones on the left have the colour of the right boundary: the colours are swapped, the track "
    "is driven the other way round, or y points to the right in the whole log",
    False: "the colours are as they were said to be",
}
"""These notices say that the colours are swapped from now on, or no longer."""
COLOURLESS: Final = {
    True: "most detections have no colour: the way driven tells their sides",
    False: "most detections have a colour again",
}
"""These notices say that most colours are unknown from now on, or no longer."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Holds the readings of a cycle after they were judged."""

    motion: MeasuredMotion
    """This motion leads to the cycle."""
    detections: Detections
    """These are the detections of the cycle."""
    seen_again: BoolArray
    """(m,) The flag is set when a detection lies where the cycles just before had one."""
    sensor_doubted: bool = False
    """The flag is set once the readings so far contradict the prior of the sensor's yaw or latency."""
    notice: str = ""
    """This says what the labels mean from now on, where that has changed."""


class FrontEnd:
    """Judges the readings of each cycle by those of the cycles before, without any map."""

    def __init__(self, settings: MapperSettings, odometry_sigma: Array) -> None:
        """Keeps the settings, and the standard deviations (3,) of a twist (m/s, m/s, rad/s)."""
        self.gate = Gate(settings.limits)
        """It refuses cycles that no estimator can use."""
        self._motion = MotionCheck(odometry_sigma, settings.motion)
        self._calibration = settings.calibration
        self._sensor_doubted = False
        self._sides = SideJudge(settings.sides, settings.path)

    def admit(self, odometry: Odometry, detections: Detections, window: Sequence[float] = ()) -> Admitted:
        """Returns a cycle that may be used, or raises a ReadingError; nothing but a count changes.

        A late cycle is admitted between the stamps (s) of the `window`.
        """
        return self.gate.admit(odometry, detections, self._motion.newest, window)

    def use_late(self, detections: Detections, window: Sequence[float]) -> Detections:
        """Returns the detections of a late cycle with the labels of their sides; unknown ones stay so.

        Its stamp is not admitted again as long as it lies in the window, whose poses have these stamps (s).
        """
        self.gate.use_late(detections.t, window)
        return self._sides.relabelled(detections, np.full(len(detections.labels), UNKNOWN))

    def update(self, odometry: Odometry, detections: Detections) -> Reading:
        """Returns the judged readings of a cycle: the twists since the last one, and its detections."""
        motion = self._motion.update(odometry, detections)
        sides = self._sides
        swapped, colourless = sides.swapped, sides.colourless
        judged = sides.update(self._motion.pose, motion.twists, detections)
        notices = [SWAPPED[sides.swapped]] if sides.swapped != swapped else []
        notices += [COLOURLESS[sides.colourless]] if sides.colourless != colourless else []
        self._sensor_doubted = self._sensor_doubted or self._motion.errors.contradict(self._calibration)
        return Reading(
            motion, judged, self._motion.seen_again, self._sensor_doubted, notice="; ".join(notices)
        )


@dataclass(frozen=True, eq=False)
class JudgedLog:
    """Holds the readings of a whole log after they were judged cycle by cycle."""

    chain: LogOdometry
    """This is the motion from each cycle to the next."""
    cycles: Sequence[Detections]
    """These are the detections of each cycle."""
    settings: MapperSettings
    """Here the priors of the sensor are wide, if the readings contradict them."""


def judge_log(log: Log, odometry_sigma: Array, settings: MapperSettings) -> JudgedLog:
    """Returns a log as the front end gives it to an estimator of whole logs.

    odometry_sigma (3,) is the standard deviation of one measured twist (m/s, m/s, rad/s). A cycle that an
    online estimator would refuse is a ReadingError.
    """
    front_end = FrontEnd(settings, odometry_sigma)
    admitted = (front_end.admit(odometry, cycle) for odometry, cycle in split_odometry(log))
    readings = [front_end.update(cycle.odometry, cycle.detections) for cycle in admitted]
    motions = [reading.motion for reading in readings]
    chain = chained([cycle.t for cycle in log.cycles], motions, settings.odometry)
    if readings[-1].sensor_doubted:
        settings = replace(settings, calibration=settings.calibration.widened())
    return JudgedLog(chain, [reading.detections for reading in readings], settings)
