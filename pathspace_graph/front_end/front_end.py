"""The front end of all estimators: what they are given of each cycle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.factors.odometry import odometry_residuals
from pathspace_graph.factors.se2 import left_of, move_points, rotation, se2_exp
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.window import MapRows
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import POINTS, UNKNOWN
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import MotionSettings

from .gate import Admitted, Gate
from .log_odometry import LogOdometry, chained
from .measurement import measure
from .motion import MotionCheck
from .noise import NoiseLearner
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
NEAREST: Final = 2  # number of nearest cones that are orange where the vehicle drives between orange cones


@dataclass(frozen=True, eq=False)
class Reading:
    """Readings of a cycle after they were judged."""

    motion: MeasuredMotion  # motion that leads to the cycle
    detections: Detections  # detections of cones that bound the road
    seen_again: BoolArray  # (m,) whether each of them lies where the cycles just before had one
    orange: Detections  # detections of orange cones, which bound no road
    stated: tuple[Detections, Detections]  # those of both kinds as they came, before any noise was measured
    sensor_doubted: bool = False  # whether readings contradict the prior of the sensor's yaw or latency
    measured: MapperSettings | None = None  # with priors of calibrations that were measured in this cycle
    notice: str = ""  # what the labels mean from now on, where that has changed


class FrontEnd:
    """Judge of each cycle's readings by those of the cycles before, without any map."""

    def __init__(self, settings: MapperSettings, noise: KnownNoise) -> None:
        self.noise = NoiseLearner(noise, settings.noise)
        self.gate = Gate(settings.limits)
        self._motion = MotionCheck(self.noise.twist_sigma, settings.motion)
        self._settings = settings
        self._begun = self._sensor_doubted = False
        self._sides = SideJudge(settings.sides)

    def admit(self, odometry: Odometry, detections: Detections, window: Sequence[float] = ()) -> Admitted:
        """Return a usable cycle, maybe a late one between the `window`'s stamps, or a ReadingError."""
        return self.gate.admit(odometry, detections, self._motion.newest, window)

    def use_late(self, detections: Detections, window: Sequence[float]) -> Detections:
        """Return the detections of a late cycle with the labels of their sides; it counts as used."""
        self.gate.use_late(detections.t, window)
        detections = detections.where(~is_orange(detections))
        return self._sides.relabelled(detections, np.full(len(detections.labels), UNKNOWN))

    def update(self, odometry: Odometry, detections: Detections) -> Reading:
        """Return the judged readings of a cycle: the twists since the last one, and its detections."""
        noise, check, sides = self.noise, self._motion, self._sides
        of_orange = is_orange(detections)
        cones, orange = detections.where(~of_orange), detections.where(of_orange)
        checked = noise.for_check(cones, odometry.twist[-1] if len(odometry.t) else np.zeros(3))
        motion = check.update(odometry, checked, may_doubt=noise.is_settled)
        swapped, colourless = sides.swapped, sides.colourless
        in_lane = is_in_orange_lane(detections, of_orange)
        labels = sides.update(check.pose, motion.twists, checked, in_lane=in_lane).labels
        notices = [SWAPPED[sides.swapped]] if sides.swapped != swapped else []
        notices += [COLOURLESS[sides.colourless]] if sides.colourless != colourless else []
        cones = replace(cones, labels=labels)
        stated = cones, orange
        judged, orange = noise.for_map(cones), noise.for_map(orange)
        # measured noise comes with measured errors of the sensor, by which `calibrated` judges its prior
        settings, calibration = self._settings, self._settings.calibration
        may_doubt = not (self._sensor_doubted or noise.of_detections)
        if may_doubt and check.errors.contradict(calibration):
            self._sensor_doubted = True
            settings = replace(settings, calibration=check.errors.found(calibration))
        fresh = noise.observe(odometry, cones, motion, check.pose)
        if fresh:
            check.set_noise(noise.twist_sigma)
        if fresh or not self._begun:
            settings, self._begun = noise.calibrated(self._settings), True
        measured = None if settings is self._settings else settings
        seen, notice = check.seen_again, "; ".join(notices)
        return Reading(motion, judged, seen, orange, stated, self._sensor_doubted, measured, notice)

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
    """Return a log as the front end gives it to a batch; unknown noise is measured on all of it first."""
    front_end = FrontEnd(settings, noise)
    if front_end.noise.is_learning:
        front_end = FrontEnd(settings, replace(noise, measured=measure_log(log)))
    admitted = (front_end.admit(odometry, cycle) for odometry, cycle in split_odometry(log))
    readings = [front_end.update(cycle.odometry, cycle.detections) for cycle in admitted]
    settings = readings[0].measured or settings
    if readings[-1].sensor_doubted and settings.calibration.doubt < inf:
        settings = replace(settings, calibration=settings.calibration.widened())
    chain = chained([cycle.t for cycle in log.cycles], [one.motion for one in readings], settings.odometry)
    cycles, orange = [one.detections for one in readings], [one.orange for one in readings]
    return JudgedLog(chain, cycles, orange, settings, front_end.noise_used)


