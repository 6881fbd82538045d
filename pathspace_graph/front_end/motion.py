"""The motion between two cycles: standing still, the odometry, or what the detections show instead."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.factors.odometry import integrate_twists, integrated_odometry
from pathspace_graph.factors.se2 import compose, relative
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.motion import BiasMeasurement, MeasuredMotion
from pathspace_graph.settings.mapper import MotionSettings

from .scan_matching import (
    MIN_DOUBTING,
    MOST_MISFIT,
    REACHES,
    REACHES_CHECK,
    SIGMA_CONE,
    Match,
    ScanMatcher,
    Seen,
    SensorErrors,
)

# --- standing still --------------------------------------------------------------------------------------

STILL_TIME: Final = 1.0  # time (s) over which cones are compared, and over which twists show a rest
CREEP: Final = 3.0  # largest speed of creep (m/s); a single cycle contradicts spinning wheels
HYPOTHESES: Final = (0.0, 0.25, 0.5, 1.0)
"""Hypotheses, as shares of the odometry's motion: standstill, slip, and the odometry itself."""
CHANCE: Final = 4.5  # least gain (sigmas of its scatter): points of a line fit by chance below
REST_TWIST: Final = np.array(
    [0.1, 0.1, 0.05]
)  # largest mean twist at rest (m/s, m/s, rad/s), without its noise
REST_SIGMAS: Final = 3.0  # allowance for the noise of the mean (sigmas)


@dataclass(frozen=True, eq=False)
class _Cycle:
    t: float  # stamp (s)
    points: Array  # (n, 2) corrected detections, vehicle frame (m)
    by_odometry: Array  # (3,) pose by odometry alone
    gains: Array  # (5, k) cumulative sums of `kernels.standstill_gains` over the k previous cycles


class Standstill(Copyable):
    """The hypothesis that the vehicle stands, by the twists or by the cones of the last second."""

    def __init__(self) -> None:
        self.forget()
        self._since: float | None = None  # stamp (s) from which the twists show a rest, if they do

    def forget(self) -> None:
        """Forget the cones, as they were corrected otherwise."""
        self._cycles: tuple[_Cycle, ...] = ()  # newest first
        self._poses: tuple[Array, ...] = ()  # (3,) accepted poses of all but the newest of these

    def by_twists(self, odometry: Odometry, t: float, noise: TwistNoise) -> bool:
        """Whether the twists, with some noise, have shown a rest for `STILL_TIME` at t (s).

        Their mean is consistent with a rest in each cycle, which shows at once that the vehicle pulls off,
        and since the last measurement of the bias, which shows a creep.
        """
        twists = odometry.twist[1:] if len(odometry.twist) > 1 else odometry.twist  # the first one is held
        count, total = len(twists), twists.sum(axis=0)
        allowed = REST_TWIST + REST_SIGMAS * noise.white / np.sqrt(max(count, 1))
        if count == 0 or (np.abs(total / count) > allowed).any():
            self._since = None
            return False
        if self._since is None:
            self._since = self._begin = float(odometry.t[0])
            self._sum, self._count = np.zeros(3), 0
        self._sum, self._count = self._sum + total, self._count + count
        allowed = REST_TWIST + REST_SIGMAS * noise.of_mean(self._count, t - self._begin)
        return t - self._since >= STILL_TIME and bool((np.abs(self._sum / self._count) < allowed).all())

    def bias(self, t: float, noise: TwistNoise) -> BiasMeasurement | None:
        """Return the bias measured since the last result, if that is `STILL_TIME` ago at t (s)."""
        if t - self._begin < STILL_TIME:
            return None
        sigma = float(noise.of_mean(self._count, t - self._begin)[2])
        measured = BiasMeasurement(float(self._sum[2]) / self._count, sigma)
        self._begin, self._sum, self._count = t, np.zeros(3), 0
        return measured

    def add(self, t: float, points: Array, covariances: Array, delta: Array, pose: Array) -> None:
        """Add corrected detections (n, 2), vehicle frame, at t (s) after the motion (3,) by odometry.

        pose (3,) is the accepted one of the cycle before.
        """
        cycles = self._cycles
        by_odometry = compose(cycles[0].by_odometry, delta) if cycles else np.zeros(3)
        if cycles and np.hypot(delta[0], delta[1]) > CREEP * (t - cycles[0].t):
            cycles = ()
        cycles = tuple(one for one in cycles if one.t >= t - STILL_TIME)
        others = [(one.points, one.by_odometry) for one in cycles]
        gains = kernels.standstill_gains(
            points, covariances, by_odometry, others, HYPOTHESES, SIGMA_CONE, MOST_MISFIT
        )
        newest = _Cycle(t, points, by_odometry, gains.cumsum(axis=1))
        self._cycles, self._poses = (newest, *cycles), (pose, *self._poses)[: len(cycles)]

    def by_cones(self, limit: float) -> Array | None:
        """Return the pose (3,) at which the vehicle stands, or None if it may move.

        Twice the log-likelihood of n cycles is `2 / n` times the sum of the gains of their pairs. The vehicle
        stands if, for some number of newest cycles, twice the log-likelihood ratio of standstill to odometry
        exceeds `limit^2`, standstill is likelier than slip, and the gain exceeds its scatter. All of these
        cycles then get the pose of the first one.
        """
        if not self._cycles:
            return None
        earlier = len(self._cycles) - 1
        sums = np.zeros((len(HYPOTHESES) + 1, earlier))
        for k, one in enumerate(self._cycles):
            sums[:, k:] += one.gains[:, : earlier - k]
        rest, *slip, odometry, squares = sums
        likelier = (rest - odometry) * 2.0 / (2.0 + np.arange(earlier))
        possible = (rest >= np.max(slip, axis=0)) & (rest - odometry > CHANCE * np.sqrt(squares))
        likelier = np.where(possible, likelier, 0.0)
        if not likelier.max(initial=0.0) > limit**2:
            return None
        first = int(likelier.argmax())
        pose = self._poses[first]
        self._poses = first * (pose,) + self._poses[first:]
        return pose


