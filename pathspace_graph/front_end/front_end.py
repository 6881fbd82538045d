"""The front end of all estimators: it checks the readings of each cycle and assigns their noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import BoolArray
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import POINTS
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from .gate import Admitted, Gate
from .log_odometry import LogOdometry, chained
from .measurement import SeenCycle, dead_reckoned, runs
from .motion import MATCHING, MotionCheck
from .noise import NoiseLearner, measure_noise
from .sides import SideJudge

SWAPPED: Final = {  # notices of the cycle in which colours become swapped, or no longer are
    True: "the cones on the left have the colour of the right boundary: the colours are swapped, the track "
    "is driven the other way round, or y points to the right in the whole log",
    False: "the colours are on the stated sides",
}
COLOURLESS: Final = {  # notices of the cycle in which most colours become unknown, or no longer are
    True: "most detections have no colour: the driven path determines their sides",
    False: "most detections have a colour again",
}


@dataclass(frozen=True, eq=False)
class Reading:
    """Checked readings of a cycle."""

    motion: MeasuredMotion  # motion from the previous cycle to this one
    detections: Detections  # detections of boundary cones, with labels and covariances for the map
    seen_again: BoolArray  # (m,) whether the previous cycles had a detection at the same place
    orange: Detections  # detections of orange cones, which belong to no boundary
    stated: tuple[Detections, Detections]  # both kinds of detections with their stated covariances
    noise: NoiseLearner  # noise known so far
    sensor_doubted: bool = False  # whether readings contradict the prior of the sensor's yaw or latency
    measured: MapperSettings | None = None  # settings with calibration priors measured in this cycle
    notice: str = ""  # change of the meaning of the labels


class FrontEnd(Copyable):
    """Checks of each cycle's readings against the previous cycles, without a map."""

    def __init__(self, settings: MapperSettings, noise: KnownNoise) -> None:
        self.noise = NoiseLearner(noise, settings.noise, of_lines=settings.of_lines)
        self.gate = Gate(settings.limits, of_lines=settings.of_lines)
        self._motion = MotionCheck(
            self.noise.twist, settings.motion, replace(MATCHING, of_lines=settings.of_lines)
        )
        self._settings = settings
        self._begun = self._sensor_doubted = False
        self._sides = SideJudge(settings.sides)

    def admit(self, odometry: Odometry, detections: Detections) -> Admitted:
        """Return a usable cycle; raise a ReadingError for any other."""
        return self.gate.admit(odometry, detections, self._motion.t, self._motion.twist)

    def update(self, odometry: Odometry, detections: Detections) -> Reading:
        """Check the readings of a cycle: the twists since the previous one, and its detections."""
        noise, check, sides = self.noise, self._motion, self._sides
        cones, orange, in_lane = split_detections(detections, self._settings)
        checked = noise.for_check(cones, odometry.twist[-1] if len(odometry.t) else np.zeros(3))
        motion = check.update(odometry, checked, may_contradict=noise.is_settled)
        swapped, colourless = sides.swapped, sides.colourless
        labels = sides.update(check.pose, motion.twists, checked, in_lane=in_lane)
        notices = [SWAPPED[sides.swapped]] if sides.swapped != swapped else []
        notices += [COLOURLESS[sides.colourless]] if sides.colourless != colourless else []
        cones = Detections(cones.t, cones.points_vehicle, cones.covariances, labels)
        for_map, orange_for_map = noise.for_map(cones), noise.for_map(orange)
        settings, calibration = self._settings, self._settings.calibration
        # measured noise includes measured errors of the sensor, and `calibrated` checks its prior with them
        may_doubt = not (self._sensor_doubted or noise.of_detections)
        if may_doubt and check.errors.contradict(calibration):
            self._sensor_doubted = True
            settings = replace(settings, calibration=check.errors.found(calibration))
        fresh = noise.observe(odometry, cones, motion, check.pose)
        if fresh:
            check.set_noise(noise.twist)
        if fresh or not self._begun:
            settings, self._begun = noise.calibrated(self._settings), True
        return Reading(
            motion=motion,
            detections=for_map,
            seen_again=check.seen_again,
            orange=orange_for_map,
            stated=(cones, orange),
            noise=noise,
            sensor_doubted=self._sensor_doubted,
            measured=None if settings is self._settings else settings,
            notice="; ".join(notices),
        )

    @property
    def noise_used(self) -> RunNoise:
        return self.noise.used(self._settings)


