"""The front end of all estimators: what they are given of each cycle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import POINTS
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from .gate import Admitted, Gate
from .kind import KindJudge
from .line_matching import merged, of_line
from .log_odometry import LogOdometry, chained
from .measurement import odometry_of
from .motion import MotionCheck
from .noise import NoiseLearner, measure
from .sides import SideJudge
from .sightings import SeenCycle, TwistRecord

SWAPPED: Final = {  # notices that the colours are swapped from now on, or no longer
    True: "the cones on the left have the colour of the right boundary: the colours are swapped, the track "
    "is driven the other way round, or y points to the right in the whole log",
    False: "the colours are as they were said to be",
}
COLOURLESS: Final = {  # notices that most colours are unknown from now on, or no longer
    True: "most detections have no colour: the way driven tells their sides",
    False: "most detections have a colour again",
}
OF_LINES: Final = (
    "the detections are points of a line, mapped as cones: begin again with `kind` of the settings as {!r}"
)
NEAREST: Final = 2  # number of nearest cones that are orange where the vehicle drives between orange cones


@dataclass(frozen=True, eq=False)
class Reading:
    """Readings of a cycle after they were judged."""

    motion: MeasuredMotion  # motion that leads to the cycle
    detections: Detections  # detections of cones that bound the road
    seen_again: BoolArray  # (m,) whether each of them lies where the cycles just before had one
    orange: Detections  # detections of orange cones, which bound no road
    stated: tuple[Detections, Detections]  # those of both kinds as they came, before any noise was measured
    noise: NoiseLearner  # noise as it is known now
    sensor_doubted: bool = False  # whether readings contradict the prior of the sensor's yaw or latency
    measured: MapperSettings | None = None  # with priors of calibrations that were measured in this cycle
    notice: str = ""  # what the labels mean from now on, where that has changed


class FrontEnd:
    """Judge of each cycle's readings by those of the cycles before, without any map."""

    def __init__(self, settings: MapperSettings, noise: KnownNoise, scale: float = 1.0) -> None:
        """Begin with the noise known at scale 1; cycles come in metres of a scene of the scale."""
        self.noise = NoiseLearner(noise, settings.noise, of_lines=settings.kind == "line")
        self.gate = Gate(settings.limits, scale, of_lines=settings.kind == "line")
        self._motion = MotionCheck(self.noise.twist_sigma, settings.motion)
        self._settings = settings
        self._begun = self._sensor_doubted = False
        self._sides = SideJudge(settings.sides)
        self._kind = None if settings.kind else KindJudge()  # until the kind is known

    def copy(self) -> Self:
        """Return a copy that goes on independently, and shares what nothing changes."""
        other = shallow(self)
        other.noise, other.gate = self.noise.copy(), self.gate.copy()
        other._motion, other._sides = self._motion.copy(), self._sides.copy()
        other._kind = self._kind and self._kind.copy()
        return other

    def admit(self, odometry: Odometry, detections: Detections) -> Admitted:
        """Return a usable cycle, or raise a ReadingError."""
        return self.gate.admit(odometry, detections, self._motion.newest)

    def update(self, odometry: Odometry, detections: Detections) -> Reading:
        """Return the judged readings of a cycle: the twists since the last one, and its detections."""
        noise, check, sides = self.noise, self._motion, self._sides
        of_orange = is_orange(detections)
        cones, orange = detections.where(~of_orange), detections.where(of_orange)
        cones = merged(cones, of_line(cones.labels, self._settings))
        checked = noise.for_check(cones, odometry.twist[-1] if len(odometry.t) else np.zeros(3))
        is_line = of_line(cones.labels, self._settings)
        motion = check.update(odometry, checked, noise.is_settled, is_line)
        swapped, colourless = sides.swapped, sides.colourless
        in_lane = is_in_orange_lane(detections, of_orange)
        labels = sides.update(check.pose, motion.twists, checked, in_lane=in_lane).labels
        notices = [SWAPPED[sides.swapped]] if sides.swapped != swapped else []
        notices += [COLOURLESS[sides.colourless]] if sides.colourless != colourless else []
        cones = replace(cones, labels=labels)
        notices += self._found_kind(odometry, cones)
        stated = cones, orange
        judged, orange = noise.for_map(cones), noise.for_map(orange)
        # measured noise comes with measured errors of the sensor, by which `calibrated` judges its prior
        settings, calibration = self._settings, self._settings.calibration
        may_doubt = not (self._sensor_doubted or noise.of_detections)
        if may_doubt and check.errors.contradict(calibration):
            self._sensor_doubted = True
            settings = replace(settings, calibration=check.errors.found(calibration))
        fresh = noise.observe(odometry, measurable(cones, settings), motion, check.pose)
        if fresh:
            check.set_noise(noise.twist_sigma)
        if fresh or not self._begun:
            settings, self._begun = noise.calibrated(self._settings), True
        measured = None if settings is self._settings else settings
        seen, notice = check.seen_again, "; ".join(notices)
        return Reading(motion, judged, seen, orange, stated, noise, self._sensor_doubted, measured, notice)

    def _found_kind(self, odometry: Odometry, cones: Detections) -> list[str]:
        """Return a notice where detections that are taken for cones turn out to be of a line."""
        if self._kind is None:
            return []
        self._kind.see(odometry, cones)
        if not self._kind.is_final:
            return []
        kind, self._kind = self._kind.kind, None
        return [] if kind in (None, "cones") else [OF_LINES.format(kind)]

    @property
    def noise_used(self) -> RunNoise:
        return self.noise.used(self._settings)

    @property
    def pose(self) -> Array:
        """Copy of the newest pose (3,) by odometry alone."""
        return self._motion.pose.copy()


