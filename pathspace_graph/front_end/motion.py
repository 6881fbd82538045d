"""The motion between two cycles: odometry, checked by scan matching of the detections."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.factors.odometry import integrate_twists, integrated_odometry
from pathspace_graph.factors.se2 import compose, move_points, relative, rotation
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.motion import BiasMeasurement, MeasuredMotion, integrate_odometry
from pathspace_graph.settings.online import MotionSettings

from .gate import Newest
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

COMPARED: Final = 1.0  # largest age of a compared cycle (s)
CREEP: Final = 3.0  # largest speed of creep (m/s); a single cycle contradicts spinning wheels
HYPOTHESES: Final = (0.0, 0.25, 0.5, 1.0)
"""Hypotheses, as shares of the odometry's motion: standstill, slip, and the odometry itself."""
CHANCE: Final = 4.5  # least gain (sigmas of its scatter): points of a line fit by chance below
NOWHERE: Final = np.full((1, 2), 1e6)  # point far from all others, so that no cycle is empty


@dataclass(frozen=True, eq=False)
class _Cycle:
    t: float  # stamp (s)
    points: Array  # (n, 2) corrected detections, vehicle frame, and `NOWHERE`
    farthest: float  # largest range of a detection (m)
    by_odometry: Array  # (3,) pose by odometry alone
    pose: Array  # (3,) accepted pose
    gains: Array  # (5, k) cumulative sums of `_gains` over the k previous cycles


class Standstill(Copyable):
    """Detection of a standstill by the cones of the last second."""

    def __init__(self) -> None:
        self._cycles: tuple[_Cycle, ...] = ()  # newest first

    def add(self, t: float, points: Array, covariances: Array, delta: Array) -> None:
        """Add corrected detections (n, 2), vehicle frame, at t (s) after the motion (3,) by odometry."""
        cycles = self._cycles
        by_odometry = compose(cycles[0].by_odometry, delta) if cycles else np.zeros(3)
        if cycles and np.hypot(delta[0], delta[1]) > CREEP * (t - cycles[0].t):
            cycles = ()
        cycles = tuple(one for one in cycles if one.t >= t - COMPARED)
        gains = _gains(cycles, points, covariances, by_odometry)
        farthest = np.sqrt((points**2).sum(axis=1).max(initial=0.0))
        points = np.concatenate([points, NOWHERE])
        newest = _Cycle(t, points, farthest, by_odometry, by_odometry, gains.cumsum(axis=1))
        self._cycles = (newest, *cycles)

    def believe(self, pose: Array) -> None:
        """Set the accepted pose (3,) of the newest cycle."""
        self._place(1, pose)

    def place(self, limit: float) -> Array | None:
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
        first = 1 + int(likelier.argmax())
        pose = self._cycles[first].pose
        self._place(first, pose)
        return pose

    def _place(self, count: int, pose: Array) -> None:
        """Set the pose (3,) of the `count` newest cycles."""
        placed = (replace(one, pose=pose) for one in self._cycles[:count])
        self._cycles = (*placed, *self._cycles[count:])


def _gains(cycles: Sequence[_Cycle], points: Array, covariances: Array, by_odometry: Array) -> Array:
    """Return the gains (5, k) of the newest cycle with k others, a row for each hypothesis.

    The gain of a detection is `max(0, MOST_MISFIT - d^2)` with its whitened distance d from the nearest one
    of the other cycle. Detections outside the other cycle's view, by odometry, have no gain: the view moves
    with the vehicle, and its border matches only at standstill. The last row sums (standstill - odometry)^2.
    """
    if not cycles:
        return np.zeros((len(HYPOTHESES) + 1, 0))
    ways = np.array([relative(by_odometry, one.by_odometry) for one in cycles])
    begins = np.cumsum([0, *(len(one.points) for one in cycles)])[:-1]
    resting = np.concatenate([one.points for one in cycles])
    moved = np.concatenate([move_points(way, one.points) for way, one in zip(ways, cycles, strict=True)])
    view = np.array([one.farthest for one in cycles]) - np.hypot(ways[:, 0], ways[:, 1])
    seen = np.hypot(points[:, 0], points[:, 1])[:, None] <= view
    precisions = np.linalg.inv(2.0 * covariances + SIGMA_CONE**2 * np.eye(2))
    (xx, xy), (_, yy) = precisions.transpose(1, 2, 0)[..., None]
    gains = []
    for share in HYPOTHESES:
        x, y = (points[:, None] - resting - share * (moved - resting)).transpose(2, 0, 1)
        square = np.minimum.reduceat(xx * x * x + 2.0 * xy * x * y + yy * y * y, begins, axis=1)
        gains.append(seen * np.maximum(MOST_MISFIT - square, 0.0))
    return np.array([one.sum(axis=0) for one in (*gains, (gains[0] - gains[-1]) ** 2)])