# --- check of the odometry -------------------------------------------------------------------------------

GATE_DISTRUSTED: Final = 3.8  # gate (sigmas) for `DISTRUST` seconds after a contradiction
DISTRUST: Final = 12.0  # time (s): wheels that slip do so again in the next bends
DOUBT_RATE: Final = 2.0  # gate (sigmas) of the yaw rate of a contradicted odometry
MAX_CHANGE: Final = 3.5  # largest change of the motion between cycles, in `SIGMAS_CHANGE`
SIGMAS_CHANGE: Final = (3.0, 1.0, 0.5)  # change of the velocity in a cycle without odometry (m/s, m/s, rad/s)
BEFORE: Final = 0.5  # share of a contradiction added to the sigma of its motion: it may have begun earlier
WIDENED: Final = 1.5  # inflation of the sigmas of a matched motion: the estimator uses the detections again
HOLD: Final = (0.15, 3.0)
"""Time (s) for which a twist is held without additional noise, or multiple of the shortest interval between
twists, if that is longer."""
STANDING: Final = MeasuredMotion(
    integrated_odometry(np.zeros(3), np.diag([5e-4, 5e-4, 5e-5]) ** 2, np.zeros((3, 2))), np.zeros((1, 3))
)
"""Motion between two cycles at rest."""
SIGMAS_PULL_OFF: Final = (0.3, 0.05, 0.0)  # motion that odometry misses when a rest ends (m, m, rad)


def is_possible(found: Match, going_on: Array, dt: float) -> bool:
    """Whether a match is in reach after dt (s), with constant velocity to the pose `going_on` (3,)."""
    sigmas = np.sqrt(np.diag(np.linalg.inv(found.information_vehicle)))
    change = np.abs(relative(going_on, found.pose))
    return bool((change < MAX_CHANGE * (np.array(SIGMAS_CHANGE) * dt + sigmas)).all())


def without_odometry(
    delta: Array, covariance: Array, twist: Array, instead_of: MeasuredMotion
) -> MeasuredMotion:
    """Return a motion (3,) with the mean twist (3,) that replaces one by odometry, whose faults it has."""
    odometry = replace(integrated_odometry(delta, covariance, np.zeros((3, 2))), twist=twist)
    missing, stuck = instead_of.missing, instead_of.stuck
    return MeasuredMotion(odometry, twist[None], not missing, missing, stuck)


