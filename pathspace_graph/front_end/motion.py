"""The motion between two cycles: odometry, checked against what the detections say of it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists, integrated_odometry
from pathspace_graph.factors.se2 import compose, relative, rotation, to_map
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.motion import BiasMeasurement, MeasuredMotion, integrate_odometry
from pathspace_graph.settings.online import MotionSettings

from . import scan_matching as scans
from .gate import Newest
from .scan_matching import REACHES_CHECK, Difference, Match, RecentDetections, SensorErrors, by_errors
from .standstill import Standstill

NO_CALIBRATION: Final = np.zeros((3, 2))  # derivative of a motion that is not by odometry
DOUBT_AGAIN: Final = 3.8  # contradiction of an odometry that was contradicted not long ago, sigmas
DISTRUST: Final = 12.0  # time for which it is distrusted so, s: wheels that slip do so in the next bends, too
DOUBT_RATE: Final = 2.0  # agreement within which a contradicted odometry's yaw rate is believed, sigmas
MIN_DOUBTING: Final = 4  # least number of matched detections of a contradiction
MISFIT: Final = 1.5  # mean-square misfit beyond which its excess scales the detections' covariances
MISFIT_GAIN: Final = 0.02  # smoothing gain of the mean-square misfit
MAX_MISFIT: Final = 3.0  # largest misfit of a motion: 1 where the vehicle moved, 4 where it was put down
MISFIT_ODOMETRY: Final = 2.0  # least misfit at the odometry's own pose in a contradiction
MISFIT_RATIO: Final = 1.3  # least ratio of that misfit to the one of the match
MAX_CHANGE: Final = 3.5  # largest difference of a motion from the one before, in `SIGMAS_CHANGE`
SIGMAS_CHANGE: Final = (3.0, 1.0, 0.5)  # m/s, m/s, rad/s from cycle to cycle without odometry
BEFORE: Final = 0.5  # share of a contradiction added to its motion's sigma: it may have begun earlier
WIDENING: Final = 1.5  # of the sigmas of a motion by detections, which the estimator uses again
HOLD: Final = 0.15  # time for which a twist is held without a loss of certainty, s
HOLD_INTERVALS: Final = 3.0  # shortest intervals of twists for which it is held so, if longer
STUCK: Final = 3  # twists equal to the one before from which readings are stuck
REST: Final = 1.0  # time of standing from which the mean yaw rate measures the bias, s
REST_TWIST: Final = (0.1, 0.1, 0.05)  # largest mean twist at rest, m/s, m/s, rad/s, but for noise
REST_SIGMAS: Final = 3.0  # standard deviations of the mean that count as its noise
SIGMAS_REST: Final = (5e-4, 5e-4, 5e-5)  # m, m, rad, of a motion at rest from cycle to cycle
SIGMAS_STANDS: Final = (0.02, 0.02, 0.002)  # of one that the detections alone tell
Seen = tuple[Array, Array]  # corrected detections (m, 2), vehicle frame, and variances (m,) of a coordinate


class MotionCheck:
    """Odometry of each cycle, checked against the detections of the newest cycles.

    Its frame is that of the motion so far, which drifts; only its newest part is used.
    """

    def __init__(self, sigma: Array, settings: MotionSettings) -> None:
        self.settings = settings
        self.sigma = sigma
        self.seen_again: BoolArray = np.zeros(0, bool)  # (m,) of the newest cycle, like `Reading.seen_again`
        self.pose: Array = np.zeros(3)  # (3,) in the frame of the front end, from 0 on
        self.errors = SensorErrors(settings)  # how much the sensor is turned, and how late its detections are
        self._recent = RecentDetections()
        self._velocity: Array | None = None
        self._t: float | None = None
        self._reading: tuple[float, Array] = (-np.inf, np.full(3, np.nan))
        self._limit = settings.doubt
        self._misfit = 1.0  # the mean of those of the matches that agreed, the newest counting most
        self._matched: BoolArray | None = None  # by the check of the newest cycle, where it agrees
        self._doubted_at = -np.inf  # the odometry was contradicted last at this stamp (s)
        self._rest = Rest(sigma)
        self._standstill = Standstill()
        self._interval = np.inf  # between measured twists (s); it is infinite until two were measured

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other.errors, other._recent = self.errors.copy(), self._recent.copy()
        other._rest, other._standstill = self._rest.copy(), self._standstill.copy()
        return other

    def set_noise(self, sigma: Array) -> None:
        """Take other standard deviations (3,) of a twist; what was learned of the sensor is forgotten."""
        self.sigma = self._rest.sigma = sigma
        self._recent, self.errors = RecentDetections(), SensorErrors(self.settings)
        self._standstill = Standstill()

    def update(
        self, odometry: Odometry, detections: Detections, may_doubt: bool | None = True
    ) -> MeasuredMotion:
        """Return the motion since the last cycle, whose odometry may be doubted if the noise is known.

        If `may_doubt` is None, the detections are only asked where the odometry is missing or stuck.
        """
        t, measured = detections.t, detections.points_vehicle
        motion = self._integrate(odometry, t)
        columns = by_errors(measured, motion.odometry.twist)
        points, covariances = measured + columns @ self.errors.mean, detections.covariances
        seen = points, 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1])
        self._recent.forget(t)
        self._recent.correct(self.errors.mean)
        self._limit = DOUBT_AGAIN if t - self._doubted_at < DISTRUST else self.settings.doubt
        self._matched = None
        self._standstill.add(t, points, self._excess * covariances, motion.odometry.delta)
        standing = self._standing(motion) if may_doubt else None
        motion = standing or self._checked(motion, t, seen, may_doubt)
        if motion.doubted:
            self._doubted_at = t
        if not motion.fault and self._rest.update(odometry, t):
            motion = self._at_rest(motion, t, seen)
        self.pose = compose(self.pose, motion.odometry.delta)
        if self._matched is not None:
            self.seen_again = self._matched
        elif may_doubt is not None:
            self.seen_again = self._recent.has(to_map(points, self.pose[None]))
        if motion.fault:
            columns = by_errors(measured, motion.odometry.twist)  # by the twist that is believed
        self._recent.add(t, measured, columns, self.pose)
        self._standstill.believe(self.pose)
        if self._t is not None and t > self._t:
            self._velocity = motion.odometry.delta / (t - self._t)
            self.errors.follow(self._velocity, t - self._t)
        self._t = t
        return motion

    @property
    def newest(self) -> Newest:
        t, twist = self._reading
        return Newest(self._t, twist if t > -np.inf else None)

    def _integrate(self, odometry: Odometry, t: float) -> MeasuredMotion:
        """Return the motion by odometry, whose noise grows where a twist is held for long."""
        if len(odometry.t) == 0:
            none = integrate_odometry(odometry, t, self.sigma)  # which is certain that nothing moves
            return MeasuredMotion(none, odometry.twist, missing=self._t is not None)
        measured, (before, twist) = odometry.t, self._reading
        if self._t is not None and measured[0] <= self._t and (odometry.twist[0] == twist).all():
            measured = np.concatenate([[before], measured[1:]])  # the first row only goes on with it
        self._reading = float(measured[-1]), odometry.twist[-1]
        if len(measured) > 1:
            self._interval = min(self._interval, float((measured[1:] - measured[:-1]).min()))
        ends = np.concatenate([odometry.t[1:], [t]])
        held = np.maximum(ends - measured - max(HOLD, HOLD_INTERVALS * self._interval), 0.0)
        excess, missing, durations = np.zeros(3), bool(held[-1] > 0.0), ends - odometry.t
        if missing or held.any():
            excess = held[:, None] * np.array(self.settings.accelerations)
        integrated = integrate_twists(durations, odometry.twist, np.hypot(self.sigma, excess))
        same = (odometry.twist[1:] == odometry.twist[:-1]).all(axis=1)  # to the last digit
        stuck = bool(same.sum() >= STUCK)
        return MeasuredMotion(integrated, odometry.twist, False, missing, stuck, None, durations, excess)

    def _at_rest(self, motion: MeasuredMotion, t: float, seen: Seen) -> MeasuredMotion:
        standing = self._match(seen, self.pose, REACHES_CHECK)
        none = integrated_odometry(np.zeros(3), np.diag(SIGMAS_REST) ** 2, NO_CALIBRATION)
        if standing is None or self._denies(standing, self._difference(none, self.pose, standing)):
            self._rest.end()
            return motion
        return MeasuredMotion(none, np.zeros((1, 3)), bias=self._rest.bias(t))

    def _standing(self, motion: MeasuredMotion) -> MeasuredMotion | None:
        """Return the motion back to where the vehicle stands, if the cones clearly say that it does."""
        place = self._standstill.place(self.settings.doubt)
        if place is None:
            return None
        back = relative(self.pose, place)
        covariance = np.diag(SIGMAS_STANDS) ** 2 + np.outer(back, back) * BEFORE**2
        standing = integrated_odometry(back, covariance, NO_CALIBRATION)
        return MeasuredMotion(standing, np.zeros((1, 3)), not motion.missing, motion.missing, motion.stuck)

    def _checked(
        self, motion: MeasuredMotion, t: float, seen: Seen, may_doubt: bool | None
    ) -> MeasuredMotion:
        """Return the motion, or that of the detections where they contradict it, or where it is missing."""
        unasked = may_doubt is None and not (motion.missing or motion.stuck)
        if self._t is None or t <= self._t or unasked:
            return motion
        odometry, dt = motion.odometry, t - self._t
        going_on = dt * (odometry.twist if self._velocity is None else self._velocity)
        predicted = compose(self.pose, odometry.delta)
        near = self._match(seen, predicted, REACHES_CHECK)
        if near is not None and near.misfit > MAX_MISFIT * self._excess:
            near = None
        told = near is not None and near.matched >= MIN_DOUBTING
        jumped = (np.abs(odometry.delta - going_on) > np.array(SIGMAS_CHANGE) * dt).any()
        stuck = motion.stuck and not told and bool(jumped)  # no vehicle changes its velocity so
        failed = motion.missing or (stuck and self.settings.doubt < np.inf)
        if near is not None and not failed:
            difference = self._difference(odometry, predicted, near)
            if not self._denies(near, difference):
                self._matched = near.is_matched
                self._misfit += MISFIT_GAIN * (near.misfit - self._misfit)
                self.errors.update(difference, dt)
                return motion
        if not (may_doubt or failed):
            return motion
        best = self._best(seen, (compose(self.pose, going_on), predicted), dt)
        if best is not None and not failed:
            denied = self._denies(best, self._difference(odometry, predicted, best))
            failed = denied and self._fits_better(best, predicted, seen)
        return self._replaced(motion, best, going_on, dt) if failed else motion

    def _fits_better(self, best: Match, predicted: Array, seen: Seen) -> bool:
        """Return whether detections fit badly at the predicted pose (3,), and clearly better at the match."""
        points, variances = (column[best.is_matched] for column in seen)
        at_odometry = scans.misfit_at(self._recent, points, variances, predicted)
        at_match = scans.misfit_at(self._recent, points, variances, best.pose)
        return at_odometry > max(MISFIT_ODOMETRY, MISFIT_RATIO * at_match)

    def _best(self, seen: Seen, starts: tuple[Array, Array], dt: float) -> Match | None:
        matches = [self._match(seen, start, scans.REACHES) for start in starts]
        possible = [one for one in matches if one is not None and self._is_possible(one, starts[0], dt)]
        return max(possible, key=lambda one: one.matched - one.misfit, default=None)

    def _is_possible(self, matched: Match, going_on: Array, dt: float) -> bool:
        sigmas = np.array(SIGMAS_CHANGE) * dt + np.sqrt(np.diag(np.linalg.inv(matched.information)))
        change = np.abs(relative(going_on, matched.pose))
        fits = matched.misfit < MAX_MISFIT * self._excess
        return fits and bool((change < MAX_CHANGE * sigmas).all())

    def _denies(self, matched: Match, difference: Difference) -> bool:
        return matched.matched >= MIN_DOUBTING and self.errors.square_of(difference) > self._limit**2

    def _match(self, seen: Seen, start: Array, reaches: Sequence[float]) -> Match | None:
        matched = scans.match(self._recent, *seen, start, reaches)
        return matched if matched.matched >= scans.MIN_MATCHED and matched.is_certain else None

    def _difference(self, odometry: IntegratedOdometry, predicted: Array, matched: Match) -> Difference:
        """Return how far the detections are from the predicted pose (3,), in the vehicle's frame."""
        known = matched.pose, matched.information, self._excess, predicted, odometry.covariance
        way = rotation(predicted[2]).T @ (predicted[:2] - self._recent.seen_from)
        return Difference(*kernels.off_prediction(*known), self.errors.shifts(way, odometry.twist))

    @property
    def _excess(self) -> float:
        """Factor by which the variance of detections is larger than they claim; at least 1."""
        return max(self._misfit / MISFIT, 1.0)

    def _replaced(
        self, motion: MeasuredMotion, best: Match | None, going_on: Array, dt: float
    ) -> MeasuredMotion:
        """Return the motion by the detections together with going on (3,) as before."""
        odometry, mean = motion.odometry, going_on.copy()
        covariance = np.diag((np.array(SIGMAS_CHANGE) * dt) ** 2)
        if best is not None:
            difference = self._difference(odometry, compose(self.pose, odometry.delta), best)
            near = DOUBT_RATE * np.sqrt(self.errors.covariance_of(difference)[2, 2])
            gyro_is_right = abs(difference.off[2]) <= near
            if gyro_is_right and not (motion.missing or motion.stuck):
                mean[2], covariance[2, 2] = odometry.delta[2], odometry.covariance[2, 2]
            turn = np.eye(3)  # from the frame of the check to the vehicle's
            turn[:2, :2] = rotation(best.pose[2]).T
            information = turn @ best.information @ turn.T / (WIDENING**2 * self._excess)
            prior = np.linalg.inv(covariance)
            covariance = np.linalg.inv(information + prior)
            delta = covariance @ (information @ relative(self.pose, best.pose) + prior @ mean)
            if not motion.missing:
                off = delta - odometry.delta
                covariance += np.outer(off, off) * BEFORE**2
            mean = delta
        replaced, twist = integrated_odometry(mean, covariance, NO_CALIBRATION), mean / dt
        found = not motion.missing, motion.missing, motion.stuck
        return MeasuredMotion(replace(replaced, twist=twist), twist[None], *found)