# --- standing still --------------------------------------------------------------------------------------


NO_CALIBRATION: Final = np.zeros((3, 2))  # derivative by the calibration of a motion without odometry
GATE_DISTRUSTED: Final = 3.8  # gate (sigmas) for `DISTRUST` seconds after a contradiction
DISTRUST: Final = 12.0  # time (s): wheels that slip do so again in the next bends
DOUBT_RATE: Final = 2.0  # gate (sigmas) of the yaw rate of a contradicted odometry
MAX_CHANGE: Final = 3.5  # largest change of the motion between cycles, in `SIGMAS_CHANGE`
SIGMAS_CHANGE: Final = (3.0, 1.0, 0.5)  # change of the velocity in a cycle without odometry (m/s, m/s, rad/s)
BEFORE: Final = 0.5  # share of a contradiction added to the sigma of its motion: it may have begun earlier
WIDENED: Final = 1.5  # inflation of the sigmas of a matched motion: the estimator uses the detections again
HOLD: Final = 0.15  # time for which a twist is held without additional noise (s)
HOLD_INTERVALS: Final = 3.0  # the same in shortest intervals between twists, if that is longer
STUCK: Final = 3  # number of twists equal to the previous one from which readings are stuck
REST_TIME: Final = 1.0  # time at rest over which the mean yaw rate measures the bias (s)
REST_TWIST: Final = (0.1, 0.1, 0.05)  # largest mean twist at rest (m/s, m/s, rad/s), without its noise
REST_SIGMAS: Final = 3.0  # allowance for the noise of the mean (sigmas)
SIGMAS_REST: Final = (5e-4, 5e-4, 5e-5)  # motion between cycles at rest by odometry (m, m, rad)
SIGMAS_PULL_OFF: Final = (0.3, 0.05, 0.0)  # motion that odometry misses when a rest ends (m, m, rad)
SIGMAS_STANDS: Final = (0.02, 0.02, 0.002)  # motion between cycles at rest by detections alone (m, m, rad)