class MotionCheck(Copyable):
    """Check of each cycle's odometry against the detections of the newest cycles.

    Poses are in the frame of dead reckoning, which drifts; only the newest ones are used.
    """

    def __init__(self, noise: TwistNoise, settings: MotionSettings, *, of_lines: bool = False) -> None:
        self.noise = noise
        self.seen_again: BoolArray = np.zeros(0, bool)  # (m,) `Reading.seen_again` of the newest cycle
        self.pose: Array = np.zeros(3)  # (3,) newest pose by dead reckoning; the first one is 0
        self._settings, self._of_lines = settings, of_lines
        self._matcher = ScanMatcher(settings, of_lines=of_lines)
        self._standstill, self._rests = Standstill(), False
        self._velocity: Array | None = None
        self.t: float | None = None  # stamp of the newest cycle (s)
        self._doubted_at = -np.inf  # stamp of the last contradiction (s)
        self.twist: Array | None = None  # (3,) newest measured twist (m/s, m/s, rad/s)
        self._twist_t = -np.inf  # its stamp (s)
        self._twist_interval = np.inf  # shortest time between measured twists (s)

    def set_noise(self, noise: TwistNoise) -> None:
        """Set the noise of a twist, and forget the learned errors of the sensor."""
        self.noise = noise
        self._matcher.forget()
        self._standstill.forget()

    @property
    def errors(self) -> SensorErrors:
        """Yaw and latency of the sensor, learned so far."""
        return self._matcher.errors

    def update(
        self, odometry: Odometry, detections: Detections, *, may_contradict: bool = True
    ) -> MeasuredMotion:
        """Return the motion since the previous cycle.

        `may_contradict` says whether the noise of the detections is known well enough to contradict the
        odometry; otherwise they only agree with it, or replace it where it is missing. Points of lines cannot
        show a standstill.
        """
        t, matcher, standstill = detections.t, self._matcher, self._standstill
        motion = self._by_odometry(odometry, t)
        twist = motion.odometry.twist
        seen, place = matcher.corrected(detections, twist), None
        if not self._of_lines:
            covariances = matcher.excess * detections.covariances
            standstill.add(t, seen.points, covariances, motion.odometry.delta, self.pose)
            place = standstill.by_cones(self._settings.doubt) if may_contradict else None
        if place is not None:
            back = relative(self.pose, place)
            covariance = STANDING.odometry.covariance + np.outer(back, back) * BEFORE**2
            motion = without_odometry(back, covariance, np.zeros(3), motion)
        else:
            rests = not motion.missing and standstill.by_twists(odometry, t, self.noise)
            motion = self._likeliest(motion, t, seen, rests, may_contradict)
        if motion.doubted:
            self._doubted_at = t
        if not motion.fault:
            rested, self._rests = self._rests, motion is STANDING
            if self._rests:
                motion = replace(motion, bias=standstill.bias(t, self.noise))
            elif rested:
                motion = motion.with_missed(np.array(SIGMAS_PULL_OFF), self.noise)
        self.pose = compose(self.pose, motion.odometry.delta)
        self.seen_again = matcher.has(seen, self.pose)
        matcher.remember(detections, motion.odometry.twist if motion.fault else twist, self.pose)
        if self.t is not None and t > self.t:
            self._velocity = motion.odometry.delta / (t - self.t)
            matcher.errors.follow(self._velocity, t - self.t)
        self.t = t
        return motion

    def _by_odometry(self, odometry: Odometry, t: float) -> MeasuredMotion:
        """Integrate the twists from the previous cycle to t (s), each held until the next one.

        The noise of a twist grows while it is held for long.
        """
        if len(odometry.t) == 0:  # no motion, with certainty
            none = integrate_twists(np.zeros(0), odometry.twist, self.noise.white)
            return MeasuredMotion(none, odometry.twist, missing=self.t is not None)
        stamps, twists, first = odometry.t, odometry.twist, float(odometry.t[0])
        goes_on = self.twist is not None and (twists[0] == self.twist).all()
        if self.t is not None and first <= self.t and goes_on:
            first = self._twist_t  # the first row repeats it
        durations, excess, self._twist_interval, missing, same = kernels.held_twists(
            stamps, twists, t, first, self._twist_interval, HOLD, self._settings.accelerations
        )
        self.twist, self._twist_t = twists[-1], float(stamps[-1]) if len(stamps) > 1 else first
        integrated = integrate_twists(durations, twists, np.hypot(self.noise.sigmas(durations), excess))
        stuck = same >= 3  # number of twists equal to the previous one
        return MeasuredMotion(integrated, twists, False, missing, stuck, None, durations, excess)

    def _likeliest(
        self, motion: MeasuredMotion, t: float, seen: Seen, rests: bool, may_contradict: bool
    ) -> MeasuredMotion:
        """Return the motion that the detections agree with.

        The hypotheses are, in this order, standing still if the vehicle `rests` by the twists, and the
        odometry, each if a match beside it agrees; then the best match that is possible after the newest
        velocity and fits clearly better than the odometry, and the odometry again. The odometry has failed
        where it is missing, or stuck at a velocity to which no vehicle jumps; then the last hypothesis is
        constant velocity.
        """
        if self.t is None or t <= self.t:
            return motion
        limit = GATE_DISTRUSTED if t - self._doubted_at < DISTRUST else self._settings.doubt
        matcher, odometry, dt = self._matcher, motion.odometry, t - self.t
        sigmas = np.array(SIGMAS_CHANGE) * dt
        largest = 3.0 * matcher.excess  # misfits are 1 where the vehicle moved, 4 where it was put down
        going_on = dt * (odometry.twist if self._velocity is None else self._velocity)
        jumped = bool((np.abs(odometry.delta - going_on) > sigmas).any())
        for one in [STANDING, motion] if rests else [motion]:
            predicted = compose(self.pose, one.odometry.delta)
            near = matcher.match(seen, predicted, REACHES_CHECK)
            fits = near is not None and near.misfit < largest
            held = near is not None and fits and near.matched >= MIN_DOUBTING
            stuck = motion.stuck and jumped and not held
            failed = motion.missing or (stuck and self._settings.doubt < np.inf)
            if near is not None and fits and not failed:
                difference = matcher.difference(near, one.odometry, predicted)
                if difference.square <= limit**2:
                    matcher.agree(near, difference, dt)
                    return one
        if not may_contradict and not failed:
            return motion
        starts, possible = (compose(self.pose, going_on), predicted), list[Match]()
        for start in starts:
            found = matcher.match(seen, start, REACHES)
            if found is not None and found.misfit < largest and is_possible(found, starts[0], dt):
                possible.append(found)
        best = max(possible, key=lambda one: one.matched - one.misfit, default=None)
        if best is None and not failed:
            return motion
        delta, covariance = going_on, np.diag(sigmas**2)
        if best is not None:
            difference = matcher.difference(best, odometry, predicted)
            if not failed:
                matched = Seen(seen.points[best.is_matched], seen.variances[best.is_matched])
                at_odometry, at_match = (matcher.misfit(matched, pose) for pose in (predicted, best.pose))
                fits_better = at_odometry > max(2.0, 1.3 * at_match)
                if difference.square <= limit**2 or not fits_better:
                    return motion
            mean = going_on.copy()
            gyro_is_right = abs(difference.off[2]) <= DOUBT_RATE * np.sqrt(difference.spread[2, 2])
            if gyro_is_right and not (motion.missing or motion.stuck):
                mean[2], covariance[2, 2] = odometry.delta[2], odometry.covariance[2, 2]
            information = best.information_vehicle / (WIDENED**2 * matcher.excess)
            prior = np.linalg.inv(covariance)
            covariance = np.asarray(np.linalg.inv(information + prior), np.float64)
            delta = covariance @ (information @ relative(self.pose, best.pose) + prior @ mean)
            off = (0.0 if motion.missing else BEFORE) * (delta - odometry.delta)
            covariance += np.outer(off, off)
        return without_odometry(delta, covariance, delta / dt, motion)
