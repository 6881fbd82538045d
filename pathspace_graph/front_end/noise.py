"""Noise used in a drive: stated by the log, or measured on the drive so far."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import tee
from math import inf
from typing import Any, Final, Literal, Self

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import ASSUMED_DRIFT, KnownNoise, MeasuredNoise, TwistNoise
from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.results import NoiseSource, RunNoise
from pathspace_graph.mapping.motion import MeasuredMotion, integrated_again
from pathspace_graph.settings.mapper import MapperSettings

from .line_noise import measured_by_lines
from .measurement import SeenCycle, measured_by_cones, twist_noise, without_repeats

FIRST: Final = 8.0  # driving time before the first measurement of noise (s)
AGAIN: Final = 1.5  # growth of the driving time between measurements
MOST_CYCLES: Final = 300  # largest number of newest cycles in a measurement, which bounds its time
SCALE: Final = SENSOR.index("range_scale")  # index of the scale error of the ranges
DOUBT_SCALE: Final = (0.8, 0.5)
"""Contradiction of the scale by that of another error: alone, and beside a contradicted one.

A disagreement of ranges and speeds is likelier an error of 3 % of the ranges than one of the odometry from
3.2 sigmas of the latter on if every twentieth sensor has such an error, and from 2.0 if every other one has.
"""


class NoiseLearner(Copyable):
    """Online measurement of the noise of a drive."""

    def __init__(self, known: KnownNoise, use: str | None, *, of_lines: bool = False) -> None:
        """Start with the noise known before the drive; `use` is `MapperSettings.noise`.

        `of_lines` says whether all observed detections are points of lines, or none are.
        """
        self.known = known
        self.of_odometry = use == "measured" or (use is None and not known.odometry_stated)
        """Whether the noise of the odometry is measured."""
        self.of_detections = use == "measured" or (use is None and not known.detections_stated)
        """Whether the noise of the detections is measured."""
        self.of_sensor = use != "stated"  # whether constant errors are measured: stated noise has none
        self.measured = known.measured  # newest measurement, or the one of a batch on the whole drive
        self._cycles: tuple[SeenCycle, ...] = ()  # newest cycles
        self._twists: tuple[Odometry, ...] = ()  # newest twists
        self._of_lines = of_lines
        if of_lines:
            import_module("scipy.optimize")  # 50 ms, which no cycle has to spare
        self._steps: Iterator[MeasuredNoise | None] | None = None  # of a measurement that is under way
        self._driven, self._due = 0.0, FIRST
        self._t: float | None = None

    def copy(self) -> Self:
        """Return a copy that can change independently; both take the steps of a measurement by themselves."""
        other = super().copy()
        if self._steps is not None:
            self._steps, other._steps = tee(self._steps)
        return other

    @property
    def is_learning(self) -> bool:
        return self.of_sensor and self.known.measured is None

    @property
    def is_settled(self) -> bool:
        return not self.of_detections or (self.measured is not None and self.measured.along is not None)

    @property
    def twist(self) -> TwistNoise:
        if self.of_odometry and self.measured is not None:
            return self.measured.twist
        return self.known.twist

    def observe(
        self, odometry: Odometry, detections: Detections, motion: MeasuredMotion, pose: Array
    ) -> bool:
        """Add a cycle at a pose (3,) by dead reckoning; return whether a measurement was completed."""
        if not self.is_learning:
            return False
        self._twists = (*self._twists, odometry)
        if len(self._twists) > 200:  # cycles, which are joined now and then alone
            self._twists = (without_repeats(self._twists),)
        seen = SeenCycle(detections, pose.copy(), motion.odometry.twist)
        self._cycles = (*self._cycles[1 - MOST_CYCLES :], seen)
        if self._t is not None and np.hypot(*motion.odometry.twist[:2]) > 0.3:  # m/s
            self._driven += min(detections.t - self._t, 1.0)
        self._t = detections.t
        if self._steps is not None:
            found = next(self._steps)
            if found is not None:
                self.measured, self._steps = found, None
                return True
        elif self._driven >= self._due:
            self._due = AGAIN * self._driven
            self._steps = begun(self._cycles, self._twists, self.measured, of_lines=self._of_lines)
        return False

    def for_check(self, detections: Detections, twist: Array) -> Detections:
        """Return detections for scan matching, corrected for significant constant errors."""
        measured, points = self.measured, detections.points_vehicle
        if not self.of_sensor or measured is None or measured.along is None:
            return detections
        covariances = measured.covariances(points, inflated=False) if self.of_detections else None
        covariances = detections.covariances if covariances is None else covariances
        corrected = measured.corrected(points, twist, shown=True)
        return Detections(detections.t, corrected, covariances, detections.labels)

    def for_map(self, detections: Detections) -> Detections:
        """Return detections for the map, corrected for the bend of the ranges.

        Their covariances are inflated so that sightings of one cone count as independent.
        """
        measured, points = self.measured, detections.points_vehicle
        if not self.of_sensor or measured is None or len(points) == 0:
            return detections
        covariances = measured.covariances(points, inflated=True) if self.of_detections else None
        if covariances is None:
            covariances = measured.inflated(points, detections.covariances)
        return Detections(detections.t, measured.unbent(points), covariances, detections.labels)

    def odometry_of_lap(self, motions: Sequence[MeasuredMotion]) -> list[IntegratedOdometry]:
        """Return the odometry of a drive with the noise known now.

        The first seconds, before any measurement, determine the heading of the map.
        """
        if self.of_odometry and self.measured is not None:
            return integrated_again(motions, self.twist)
        return [motion.odometry for motion in motions]

    def calibrated(self, settings: MapperSettings) -> MapperSettings:
        """Return settings with measured priors of the sensor's errors, if the old ones cannot be relied on.

        `|c - mean| > doubt hypot(sigma, sigma_prior)` contradicts the prior of an error c. The scale of the
        ranges keeps its own as long as that is known. Otherwise only the ratio of ranges and speeds is
        observable, so one of their scales is fixed.
        """
        settings, measured, contradicted = self._contradicted(settings)
        sensor = settings.calibration
        if measured is None:
            return settings
        # The prior of the ranges' scale is knowledge of the sensor if the log states it, or covariances at
        # least. Ranges that bend, or have a contradicted scale, are not calibrated; those with a bias hardly
        # are, unless the log says so.
        is_biased = contradicted[SENSOR.index("range_bias")]
        known = self.known.sigma_range_scale is not None or not (self.of_detections or is_biased)
        known = known and not (sensor.trust is not None or contradicted[SCALE] or measured.range_bend)
        if not contradicted.any() and (known or sensor.trust is not None):
            return settings
        sigmas = np.maximum(measured.sensor_sigma, sensor.sigmas)
        odometry, means = settings.odometry, measured.sensor.copy()
        if known:
            means[SCALE], sigmas[SCALE] = sensor.range_scale, sensor.sigma_range_scale
        elif self.trusts_odometry(settings):
            odometry = replace(odometry, hold_scale=True)
            sigmas[SCALE] = 0.02  # hardly a prior
        else:
            if contradicted[SCALE]:
                scale, sigma = float(means[SCALE]), max(float(sigmas[SCALE]), odometry.sigma_scale)
                odometry = replace(odometry, scale=-scale / (1.0 + scale), doubt=inf, sigma_scale=sigma)
            means[SCALE], sigmas[SCALE] = sensor.range_scale, sensor.sigma_range_scale
        priors: dict[str, Any] = dict(zip(SENSOR, means.tolist(), strict=True))
        priors |= {f"sigma_{name}": sigma for name, sigma in zip(SENSOR, sigmas.tolist(), strict=True)}
        return replace(settings, odometry=odometry, calibration=replace(sensor, doubt=inf, **priors))

    def _contradicted(
        self, settings: MapperSettings
    ) -> tuple[MapperSettings, MeasuredNoise | None, BoolArray]:
        """Return which measured errors (5,) of the sensor contradict their priors.

        The scale of the ranges is seen beside that of the speeds only. A sensor of which another prior is
        contradicted is likelier to have a wrong scale as well, so less is needed (`DOUBT_SCALE`). The first
        results are settings with the prior of the scale that the log states, and the measurement, which is
        None if it is not used.
        """
        stated, sensor, measured = self.known.sigma_range_scale, settings.calibration, self.measured
        if stated is not None and stated != sensor.sigma_range_scale:
            sensor = replace(sensor, sigma_range_scale=stated)
            settings = replace(settings, calibration=sensor)
        if not (self.of_sensor and sensor.sensor) or measured is None or measured.along is None:
            return settings, None, np.zeros(len(SENSOR), bool)
        prior = np.array(sensor.sigmas)
        prior[SCALE] = np.hypot(prior[SCALE], settings.odometry.sigma_scale)
        sigmas = np.abs(measured.sensor - sensor.means) / np.hypot(measured.sensor_sigma, prior)
        contradicted = np.asarray(sigmas > sensor.doubt)
        others = bool(np.delete(contradicted, SCALE).any())
        contradicted[SCALE] = sigmas[SCALE] > DOUBT_SCALE[others] * sensor.doubt
        return settings, measured, contradicted

    def used(self, settings: MapperSettings) -> RunNoise:
        """Return the noise in use, and the reading that sets the map's size if ranges and speeds disagree."""
        measured, known = self.measured, self.known
        size: Literal["odometry", "ranges"] | None = None
        if self._contradicted(settings)[2][SCALE]:
            size = "odometry" if self.trusts_odometry(settings) else "ranges"
        has_rays = measured is not None and measured.along is not None
        odometry = _source(known.odometry_stated, self.of_odometry, measured is not None)
        detections = _source(known.detections_stated, self.of_detections, has_rays)
        return RunNoise(odometry, detections, measured, size)

    def trusts_odometry(self, settings: MapperSettings) -> bool:
        """Whether the odometry sets the size of the map; by default if its scale is better known.

        Systematic errors of a sensor are at least as large as its noise, so the scale of its ranges is known
        no better than a single range of 10 m.
        """
        measured, trust = self.measured, settings.calibration.trust
        if trust is not None or measured is None or measured.along is None:
            return trust == "odometry"
        sigma = float(measured.along.sigmas(np.array([10.0]))[0])
        return sigma > 10.0 * settings.odometry.sigma_scale


