"""The motion of a cycle by the formulas in NumPy: likelihood, hypotheses, and what it tells of the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.noise import TwistNoise, huber_weights
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.se2 import compose, left_of, relative, rotation, to_map, to_vehicle
from pathspace_graph.factors.sensor import SENSOR, by_sensor
from pathspace_graph.front_end.motion import MATCHING, MotionCheck
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.settings.mapper import MotionSettings

from ..scenes.drives import detections

Array = NDArray[np.float64]
SIGMA = np.array([0.1, 0.1, 0.01])
MEMORY = 0.65
REACHES = 0.4 ** (np.arange(6) / 5.0)
CHANGE = np.array([3.0, 1.0, 0.5])
"""The velocity changes by so much in a second without odometry (m/s^2, m/s^2, rad/s^2)."""
POSSIBLE = 0.5 * MEMORY * np.array(MotionSettings.accelerations)
ERRORS = [SENSOR.index("yaw"), SENSOR.index("latency")]


class Match(NamedTuple):
    pose: Array
    information: Array
    matched: NDArray[np.bool_]
    misfit: float


def about(pose: Array) -> Array:
    """The turn (3, 3) of a pose."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(pose[2])
    return turn


class Formulas:
    """The check for cones of a vehicle that never stands."""

    def __init__(self) -> None:
        self.pose, self.t, self.velocity, self.doubted_at, self.misfit = np.zeros(3), 0.0, None, -np.inf, 1.0
        self.errors, self.covariance = np.zeros(2), np.diag([0.02, 0.05]) ** 2
        self.mean_velocity, self.remembered, self.doubt = np.zeros(3), [], MotionSettings.doubt

    def beside(self, points: Array, pose: Array, reach: float) -> tuple[Array, Array, Array]:
        """Places (m, 2) of detections, their offsets from earlier ones, and the sums of weights (m,)."""
        placed = to_map(points, pose[None])
        squares = ((placed[:, None] - self.earlier) ** 2).sum(axis=2) / reach**2
        weights = np.where(squares < MATCHING.farthest**2, np.exp(-0.5 * squares), 0.0)
        totals = np.maximum(weights.sum(axis=1), np.finfo(float).tiny)
        return placed, placed - weights @ self.earlier / totals[:, None], totals

    def match(self, points: Array, variances: Array, start: Array, reaches: Array) -> Match | None:
        pose = start
        for reach in reaches:
            placed, off, weights = self.beside(points, pose, reach)
            matched = weights > MATCHING.min_weight
            if matched.sum() < MATCHING.min_matched:
                return None
            size = np.hypot(*off[matched].T)
            precision = 1.0 / (variances * (1.0 + 1.0 / weights) + MATCHING.sigma_cone**2)[matched]
            precision = precision * huber_weights(size * np.sqrt(precision), MATCHING.huber)
            arms = left_of(placed - pose[:2])[matched]
            jacobian = np.concatenate([np.tile(np.eye(2), (len(arms), 1, 1)), arms[:, :, None]], axis=2)
            information = np.einsum("mik,m,mil->kl", jacobian, precision, jacobian)
            gradient = np.einsum("mik,m,mi->k", jacobian, precision, off[matched])
            regular = information + np.diag(MATCHING.least_share * information.diagonal())
            pose = pose - np.linalg.solve(regular, gradient)
        if np.linalg.det(information) <= MATCHING.least_share * information.diagonal().prod():
            return None
        return Match(pose, information, matched, float((precision * size**2).mean()))

    def misfit_at(self, points: Array, variances: Array, pose: Array) -> float:
        _, off, weights = self.beside(points, pose, 0.4)
        squares = (off**2).sum(axis=1) / (variances * (1.0 + 1.0 / weights) + MATCHING.sigma_cone**2)
        most = MATCHING.most_misfit
        return float(np.where(weights > MATCHING.min_weight, np.minimum(squares, most), most).mean())

    def difference(
        self, found: Match, motion: IntegratedOdometry, predicted: Array, excess: float
    ) -> tuple[Array, Array, Array]:
        """Offset of a match from the odometry, covariance for a sensor without errors, and derivatives."""
        turn = about(predicted)
        off = turn.T @ (found.pose - predicted)
        covariance = excess * turn.T @ np.linalg.inv(found.information) @ turn + motion.covariance
        seen_from = np.concatenate([np.tile(pose[:2], (len(z), 1)) for _, pose, z, _ in self.remembered])
        ahead, left = turn[:2, :2].T @ (predicted[:2] - seen_from.mean(axis=0))
        late = np.clip(self.mean_velocity - motion.twist, -POSSIBLE, POSSIBLE)
        return off, covariance, np.column_stack([[left, -ahead, 0.0], late])

    def update(self, odometry: Odometry, cycle: Detections) -> tuple[str, Array, Array, NDArray[np.bool_]]:
        """The outcome, the motion (3,), its covariance (3, 3), and which detections were seen before."""
        durations = np.diff(np.append(odometry.t, cycle.t))
        motion = integrate_twists(durations, odometry.twist, SIGMA)
        self.remembered = [one for one in self.remembered if one[0] > cycle.t - MEMORY]
        self.earlier = np.concatenate(
            [np.zeros((0, 2))]
            + [to_map(self.corrected(z, twist), pose[None]) for _, pose, z, twist in self.remembered]
        )
        points = self.corrected(cycle.points_vehicle, motion.twist)
        outcome, delta, covariance, twist = self.likeliest(odometry, motion, points, cycle)
        self.pose, dt = compose(self.pose, delta), cycle.t - self.t
        again = self.beside(points, self.pose, 0.4)[2] > MATCHING.min_weight
        self.remembered.append((cycle.t, self.pose, cycle.points_vehicle, twist))
        if self.t > 0.0:
            self.velocity = delta / dt
            self.mean_velocity = self.mean_velocity + min(dt / (0.5 * MEMORY), 1.0) * (
                self.velocity - self.mean_velocity
            )
        self.t = cycle.t
        return outcome, delta, covariance, again

    def corrected(self, z: Array, twist: Array) -> Array:
        return z + by_sensor(z, twist[None])[:, :, ERRORS] @ self.errors

    def learn(self, off: Array, covariance: Array, shifts: Array, dt: float) -> None:
        """The Kalman update of the errors, of which a match tells as much as its share of the memory."""
        prior = np.linalg.inv(self.covariance + dt / 60.0 * np.diag([0.001, 0.005]) ** 2)
        gain = min(dt / MEMORY, 1.0) * shifts.T @ np.linalg.inv(covariance)
        self.covariance = np.linalg.inv(prior + gain @ shifts)
        self.errors = self.errors + self.covariance @ gain @ off

    def best(
        self, points: Array, variances: Array, starts: tuple[Array, Array], dt: float, excess: float
    ) -> Match | None:
        """The possible match that fits best, from the poses by constant velocity and by the odometry."""
        possible = []
        for start in starts:
            found = self.match(points, variances, start, REACHES)
            if found is not None and found.misfit < 3.0 * excess:
                turn = about(found.pose)
                sigmas = np.sqrt(np.linalg.inv(turn.T @ found.information @ turn).diagonal())
                if (np.abs(relative(starts[0], found.pose)) < 3.5 * (CHANGE * dt + sigmas)).all():
                    possible.append(found)
        return max(possible, key=lambda one: one.matched.sum() - one.misfit, default=None)

    def likeliest(
        self, odometry: Odometry, motion: IntegratedOdometry, points: Array, cycle: Detections
    ) -> tuple[str, Array, Array, Array]:
        """The outcome, motion, covariance and mean twist by the hypotheses in their order."""
        as_measured = motion.delta, motion.covariance, motion.twist
        missing, dt = len(odometry.t) == 0, cycle.t - self.t
        if self.t == 0.0:
            return "first", *as_measured
        variances = 0.5 * np.trace(cycle.covariances, axis1=1, axis2=2)
        excess = max(self.misfit / MATCHING.large_misfit, 1.0)
        limit = 3.8 if cycle.t - self.doubted_at < 12.0 else self.doubt
        going_on = dt * (motion.twist if self.velocity is None else self.velocity)
        predicted, start = compose(self.pose, motion.delta), compose(self.pose, going_on)
        near = self.match(points, variances, predicted, np.array([1.0, 0.4]))
        if near is not None and near.misfit >= 3.0 * excess:
            near = None
        stuck = len(odometry.t) > 1 and (np.diff(odometry.twist, axis=0) == 0.0).all(axis=1).sum() >= 3
        held = near is not None and near.matched.sum() >= MATCHING.min_doubting
        jumped = (np.abs(motion.delta - going_on) > CHANGE * dt).any()
        failed = missing or (stuck and jumped and not held)
        if near is not None and not failed:
            off, covariance, shifts = self.difference(near, motion, predicted, excess)
            spread = covariance + shifts @ self.covariance @ shifts.T
            if not held or off @ np.linalg.solve(spread, off) <= limit**2:
                self.misfit += MATCHING.misfit_gain * (near.misfit - self.misfit)
                self.learn(off, covariance, shifts, dt)
                return "agrees", *as_measured
        best = self.best(points, variances, (start, predicted), dt, excess)
        if best is None and not failed:
            return "nothing matches", *as_measured
        mean, covariance, outcome = going_on, np.diag(CHANGE * dt) ** 2, "constant velocity"
        if best is not None:
            off, own, shifts = self.difference(best, motion, predicted, excess)
            spread = own + shifts @ self.covariance @ shifts.T
            if not failed:
                seen = points[best.matched], variances[best.matched]
                worse, fit = self.misfit_at(*seen, predicted), self.misfit_at(*seen, best.pose)
                few = best.matched.sum() < MATCHING.min_doubting
                if few or off @ np.linalg.solve(spread, off) <= limit**2 or worse <= max(2.0, 1.3 * fit):
                    return "no better", *as_measured
            mean = mean.copy()
            if abs(off[2]) <= 2.0 * np.sqrt(spread[2, 2]) and not (missing or stuck):
                mean[2], covariance[2, 2] = motion.delta[2], motion.covariance[2, 2]
            turn, prior = about(best.pose), np.linalg.inv(covariance)
            information = turn.T @ best.information @ turn / (1.5**2 * excess)
            covariance = np.linalg.inv(information + prior)
            mean = covariance @ (information @ relative(self.pose, best.pose) + prior @ mean)
            begun = (0.0 if missing else 0.5) * (mean - motion.delta)
            covariance, outcome = covariance + np.outer(begun, begun), "replaced"
        self.doubted_at = self.doubted_at if missing else cycle.t
        return f"{outcome}{', missing' * missing}", mean, covariance, mean / dt