class Rest:
    """Judge of whether the vehicle stands, by the odometry; it averages the yaw rate meanwhile."""

    def __init__(self, sigma: Array) -> None:
        self.sigma = sigma
        self.end()

    def copy(self) -> Self:
        """Return a copy that goes on independently: no attribute is changed in place."""
        return shallow(self)

    def end(self) -> None:
        self._since: float | None = None
        self._sum, self._count = np.zeros(3), 0
        self._measured_since = self._rate_sum = 0.0
        self._rate_count = 0

    def update(self, odometry: Odometry, t: float) -> bool:
        """Return whether the vehicle has stood for long enough at t (s), by the newest twists."""
        twists = odometry.twist[1:] if len(odometry.twist) > 1 else odometry.twist  # the first one is held
        moves = not len(twists) or twists[:, 0].min() > REST_TWIST[0] + REST_SIGMAS * self.sigma[0]
        if moves or not self._is_still(twists.mean(axis=0), len(twists)):
            self.end()
            return False
        if self._since is None:
            self._since = self._measured_since = float(odometry.t[0])
        self._sum, self._count = self._sum + twists.sum(axis=0), self._count + len(twists)
        self._rate_sum += float(twists[:, 2].sum())
        self._rate_count += len(twists)
        return self._is_still(self._sum / self._count, self._count) and t - self._since >= REST

    def bias(self, t: float) -> BiasMeasurement | None:
        """Return the bias that was measured since the last call, if that is long enough ago at t (s)."""
        if t - self._measured_since < REST:
            return None
        mean, sigma = self._rate_sum / self._rate_count, float(self.sigma[2]) / np.sqrt(self._rate_count)
        self._measured_since, self._rate_sum, self._rate_count = t, 0.0, 0
        return BiasMeasurement(mean, sigma)

    def _is_still(self, mean: Array, count: int) -> bool:
        """Return whether a mean twist (3,) of this number of readings is that of a vehicle at rest."""
        return bool((np.abs(mean) < REST_TWIST + REST_SIGMAS * self.sigma / np.sqrt(count)).all())
