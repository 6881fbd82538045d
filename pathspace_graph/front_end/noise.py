"""Noise that is used in a drive: what the log states, or what the drive itself has shown so far."""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from math import inf
from typing import Any, Final, Literal, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.factors.sensor import SENSOR, SENSOR_SIZE
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.results import NoiseSource, RunNoise
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.settings.mapper import MapperSettings

from .line_noise import LineMeasurement
from .measurement import Measurement
from .sightings import SeenCycle, TwistRecord

FIRST: Final = 8.0  # driving time (s) after which noise is measured first
AGAIN: Final = 1.5  # growth of the driving time after which it is measured again
MOST_CYCLES: Final = 300  # newest cycles on which it is measured, which bounds its time
DRIVING_SPEED: Final = 0.3  # speed from which on the vehicle drives (m/s)
SCALE: Final = SENSOR.index("range_scale")
SIGMA_FREE: Final = 0.02  # of the scale of the ranges, beside that measured, where odometry sets the size (-)
REFERENCE_RANGE: Final = 10.0  # range at which the scatter of ranges tells how well their scale is known (m)


class NoiseLearner:
    """Measurement of the noise of a drive as it goes on, which never reads ahead."""

    def __init__(self, known: KnownNoise, use: str | None, *, of_lines: bool = False) -> None:
        """Keep what is known before the drive; `use` is `MapperSettings.noise`.

        All detections that it observes are points of lines, or none are.
        """
        self.known = known
        self.of_odometry = use == "measured" or (use is None and not known.odometry_stated)
        self.of_detections = use == "measured" or (use is None and not known.detections_stated)
        """Whether the noise of odometry and detections is the measured one."""
        self.of_sensor = use != "stated"  # its constant errors: stated noise says nothing of them
        self.measured = known.measured  # what was measured so far, or by an earlier look at the whole drive
        self._cycles: tuple[SeenCycle, ...] = ()  # the newest ones
        self._twists = TwistRecord()
        self._of_lines = of_lines
        if of_lines:
            import_module("scipy.optimize")  # 50 ms, which no cycle has to spare
        self._measurement: Measurement | LineMeasurement | None = None
        self._driven, self._due = 0.0, FIRST
        self._t: float | None = None

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other._twists = self._twists.copy()
        other._measurement = self._measurement and self._measurement.copy()
        return other

    @property
    def is_learning(self) -> bool:
        return self.of_sensor and self.known.measured is None

    @property
    def is_settled(self) -> bool:
        return not self.of_detections or (self.measured is not None and self.measured.along is not None)

    @property
    def twist_sigma(self) -> Array:
        if self.of_odometry and self.measured is not None:
            return self.measured.twist_sigma
        return self.known.odometry

    def observe(
        self, odometry: Odometry, detections: Detections, motion: MeasuredMotion, pose: Array
    ) -> bool:
        """Learn from a cycle at a pose (3,) of the front end; return whether the noise was measured anew."""
        if not self.is_learning:
            return False
        self._twists.add(odometry)
        seen = SeenCycle(detections, pose.copy(), motion.odometry.twist)
        self._cycles = (*self._cycles[1 - MOST_CYCLES :], seen)
        if self._t is not None and np.hypot(*motion.odometry.twist[:2]) > DRIVING_SPEED:
            self._driven += min(detections.t - self._t, 1.0)
        self._t = detections.t
        if self._measurement is None and self._driven >= self._due:
            self._due = AGAIN * self._driven
            self._measurement = begun(self._cycles, self._twists, self.measured, of_lines=self._of_lines)
        found = None if self._measurement is None else self._measurement.advance()
        if found is None:
            return False
        self.measured, self._measurement = found, None
        return True

    def for_check(self, detections: Detections, twist: Array) -> Detections:
        """Return detections for comparisons over a few cycles: without sure constant errors."""
        measured, points = self.measured, detections.points_vehicle
        if not self.of_sensor or measured is None or measured.along is None:
            return detections
        covariances = measured.covariances(points, inflated=False) if self.of_detections else None
        covariances = detections.covariances if covariances is None else covariances
        corrected = measured.corrected(points, twist, shown=True)
        return Detections(detections.t, corrected, covariances, detections.labels)

    def for_map(self, detections: Detections) -> Detections:
        """Return unbent detections whose covariances say what each adds to the others of its cone."""
        measured, points = self.measured, detections.points_vehicle
        if not self.of_sensor or measured is None:
            return detections
        covariances = measured.covariances(points, inflated=True) if self.of_detections else None
        if covariances is None:
            covariances = measured.inflated(points, detections.covariances)
        return Detections(detections.t, measured.unbent(points), covariances, detections.labels)

    def motions_of_lap(self, motions: Sequence[MeasuredMotion]) -> Sequence[MeasuredMotion]:
        """Return the motions of a drive with the noise that is known now.

        Its first seconds were driven before any was measured, and decide the heading of the map.
        """
        if self.of_odometry and self.measured is not None:
            return [motion.with_sigma(self.twist_sigma) for motion in motions]
        return motions

    def calibrated(self, settings: MapperSettings) -> MapperSettings:
        """Return settings with measured priors of the calibrations where one of the old ones is contradicted.

        `|b - m| > doubt hypot(sigma, sigma_prior)` contradicts the prior of an error b, and then all errors
        are what was measured. Of ranges and speeds only the ratio can be seen: the scale of one is held.
        """
        measured, sensor = self.measured, settings.calibration
        contradicted = self._contradicted(settings)
        if measured is None or not contradicted.any():
            return settings
        sigmas = np.maximum(measured.sensor_sigma, sensor.sigmas)
        odometry, means = settings.odometry, measured.sensor.copy()
        if self.trusts_odometry(settings):
            odometry = replace(odometry, hold_scale=True)
            sigmas[SCALE] = SIGMA_FREE
        else:
            if contradicted[SCALE]:
                scale, sigma = float(means[SCALE]), max(float(sigmas[SCALE]), odometry.sigma_scale)
                odometry = replace(odometry, scale=-scale / (1.0 + scale), doubt=inf, sigma_scale=sigma)
            means[SCALE], sigmas[SCALE] = sensor.range_scale, sensor.sigma_range_scale
        priors: dict[str, Any] = dict(zip(SENSOR, means.tolist(), strict=True))
        priors |= {f"sigma_{name}": sigma for name, sigma in zip(SENSOR, sigmas.tolist(), strict=True)}
        return replace(settings, odometry=odometry, calibration=replace(sensor, doubt=inf, **priors))

    def _contradicted(self, settings: MapperSettings) -> BoolArray:
        """Return which errors (5,) of the sensor are measured, and contradict their priors."""
        measured, sensor = self.measured, settings.calibration
        if not self.of_sensor or measured is None or measured.along is None or not sensor.sensor:
            return np.zeros(SENSOR_SIZE, bool)
        off = np.abs(measured.sensor - sensor.means)
        prior = np.array(sensor.sigmas)
        prior[SCALE] = np.hypot(prior[SCALE], settings.odometry.sigma_scale)
        return np.asarray(off > sensor.doubt * np.hypot(measured.sensor_sigma, prior))

    def used(self, settings: MapperSettings) -> RunNoise:
        """Return the noise used, and what sets the size of the map where ranges and speeds disagree."""
        measured, known = self.measured, self.known
        size: Literal["odometry", "ranges"] | None = None
        if self._contradicted(settings)[SCALE]:
            size = "odometry" if self.trusts_odometry(settings) else "ranges"
        has_rays = measured is not None and measured.along is not None
        odometry = _source(known.odometry_stated, self.of_odometry, measured is not None)
        detections = _source(known.detections_stated, self.of_detections, has_rays)
        return RunNoise(odometry, detections, measured, size)

    def trusts_odometry(self, settings: MapperSettings) -> bool:
        """Return whether the odometry sets the size of the map, by default where its scale is better known.

        A sensor's systematic errors are as large as its scatter, or larger: so the scale of ranges is known
        as well as a range is.
        """
        measured, trust = self.measured, settings.calibration.trust
        if trust is not None or measured is None or measured.along is None:
            return trust == "odometry"
        sigma = float(measured.along.sigmas(np.array([REFERENCE_RANGE]))[0])
        return sigma > REFERENCE_RANGE * settings.odometry.sigma_scale


def _source(stated: bool, measured: bool, known: bool) -> NoiseSource:
    """Return where noise comes from that is stated or not, is to be measured or not, and is known or not."""
    if stated and not (measured and known):
        return "stated"
    return "measured" if known else "assumed"


def begun(
    cycles: Sequence[SeenCycle], twists: TwistRecord, known: MeasuredNoise | None, *, of_lines: bool
) -> Measurement | LineMeasurement | None:
    """Begin to measure the noise of cones or of lines; None where not even the odometry's can be told."""
    return (LineMeasurement if of_lines else Measurement).of(cycles, twists, known)


def measure(
    cycles: Sequence[SeenCycle], twists: TwistRecord, *, of_lines: bool = False
) -> MeasuredNoise | None:
    """Return the noise that the readings show, of cones or of lines; None where none can be told."""
    measurement = begun(cycles, twists, None, of_lines=of_lines)
    if measurement is None:
        return None
    while (found := measurement.advance()) is None:
        pass
    return found
