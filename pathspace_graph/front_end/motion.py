"""The motion between two cycles: odometry, checked against what the detections say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import (
    CALIBRATION_SIZE,
    IntegratedOdometry,
    integrated_odometry,
)
from pathspace_graph.factors.se2 import compose, relative, rotation, to_map
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.motion import MeasuredMotion, integrate_odometry
from pathspace_graph.settings.front_end import MotionSettings

from .gate import Newest
from .rest import Rest
from .scan_matching import Match, RecentDetections, match, misfit_at
from .sensor_errors import Difference, SensorErrors, by_errors

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NO_CALIBRATION: Final = np.zeros((3, CALIBRATION_SIZE))
"""A motion that no odometry has measured does not depend on the calibration of the odometry."""


class MotionCheck:
    """Integrates the odometry of each cycle, and checks it against the detections of the newest cycles.

    The frame of this check is that of the motion so far. It drifts, and only its newest part is used.
    """

    def __init__(self, sigma: Array, settings: MotionSettings) -> None:
        """Keeps the settings, and the standard deviations (3,) of a twist (m/s, m/s, rad/s)."""
        self.settings = settings
        self.sigma = sigma
        self.seen_again: BoolArray = np.zeros(0, bool)
        """(m,) The flag is set when a detection of the newest cycle lies where the cycles before had one."""
        self._recent = RecentDetections(settings)
        self.pose: Array = np.zeros(3)
        """(3,) This is the newest pose in the frame of the front end, in which the drive began at 0."""
        self._velocity: Array | None = None
        self.errors = SensorErrors(settings)
        """This learns how much the sensor is turned, and how late its detections are."""
        self._t: float | None = None
        self._reading: tuple[float, Array] = (-np.inf, np.full(3, np.nan))
        self._limit = settings.doubt
        self._misfit = 1.0  # the mean of those of the matches that agreed, the newest counting most
        self._matched: BoolArray | None = None  # by the check of the newest cycle, where it agrees
        self._doubted_at = -np.inf  # the odometry was contradicted last at this stamp (s)
        self._rest = Rest(sigma, settings)
        self._interval = np.inf  # between measured twists (s); it is infinite until two were measured

    def believe(self, sigma: Array) -> None:
        """Takes other standard deviations (3,) of a twist (m/s, m/s, rad/s) from now on.

        The errors of the sensor are taken out of the detections from now on, so it forgets those that it has
        learned, and the detections that have them.
        """
        self.sigma = sigma
        self._rest.believe(sigma)
        self._recent, self.errors = RecentDetections(self.settings), SensorErrors(self.settings)

    def update(self, odometry: Odometry, detections: Detections, may_doubt: bool = True) -> MeasuredMotion:
        """Returns the motion since the last cycle.

        Unless it `may_doubt`, odometry that is there is believed: then the detections' noise is not known.
        """
        t, measured = detections.t, detections.points_vehicle
        motion = self._integrate(odometry, t)
        columns = by_errors(measured, motion.odometry.twist)
        detections = replace(detections, points_vehicle=measured + columns @ self.errors.mean)
        variances = 0.5 * np.trace(detections.covariances, axis1=1, axis2=2)
        self._recent.forget(t)
        self._recent.correct(self.errors.mean)
        distrusted = t - self._doubted_at < self.settings.distrust
        self._limit = self.settings.doubt_again if distrusted else self.settings.doubt
        self._matched = None
        motion = self._checked(motion, detections, variances, may_doubt)
        if motion.doubted:
            self._doubted_at = t
        if not motion.fault and self._rest.update(odometry, t):
            motion = self._at_rest(motion, detections, variances)
        self.pose = compose(self.pose, motion.odometry.delta)
        points = to_map(detections.points_vehicle, self.pose[None])
        self.seen_again = self._recent.has(points) if self._matched is None else self._matched
        if motion.fault:
            columns = by_errors(measured, motion.odometry.twist)  # by the twist that is believed
        self._recent.add(t, measured, columns, self.pose)
        if self._t is not None and t > self._t:
            self._velocity = motion.odometry.delta / (t - self._t)
            self.errors.follow(self._velocity, t - self._t)
        self._t = t
        return motion

    @property
    def newest(self) -> Newest:
        """Returns what the readings of the next cycle go on from."""
        t, twist = self._reading
        return Newest(self._t, twist if t > -np.inf else None)

    # --- the odometry ------------------------------------------------------------------------------------

    def _integrate(self, odometry: Odometry, t: float) -> MeasuredMotion:
        """Returns the motion by odometry, whose noise grows where a twist is held for long."""
        if len(odometry.t) == 0:
            none = integrate_odometry(odometry, t, self.sigma)  # which is certain that nothing moves
            return MeasuredMotion(none, odometry.twist, missing=self._t is not None)
        measured, (before, twist) = odometry.t, self._reading
        if self._t is not None and measured[0] <= self._t and (odometry.twist[0] == twist).all():
            measured = np.append(before, measured[1:])  # the first row only goes on with the last twist
        self._reading = float(measured[-1]), odometry.twist[-1]
        ages = np.append(odometry.t[1:], t) - measured
        held = np.maximum(ages - self._hold(measured), 0.0)
        sigma, missing = self.sigma, bool(held[-1] > 0.0)
        if missing or held.any():
            sigma = np.hypot(self.sigma, held[:, None] * np.array(self.settings.accelerations))
        integrated = integrate_odometry(odometry, t, sigma)
        return MeasuredMotion(
            integrated, odometry.twist, missing=missing, stuck=self._is_stuck(odometry.twist)
        )

    def _is_stuck(self, twists: Array) -> bool:
        """Returns whether too many of the twists (k, 3) are equal to the one before, to the last digit."""
        same = twists[1:, 0] == twists[:-1, 0]
        if same.sum() < self.settings.stuck:
            return False
        return bool((twists[1:][same] == twists[:-1][same]).all(axis=1).sum() >= self.settings.stuck)

    def _hold(self, measured: Array) -> float:
        """Returns how long a twist may be held, from the stamps of newly measured ones (k,)."""
        intervals = np.diff(measured)
        if len(intervals):
            shortest = float(intervals.min())
            self._interval = min(self._interval, shortest)
        return max(self.settings.hold, self.settings.hold_intervals * self._interval)

    def _at_rest(self, motion: MeasuredMotion, detections: Detections, variances: Array) -> MeasuredMotion:
        """Returns no motion at all, where the detections say so as well, or else the given one."""
        settings = self.settings
        found = self._match(detections, variances, self.pose, settings.reaches_check)
        none = integrated_odometry(np.zeros(3), np.diag(settings.sigmas_rest) ** 2, NO_CALIBRATION)
        rest = MeasuredMotion(none, np.zeros((1, 3)))
        if found is None or self._is_contradicted(rest, self.pose, found):
            self._rest.end()
            return motion
        return replace(rest, bias=self._rest.bias(detections.t))

    # --- the check ---------------------------------------------------------------------------------------

    def _checked(
        self, motion: MeasuredMotion, detections: Detections, variances: Array, may_doubt: bool
    ) -> MeasuredMotion:
        """Returns the motion, or that of the detections where they contradict it, or where it is missing."""
        settings = self.settings
        if self._t is None or detections.t <= self._t:
            return motion
        dt = detections.t - self._t
        going_on = dt * (motion.odometry.twist if self._velocity is None else self._velocity)
        predicted = compose(self.pose, motion.odometry.delta)
        found = self._match(detections, variances, predicted, settings.reaches_check)
        if found is not None and found.misfit > settings.max_misfit * self._excess:
            found = None
        told = found is not None and found.matched >= settings.min_doubting
        stuck = motion.stuck and not told and self._has_jumped(motion.odometry, going_on, dt)
        failed = motion.missing or (stuck and settings.doubt < np.inf)
        if found is not None and not failed:
            difference = self._difference(motion.odometry, predicted, found)
            if not self._denies(found, difference):
                self._matched = found.is_matched
                self._misfit += settings.misfit_gain * (found.misfit - self._misfit)
                self.errors.update(difference, dt)
                return motion
        if not (may_doubt or failed):
            return motion
        best = self._best(detections, variances, (compose(self.pose, going_on), predicted), dt)
        denied = best is not None and self._is_contradicted(motion, predicted, best)
        if failed or (
            best is not None and denied and self._fits_better(best, predicted, detections, variances)
        ):
            return self._replaced(motion, best, going_on, dt)
        return motion

    def _fits_better(self, best: Match, predicted: Array, detections: Detections, variances: Array) -> bool:
        """Returns whether detections fit badly at the predicted pose (3,), and clearly better at the match.

        In a bend, a few cones may as well be laid on each other's neighbours, far from where they fit.
        """
        points, own = detections.points_vehicle[best.is_matched], variances[best.is_matched]
        at_odometry, at_match = (
            misfit_at(self._recent, points, own, pose, self.settings) for pose in (predicted, best.pose)
        )
        return at_odometry > max(self.settings.misfit_odometry, self.settings.misfit_ratio * at_match)

    def _best(
        self, detections: Detections, variances: Array, starts: tuple[Array, Array], dt: float
    ) -> Match | None:
        """Returns the better match of those that begin at two poses (3,), the first going on as before.

        A vehicle that was put down elsewhere sees other cones, which agree with no motion, or with one that
        no vehicle can make. Nothing is told from them.
        """
        settings = self.settings
        found = [self._match(detections, variances, start, settings.reaches) for start in starts]
        possible = [one for one in found if one is not None and self._is_possible(one, starts[0], dt)]
        return max(possible, key=lambda one: one.matched - one.misfit, default=None)

    def _is_possible(self, found: Match, going_on: Array, dt: float) -> bool:
        """Returns whether a match is that of a vehicle which went on from pose to pose (3,)."""
        sigmas = self._sigmas_going_on(dt) + np.sqrt(np.diag(np.linalg.inv(found.information)))
        change = np.abs(relative(going_on, found.pose))
        fits = found.misfit < self.settings.max_misfit * self._excess
        return fits and bool((change < self.settings.max_change * sigmas).all())

    def _is_contradicted(self, motion: MeasuredMotion, predicted: Array, found: Match) -> bool:
        """Returns whether a match of detections, which begins at the predicted pose (3,), denies a motion."""
        return self._denies(found, self._difference(motion.odometry, predicted, found))

    def _denies(self, found: Match, difference: Difference) -> bool:
        """Returns whether a match of detections is too far off a motion."""
        off, covariance = difference.off, self.errors.covariance_of(difference)
        enough = found.matched >= self.settings.min_doubting
        return enough and bool(off @ np.linalg.solve(covariance, off) > self._limit**2)

    def _has_jumped(self, odometry: IntegratedOdometry, going_on: Array, dt: float) -> bool:
        """Returns whether a motion differs from going on (3,) as before by more than a vehicle can do."""
        return bool((np.abs(odometry.delta - going_on) > self._sigmas_going_on(dt)).any())

    def _sigmas_going_on(self, dt: float) -> Array:
        """Returns the standard deviations (3,) of going on as before for a time (s), in m, m and rad."""
        settings = self.settings
        return np.array([settings.sigma_speed, settings.sigma_lateral, settings.sigma_rate]) * dt

    def _match(
        self, detections: Detections, variances: Array, start: Array, reaches: Sequence[float]
    ) -> Match | None:
        """Returns the match of a cycle's detections that begins at a pose (3,), if it holds the pose."""
        points = detections.points_vehicle
        found = match(self._recent, points, variances, start, self.settings, reaches)
        return found if found.matched >= self.settings.min_matched and found.is_certain else None

    def _difference(self, odometry: IntegratedOdometry, predicted: Array, found: Match) -> Difference:
        """Returns how far the detections are from the predicted pose (3,), in the vehicle's frame."""
        turn = _to_vehicle(predicted[2])
        spread = np.linalg.inv(found.information) * self._excess
        way = turn[:2, :2] @ (predicted[:2] - self._recent.seen_from)
        return Difference(
            off=turn @ (found.pose - predicted),
            covariance=turn @ spread @ turn.T + odometry.covariance,
            shifts=self.errors.shifts(way, odometry.twist),
        )

    @property
    def _excess(self) -> float:
        """Returns by which factor the variance of detections is larger than they claim; it is at least 1."""
        return max(self._misfit / self.settings.misfit, 1.0)

    def _replaced(
        self, motion: MeasuredMotion, best: Match | None, going_on: Array, dt: float
    ) -> MeasuredMotion:
        """Returns the motion by the detections together with going on (3,) as before."""
        settings, odometry = self.settings, motion.odometry
        mean, covariance = going_on.copy(), np.diag(self._sigmas_going_on(dt) ** 2)
        if best is not None:
            predicted = compose(self.pose, odometry.delta)
            difference = self._difference(odometry, predicted, best)
            near = settings.doubt_rate * np.sqrt(self.errors.covariance_of(difference)[2, 2])
            gyro_is_right = abs(difference.off[2]) <= near
            if gyro_is_right and not motion.missing and not motion.stuck:
                mean[2], covariance[2, 2] = odometry.delta[2], odometry.covariance[2, 2]
            own = relative(self.pose, best.pose)
            turn = _to_vehicle(best.pose[2])
            information = turn @ best.information @ turn.T / (settings.widening**2 * self._excess)
            prior = np.linalg.inv(covariance)
            covariance = np.linalg.inv(information + prior)
            delta = covariance @ (information @ own + prior @ mean)
            if not motion.missing:
                off = delta - odometry.delta
                covariance += np.outer(off, off) * settings.before**2
            mean = delta
        replaced = replace(integrated_odometry(mean, covariance, NO_CALIBRATION), twist=mean / dt)
        return MeasuredMotion(
            replaced, replaced.twist[None], not motion.missing, motion.missing, motion.stuck
        )


def _to_vehicle(theta: float) -> Array:
    """Returns the matrix (3, 3) that turns a small motion from the frame of the check to the vehicle's."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(theta).T
    return turn