@dataclass(frozen=True, eq=False)
class JudgedLog:
    """Checked readings of a whole log."""

    chain: LogOdometry  # motion from each cycle to the next
    cycles: Sequence[Detections]  # detections of boundary cones
    orange: Sequence[Detections]  # detections of orange cones
    settings: MapperSettings  # settings, with wide sensor priors where the readings contradict them
    noise: RunNoise


def judge_log(log: Log, noise: KnownNoise, settings: MapperSettings) -> JudgedLog:
    """Check a log for a batch; unknown noise is measured on the whole log first."""
    front_end = FrontEnd(settings, noise)
    if front_end.noise.is_learning:
        front_end = FrontEnd(settings, replace(noise, measured=measure_log(log, settings)))
    admitted = (front_end.admit(odometry, cycle) for odometry, cycle in split_odometry(log))
    readings = [front_end.update(cycle.odometry, cycle.detections) for cycle in admitted]
    settings = readings[0].measured or settings
    if readings[-1].sensor_doubted and settings.calibration.doubt < inf:
        settings = replace(settings, calibration=settings.calibration.widened())
    motions = [one.motion for one in readings]
    steps, biases = [one.odometry for one in motions], [one.bias for one in motions]
    chain = chained([cycle.t for cycle in log.cycles], steps, settings.odometry, biases)
    cycles, orange = [one.detections for one in readings], [one.orange for one in readings]
    return JudgedLog(chain, cycles, orange, settings, front_end.noise_used)


def split_detections(detections: Detections, settings: MapperSettings) -> tuple[Detections, Detections, bool]:
    """Split detections into those of boundaries, points of lines merged, and orange cones.

    The third value is whether the two nearest cones are orange: the vehicle drives to the track, or is at a
    gate.
    """
    of_orange = is_orange(detections)
    cones, in_lane = detections.where(~of_orange), False
    if np.count_nonzero(of_orange) >= 2:
        nearest = np.argsort(np.hypot(*detections.points_vehicle.T), kind="stable")[:2]
        in_lane = bool(of_orange[nearest].all())
    return merged(cones) if settings.of_lines else cones, detections.where(of_orange), in_lane


def merged(line: Detections) -> Detections:
    """Return the means of the points of lines that share label and cell.

    The cells have a side of 1 m, 5 mm beside an arc of 9 m. It doubles at 12 m, and at each double of that:
    noise grows with the range, so a sensor that sees three times as far needs hardly more points.
    """
    doublings = np.maximum(np.frexp(np.hypot(*line.points_vehicle.T) / 12.0)[1], 0)
    column, row = np.floor(line.points_vehicle.T / np.ldexp(1.0, doublings)).astype(np.intp)
    # one number for label and cell, as no sensor sees 2^20 cells in a row; unique rows take six times as long
    keys = (((line.labels << 6) + doublings << 20) + column << 20) + row
    order = np.argsort(keys, kind="stable")
    begins, counts = runs(keys[order])
    columns = np.column_stack([line.points_vehicle, line.covariances.reshape(-1, 4)])
    means = np.add.reduceat(columns[order], begins) / counts[:, None]
    covariances = means[:, 2:].reshape(-1, 2, 2) / counts[:, None, None]
    return Detections(line.t, means[:, :2], covariances, line.labels[order[begins]])


def is_orange(detections: Detections) -> BoolArray:
    return np.asarray(detections.labels >= min(POINTS))


def measure_log(log: Log, settings: MapperSettings | None = None) -> MeasuredNoise | None:
    """Measure the noise of a whole log and the constant errors of its sensor from its readings alone."""
    settings = settings or MapperSettings()
    return measure_noise(seen_cycles(log, settings), log.odometry, of_lines=settings.of_lines)


def seen_cycles(log: Log, settings: MapperSettings | None = None) -> list[SeenCycle]:
    """Return the detections of a log with poses by odometry alone, which is trusted."""
    settings = settings or MapperSettings()
    sides, cycles = SideJudge(settings.sides), []
    poses = dead_reckoned(log.odometry, np.array([cycle.t for cycle in log.cycles]))
    for pose, (odometry, detections) in zip(poses, split_odometry(log), strict=True):
        cones, _, in_lane = split_detections(detections, settings)
        labelled = replace(cones, labels=sides.update(pose, odometry.twist, cones, in_lane=in_lane))
        twist = odometry.twist[-1] if len(odometry.t) else np.zeros(3)
        cycles.append(SeenCycle(labelled, pose, twist))
    return cycles