def test_random_drives_have_the_motions_of_the_formulas() -> None:
    """Odometry is right, too fast, stuck at zero or missing; in the end, some vehicles are put down."""
    outcomes = set[str]()
    for seed in range(30):
        rng = np.random.default_rng(seed)
        cones = np.column_stack([rng.uniform(-2.0, 16.0, 14), rng.uniform(-6.0, 6.0, 14)])
        check, formulas, true = MotionCheck(TwistNoise(SIGMA), MotionSettings()), Formulas(), np.zeros(3)
        for k in range(1, 10):
            twist = np.array([rng.uniform(4.0, 7.0), rng.uniform(-0.3, 0.3), rng.uniform(-0.6, 0.6)])
            true = compose(true, 0.1 * twist)
            if k == 9 and seed % 2:
                true = compose(true, rng.uniform([0.5, -1.5, -0.3], [3.0, 1.5, 0.3]))
            factor = 1.0 if k < 4 else rng.choice([1.0, 1.4, 2.5, 0.0, np.nan])
            stamps = 0.1 * (k - 1) + 0.025 * np.arange(0 if np.isnan(factor) else 4)
            read = factor * (twist + SIGMA * rng.standard_normal((len(stamps), 3)))
            seen = to_vehicle(cones, np.tile(true, (14, 1))) + 0.08 * rng.standard_normal((14, 2))
            seen = seen[(seen[:, 0] > 0.0) & (rng.random(14) < 0.9)]
            cycle = detections(0.1 * k, seen, np.zeros(len(seen), np.intp))
            motion = check.update(Odometry(stamps, read), cycle)
            outcome, delta, covariance, again = formulas.update(Odometry(stamps, read), cycle)
            outcomes.add(outcome)
            assert motion.missing == (len(stamps) == 0), (seed, k, outcome)
            is_other = outcome.startswith(("replaced", "constant"))
            assert motion.doubted == (is_other and not motion.missing), (seed, k, outcome)
            np.testing.assert_allclose(motion.odometry.delta, delta, atol=1e-9)
            np.testing.assert_allclose(motion.odometry.covariance, covariance, rtol=1e-6, atol=1e-12)
            assert motion.odometry.calibration_jacobian.any() == (not is_other and not motion.missing)
            np.testing.assert_array_equal(check.seen_again, again)
            np.testing.assert_allclose(check.errors.mean, formulas.errors, atol=1e-10)
            np.testing.assert_allclose(check.errors.covariance, formulas.covariance, rtol=1e-7)
    assert outcomes >= {
        "agrees",
        "replaced",
        "replaced, missing",
        "constant velocity, missing",
        "no better",
        "nothing matches",
    }