@dataclass(frozen=True, eq=False)
class JudgedLog:
    """Readings of a whole log after they were judged cycle by cycle."""

    chain: LogOdometry  # motion from each cycle to the next
    cycles: Sequence[Detections]
    orange: Sequence[Detections]  # those of orange cones
    settings: MapperSettings  # settings, with wide priors of the sensor where the readings contradict them
    noise: RunNoise


def judge_log(log: Log, noise: KnownNoise, settings: MapperSettings) -> JudgedLog:
    """Return a log of scale 1 as the front end gives it to a batch; unknown noise is measured on it first."""
    front_end = FrontEnd(settings, noise)
    if front_end.noise.is_learning:
        front_end = FrontEnd(settings, replace(noise, measured=measure_log(log, settings)))
    admitted = (front_end.admit(odometry, cycle) for odometry, cycle in split_odometry(log))
    readings = [front_end.update(cycle.odometry, cycle.detections) for cycle in admitted]
    settings = readings[0].measured or settings
    if readings[-1].sensor_doubted and settings.calibration.doubt < inf:
        settings = replace(settings, calibration=settings.calibration.widened())
    chain = chained([cycle.t for cycle in log.cycles], [one.motion for one in readings], settings.odometry)
    cycles, orange = [one.detections for one in readings], [one.orange for one in readings]
    return JudgedLog(chain, cycles, orange, settings, front_end.noise_used)


def measurable(detections: Detections, settings: MapperSettings) -> Detections:
    """Return the detections that noise is measured on: the cones, or points of lines where all are."""
    if settings.kind == "line":
        return detections
    return detections.where(~of_line(detections.labels, settings))


def is_in_orange_lane(detections: Detections, of_orange: BoolArray) -> bool:
    """Return whether the nearest cones are orange: the vehicle comes to a track, or is at a gate."""
    if of_orange.sum() < NEAREST:
        return False
    nearest = np.argsort(np.hypot(*detections.points_vehicle.T), kind="stable")[:NEAREST]
    return bool(of_orange[nearest].all())


def is_orange(detections: Detections) -> BoolArray:
    return np.asarray(detections.labels >= min(POINTS))


def measure_log(log: Log, settings: MapperSettings | None = None) -> MeasuredNoise | None:
    """Return the noise of a whole log and the constant errors of its sensor, by its readings alone.

    The settings say which detections are points of lines.
    """
    settings = settings or MapperSettings()
    return measure(*seen_cycles(log, settings), of_lines=settings.kind == "line")


def seen_cycles(log: Log, settings: MapperSettings | None = None) -> tuple[list[SeenCycle], TwistRecord]:
    """Return the cones of a log where odometry alone, which is not doubted, places them, and the twists."""
    settings = settings or MapperSettings()
    readings, twists, cycles = list(split_odometry(log)), TwistRecord(), []
    for odometry, _ in readings:
        twists.add(odometry)
    white = odometry_of(twists, None)
    sigma = log.odometry_sigma if white is None else white.twist_sigma
    check, sides = MotionCheck(sigma, settings.motion), SideJudge(settings.sides)
    for odometry, detections in readings:
        of_orange = is_orange(detections)
        cones, in_lane = detections.where(~of_orange), is_in_orange_lane(detections, of_orange)
        cones = merged(cones, of_line(cones.labels, settings))
        is_line = of_line(cones.labels, settings)
        motion = check.update(odometry, cones, may_doubt=None, is_line=is_line)
        labelled = sides.update(check.pose, motion.twists, cones, in_lane=in_lane)
        cycles.append(SeenCycle(measurable(labelled, settings), check.pose, motion.odometry.twist))
    return cycles, twists