class MotionCheck(Copyable):
    """Check of each cycle's odometry against the detections of the newest cycles.

    Poses are in the frame of dead reckoning, which drifts; only the newest ones are used.
    """

    def __init__(self, noise: TwistNoise, settings: MotionSettings, *, of_lines: bool = False) -> None:
        self.noise = noise
        self.seen_again: BoolArray = np.zeros(0, bool)  # (m,) `Reading.seen_again` of the newest cycle
        self.pose: Array = np.zeros(3)  # (3,) newest pose by dead reckoning; the first one is 0
        self._settings = settings
        self._twists = HeldTwists(settings)
        self._matcher, self._of_lines = ScanMatcher(settings, of_lines=of_lines), of_lines
        self._rest = Rest()
        self._standstill = Standstill()
        self._velocity: Array | None = None
        self._t: float | None = None
        self._doubted_at = -np.inf  # stamp of the last contradiction (s)

    def set_noise(self, noise: TwistNoise) -> None:
        """Set the noise of a twist, and forget the learned errors of the sensor."""
        self.noise = noise
        self._matcher.forget()
        self._standstill = Standstill()

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        may_doubt: bool | None = True,
    ) -> MeasuredMotion:
        """Return the motion since the previous cycle.

        Detections may contradict the odometry if `may_doubt`. If that is None, they are matched only where
        the odometry is missing or stuck. Points of lines cannot show a standstill.
        """
        t, matcher = detections.t, self._matcher
        motion = self._twists.integrate(odometry, t, self._t, self.noise)
        twist, delta = motion.odometry.twist, motion.odometry.delta
        seen = matcher.corrected(detections, twist)
        limit = GATE_DISTRUSTED if t - self._doubted_at < DISTRUST else self._settings.doubt
        if may_doubt is not None and not self._of_lines:
            self._standstill.add(t, seen.points, matcher.excess * detections.covariances, delta)
        standing, agrees = self._standing(motion) if may_doubt else None, None
        if standing is None:
            motion, agrees = self._checked(motion, t, seen, may_doubt, limit)
        else:
            motion = standing
        if motion.doubted:
            self._doubted_at = t
        rested = self._rest.is_at_rest
        if not motion.fault and self._rest.update(odometry, t, self.noise):
            motion = self._at_rest(motion, t, seen, limit)
        if rested and not self._rest.is_at_rest and not motion.fault:
            motion = motion.with_missed(np.array(SIGMAS_PULL_OFF), self.noise)
        self.pose = compose(self.pose, motion.odometry.delta)
        if agrees is not None and not agrees.by_lines:
            self.seen_again = agrees.is_matched
        elif may_doubt is not None:
            self.seen_again = matcher.has(seen, self.pose)
        moving = motion.odometry.twist if motion.fault else twist
        matcher.remember(detections, moving, self.pose)
        self._standstill.believe(self.pose)
        if self._t is not None and t > self._t:
            self._velocity = motion.odometry.delta / (t - self._t)
            matcher.errors.follow(self._velocity, t - self._t)
        self._t = t
        return motion

    @property
    def errors(self) -> SensorErrors:
        """Yaw and latency of the sensor, learned so far."""
        return self._matcher.errors

    @property
    def newest(self) -> Newest:
        return Newest(self._t, self._twists.newest)

    def _at_rest(self, motion: MeasuredMotion, t: float, seen: Seen, limit: float) -> MeasuredMotion:
        """Return the motion of a vehicle at rest by its odometry, unless the detections contradict that."""
        matcher, none = (
            self._matcher,
            integrated_odometry(np.zeros(3), np.diag(SIGMAS_REST) ** 2, NO_CALIBRATION),
        )
        standing = matcher.match(seen, self.pose, REACHES_CHECK)
        if standing is None or matcher.denies(standing, matcher.difference(standing, none, self.pose), limit):
            self._rest.end()
            return motion
        return MeasuredMotion(none, np.zeros((1, 3)), bias=self._rest.bias(t, self.noise))

    def _standing(self, motion: MeasuredMotion) -> MeasuredMotion | None:
        """Return the motion back to where the vehicle stands, if the cones clearly show a standstill."""
        place = self._standstill.place(self._settings.doubt)
        if place is None:
            return None
        back = relative(self.pose, place)
        covariance = np.diag(SIGMAS_STANDS) ** 2 + np.outer(back, back) * BEFORE**2
        standing = integrated_odometry(back, covariance, NO_CALIBRATION)
        return MeasuredMotion(standing, np.zeros((1, 3)), not motion.missing, motion.missing, motion.stuck)

    def _checked(
        self, motion: MeasuredMotion, t: float, seen: Seen, may_doubt: bool | None, limit: float
    ) -> tuple[MeasuredMotion, Match | None]:
        """Return the motion by odometry, or by detections if these contradict it or it is missing.

        The second value is the match that agrees with the odometry, if there is one.
        """
        unasked = may_doubt is None and not (motion.missing or motion.stuck)
        if self._t is None or t <= self._t or unasked:
            return motion, None
        matcher, odometry, dt = self._matcher, motion.odometry, t - self._t
        going_on = dt * (odometry.twist if self._velocity is None else self._velocity)
        predicted = compose(self.pose, odometry.delta)
        near = matcher.match(seen, predicted, REACHES_CHECK)
        if near is not None and not matcher.fits(near):
            near = None
        told = near is not None and near.matched >= MIN_DOUBTING
        jumped = (np.abs(odometry.delta - going_on) > np.array(SIGMAS_CHANGE) * dt).any()
        stuck = motion.stuck and not told and bool(jumped)  # no vehicle changes its velocity so
        failed = motion.missing or (stuck and self._settings.doubt < np.inf)
        if near is not None and not failed:
            difference = matcher.difference(near, odometry, predicted)
            if not matcher.denies(near, difference, limit):
                matcher.agree(near, difference, dt)
                return motion, near
        if not (may_doubt or failed):
            return motion, None
        best = self._best(seen, (compose(self.pose, going_on), predicted), dt)
        if best is not None and not failed:
            failed = matcher.denies(best, matcher.difference(best, odometry, predicted), limit)
            failed = failed and matcher.fits_better(best, predicted, seen)
        return self._replaced(motion, best, going_on, dt) if failed else motion, None

    def _best(self, seen: Seen, starts: tuple[Array, Array], dt: float) -> Match | None:
        """Return the best possible match from two initial poses; the first assumes constant velocity."""
        matches = [self._matcher.match(seen, start, REACHES) for start in starts]
        possible = [one for one in matches if one is not None and self._is_possible(one, starts[0], dt)]
        return max(possible, key=lambda one: one.matched - one.misfit, default=None)

    def _is_possible(self, matched: Match, going_on: Array, dt: float) -> bool:
        sigmas = np.array(SIGMAS_CHANGE) * dt + np.sqrt(np.diag(np.linalg.inv(matched.information)))
        change = np.abs(relative(going_on, matched.pose))
        return self._matcher.fits(matched) and bool((change < MAX_CHANGE * sigmas).all())

    def _replaced(
        self, motion: MeasuredMotion, best: Match | None, going_on: Array, dt: float
    ) -> MeasuredMotion:
        """Fuse a match with the motion `going_on` (3,) of constant velocity, in place of the odometry."""
        odometry, mean, matcher = motion.odometry, going_on.copy(), self._matcher
        covariance = np.diag((np.array(SIGMAS_CHANGE) * dt) ** 2)
        if best is not None:
            difference = matcher.difference(best, odometry, compose(self.pose, odometry.delta))
            near = DOUBT_RATE * np.sqrt(matcher.errors.covariance_of(difference)[2, 2])
            gyro_is_right = abs(difference.off[2]) <= near
            if gyro_is_right and not (motion.missing or motion.stuck):
                mean[2], covariance[2, 2] = odometry.delta[2], odometry.covariance[2, 2]
            turn = np.eye(3)  # from the frame of the check to the vehicle's
            turn[:2, :2] = rotation(best.pose[2]).T
            information = turn @ best.information @ turn.T / (WIDENED**2 * matcher.excess)
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