def is_in_orange_lane(detections: Detections, of_orange: BoolArray) -> bool:
    """Return whether the nearest cones are orange: the vehicle comes to a track, or is at a gate."""
    if of_orange.sum() < NEAREST:
        return False
    nearest = np.argsort(np.hypot(*detections.points_vehicle.T), kind="stable")[:NEAREST]
    return bool(of_orange[nearest].all())


def is_orange(detections: Detections) -> BoolArray:
    return np.asarray(detections.labels >= min(POINTS))


def measure_log(log: Log) -> MeasuredNoise | None:
    """Return the noise of a whole log and the constant errors of its sensor, by its readings alone."""
    return measure(*seen_cycles(log), None)


def seen_cycles(log: Log) -> tuple[list[SeenCycle], TwistRecord]:
    """Return the cycles of a log where odometry alone, which is not doubted, places them, and the twists."""
    readings, twists, cycles = list(split_odometry(log)), TwistRecord(), []
    for odometry, _ in readings:
        twists.add(odometry)
    white, settings = measure([], twists, None), MapperSettings()
    sigma = log.odometry_sigma if white is None else white.twist_sigma
    check, sides = MotionCheck(sigma, settings.motion), SideJudge(settings.sides)
    for odometry, detections in readings:
        of_orange = is_orange(detections)
        cones, in_lane = detections.where(~of_orange), is_in_orange_lane(detections, of_orange)
        motion = check.update(odometry, cones, may_doubt=None)
        labelled = sides.update(check.pose, motion.twists, cones, in_lane=in_lane)
        cycles.append(SeenCycle(labelled, check.pose, motion.odometry.twist))
    return cycles, twists


def at_nearest_pose(
    smoother: FixedLagSmoother[MapRows], detections: Detections, settings: MotionSettings
) -> tuple[Detections, int, Array]:
    """Return late detections as they would be seen from the pose of the window that is nearest in time.

    Also return the cycle of that pose, and the mean twist (3,) of the vehicle then (m/s, m/s, rad/s), which
    is constant between the poses around the stamp. With T the motion from the nearest pose to the late one, a
    detection z with covariance K becomes `T z` with `R (K + G Q G') R'`, where `G = [I | J z]` and J is the
    quarter turn. Q is the covariance of the odometry for the share of the interval, and of a changing twist:
    half the acceleration times the times to both poses. Errors count as independent, though one motion has
    moved them all.
    """
    times, poses, t = smoother.times, smoother.variables.poses, detections.t
    after = int(np.searchsorted(times, t))
    before, duration = after - 1, times[after] - times[after - 1]
    (motion,), _, _ = odometry_residuals(poses[before, None], poses[after, None], np.zeros((1, 3)))
    share = (t - times[before]) / duration
    nearest, share = (before, share) if share < 0.5 else (after, share - 1.0)
    moved, whitener = se2_exp(share * motion[None])[0], smoother.window.odometry.whiteners[before]
    bend = 0.5 * (t - times[before]) * (times[after] - t) * np.array(settings.accelerations)
    spread = abs(share) * np.linalg.inv(whitener.T @ whitener) + np.diag(bend**2)
    z, turn = detections.points_vehicle, rotation(moved[2])
    by_motion = np.zeros((len(z), 2, 3))
    by_motion[:, :, :2], by_motion[:, :, 2] = np.eye(2), left_of(z)
    covariances = turn @ (detections.covariances + by_motion @ spread @ by_motion.transpose(0, 2, 1)) @ turn.T
    seen = replace(detections, points_vehicle=move_points(moved, z), covariances=covariances)
    return seen, smoother.first_cycle + nearest, motion / duration