def _source(stated: bool, measured: bool, known: bool) -> NoiseSource:
    """Return the source of noise that is `stated` or not, to be `measured`, and measured so far (`known`)."""
    if stated and not (measured and known):
        return "stated"
    return "measured" if known else "assumed"


def begun(
    cycles: Sequence[SeenCycle], twists: Sequence[Odometry], known: MeasuredNoise | None, *, of_lines: bool
) -> Iterator[MeasuredNoise | None] | None:
    """Start a measurement on cones or on lines; None without a cycle, or without noise of the odometry."""
    of_twists = twist_noise(*twists)
    if of_twists is None or len(cycles) == 0:
        return None
    sigma, interval = of_twists[0].min(axis=0), of_twists[1]
    found = known or MeasuredNoise(sigma, np.array(ASSUMED_DRIFT), interval)
    found = replace(found, odometry=sigma, interval=interval)
    return (measured_by_lines if of_lines else measured_by_cones)(cycles, found)


def measure_noise(
    cycles: Sequence[SeenCycle], odometry: Odometry, *, of_lines: bool = False
) -> MeasuredNoise | None:
    """Measure the noise of cones or of lines; None if not even the odometry's noise can be estimated."""
    steps = begun(cycles, [odometry], None, of_lines=of_lines)
    return None if steps is None else next(found for found in steps if found is not None)