class HeldTwists(Copyable):
    """Integration of measured twists, each held until the next one."""

    def __init__(self, settings: MotionSettings) -> None:
        self.newest: Array | None = None  # (3,) newest measured twist
        self._t = -np.inf  # its stamp (s)
        self._interval = np.inf  # shortest time between measured twists (s)
        self._accelerations = np.array(settings.accelerations)

    def integrate(
        self, odometry: Odometry, t: float, before: float | None, noise: TwistNoise
    ) -> MeasuredMotion:
        """Integrate the twists from the previous cycle, at `before` (s), to t (s).

        The noise of a twist grows while it is held for long.
        """
        if len(odometry.t) == 0:
            none = integrate_odometry(odometry, t, noise.white)  # no motion, with certainty
            return MeasuredMotion(none, odometry.twist, missing=before is not None)
        measured = odometry.t
        goes_on = self.newest is not None and (odometry.twist[0] == self.newest).all()
        if before is not None and measured[0] <= before and goes_on:
            measured = np.concatenate([[self._t], measured[1:]])  # the first row repeats it
        self._t, self.newest = float(measured[-1]), odometry.twist[-1]
        if len(measured) > 1:
            self._interval = min(self._interval, float((measured[1:] - measured[:-1]).min()))
        ends = np.concatenate([odometry.t[1:], [t]])
        held = np.maximum(ends - measured - max(HOLD, HOLD_INTERVALS * self._interval), 0.0)
        excess, missing, durations = np.zeros(3), bool(held[-1] > 0.0), ends - odometry.t
        if missing or held.any():
            excess = held[:, None] * self._accelerations
        integrated = integrate_twists(durations, odometry.twist, np.hypot(noise.sigmas(durations), excess))
        same = (odometry.twist[1:] == odometry.twist[:-1]).all(axis=1)  # to the last digit
        stuck = bool(same.sum() >= STUCK)
        return MeasuredMotion(integrated, odometry.twist, False, missing, stuck, None, durations, excess)


class Rest(Copyable):
    """Detection of a standstill by the odometry, and the mean yaw rate during it."""

    def __init__(self) -> None:
        self.end()

    def end(self) -> None:
        self.is_at_rest = False  # whether the vehicle has been at rest for `REST_TIME`
        self._since: float | None = None
        self._sum, self._count = np.zeros(3), 0
        self._measured_since = self._rate_sum = 0.0
        self._rate_count = 0

    def update(self, odometry: Odometry, t: float, noise: TwistNoise) -> bool:
        """Whether the vehicle has been at rest for `REST_TIME` at t (s), by twists with some noise."""
        twists = odometry.twist[1:] if len(odometry.twist) > 1 else odometry.twist  # the first one is held
        moves = not len(twists) or twists[:, 0].min() > REST_TWIST[0] + REST_SIGMAS * noise.white[0]
        if moves or not _is_still(twists.mean(axis=0), noise.of_mean(len(twists), t - odometry.t[0])):
            self.end()
            return False
        if self._since is None:
            self._since = self._measured_since = float(odometry.t[0])
        self._sum, self._count = self._sum + twists.sum(axis=0), self._count + len(twists)
        self._rate_sum += float(twists[:, 2].sum())
        self._rate_count += len(twists)
        still = _is_still(self._sum / self._count, noise.of_mean(self._count, t - self._since))
        self.is_at_rest = still and t - self._since >= REST_TIME
        return self.is_at_rest

    def bias(self, t: float, noise: TwistNoise) -> BiasMeasurement | None:
        """Return the bias measured since the last result, if that is `REST_TIME` ago at t (s)."""
        if t - self._measured_since < REST_TIME:
            return None
        sigma = float(noise.of_mean(self._rate_count, t - self._measured_since)[2])
        measured = BiasMeasurement(self._rate_sum / self._rate_count, sigma)
        self._measured_since, self._rate_sum, self._rate_count = t, 0.0, 0
        return measured


def _is_still(mean: Array, sigma: Array) -> bool:
    """Whether a mean twist (3,) with a standard deviation (3,) is consistent with rest."""
    return bool((np.abs(mean) < REST_TWIST + REST_SIGMAS * sigma).all())
