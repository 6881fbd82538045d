"""One regression of the motion that the cones show on the motion that the odometry states.

Cones are static, so they alone tell the mean twist of the sensor between two cycles. With v = vx + i vy and
the yaw rate w of the odometry, `lag` seconds earlier, the regression is

    v_cones = gain v + i lever w_cones,    w_cones = rate w

where a complex gain scales, turns and exchanges vx and vy. There is no constant: a drive at constant speed
could not tell it from a factor.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import ceil, pi
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import scipy  # imports its modules lazily
from numpy.typing import NDArray

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import relative
from pathspace_graph.front_end.measurement import dead_reckoned
from pathspace_graph.front_end.motion import MATCHING
from pathspace_graph.io.log import Detections, Log, Odometry

Complex = NDArray[np.complex128]

# --- motion by the cones ---------------------------------------------------------------------------------

REACHES: Final = (1.5, 1.2, 0.9, 0.7, 0.5, 0.4, 0.4)  # reach of each step of a registration (m)
REGISTERED: Final = replace(MATCHING, min_weight=0.5)
APART: Final = 1.7  # distance of further starts of a registration (m), on rings around no motion
FURTHER: Final = [
    ring * np.array([np.cos(angle), np.sin(angle), 0.0])
    for ring in (APART, 2.0 * APART, 3.0 * APART)
    for angle in np.arange(0.0, 2.0 * pi, APART / ring)
]
MATCHED: Final = 0.4  # least share of matched detections of a motion


@dataclass(frozen=True, eq=False)
class Motions:
    """Mean twists of the sensor between two cycles, in its own frame and in the order of time."""

    begin: Array  # stamps (P,) of the earlier cycles (s)
    end: Array  # stamps (P,) of the later cycles (s)
    velocity: Complex  # vx + i vy (P,) (m/s)
    rate: Array  # yaw rate (P,) (rad/s)
    covariance: Array  # (P, 3, 3) of [vx, vy, yaw rate]
    tried: int  # number of pairs of cycles that were compared


def motions_of(
    log: Log, most: int = 1000, fewest: int = MATCHING.min_doubting, fastest: float = 30.0
) -> Motions:
    """Register nearby cycles to each other; the odometry gives only the first of several starts.

    About `most` cycles are used, in bursts of successive ones. Further starts are tried up to a speed
    `fastest` (m/s).
    """
    cycles = []  # each with its sixteen nearest detections
    for cycle in log.cycles:
        ranges = np.hypot(*cycle.points_vehicle.T)
        if len(ranges) >= fewest:
            cycles.append(cycle.where(ranges <= np.sort(ranges)[:16].max()))
    stamps = np.array([cycle.t for cycle in cycles])
    poses = dead_reckoned(log.odometry, stamps)
    # the two of a pair are at most half a second apart, unless cycles are rarer
    longest = max(0.55, 1.5 * float(np.median(np.diff(stamps)))) if len(stamps) > 1 else 0.0
    every, rows, tried = ceil(len(cycles) / most), list[Any](), 0
    for gap in (1, 2, 4):  # cycles between the two of a pair
        twist = np.zeros(3)
        for k in range(len(cycles) - gap):
            dt = float(stamps[k + gap] - stamps[k])
            if (k // 12) % every or not 0.0 < dt <= longest:
                continue
            starts = [relative(poses[k], poses[k + gap]), dt * twist, np.zeros(3)]
            share, motion, information = register(cycles[k], cycles[k + gap], starts, fastest * dt, fewest)
            tried += 1
            if share > MATCHED and np.linalg.cond(information) < 1e8:
                twist = mean_twist(motion, dt)
                rows.append([stamps[k], stamps[k + gap], *twist, *(np.linalg.inv(information) / dt**2).flat])
    table = np.array(sorted(rows, key=lambda row: row[0] + row[1])).reshape(-1, 14)
    begin, end, vx, vy, rate = table[:, :5].T
    return Motions(begin, end, vx + 1j * vy, rate, table[:, 5:].reshape(-1, 3, 3), tried)


def register(
    before: Detections, after: Detections, starts: Sequence[Array], farthest: float, fewest: int
) -> tuple[float, Array, Array]:
    """Share of matched detections, the motion (3,) and its information (3, 3) by the best start.

    A coordinate has a standard deviation of 0.15 m, as the stated one may be wrong.
    Where these starts match too little, further ones are tried, up to a distance (m).
    """
    best, variances = (0.0, np.zeros(3), np.zeros((3, 3))), np.full(len(after.labels), 0.15**2)
    further = (far for far in FURTHER if np.hypot(*far[:2]) < farthest)
    for k, start in enumerate(chain(starts, further)):
        if best[0] > (0.75 if k < len(starts) else MATCHED):
            break
        motion, information, matched, *_ = kernels.matched(
            before.points_vehicle, after.points_vehicle, variances, start, REACHES, REGISTERED
        )
        share = float(matched.sum()) / min(len(before.labels), len(after.labels))
        if matched.sum() >= fewest and share > best[0] + 0.1 * (best[0] > 0.0):
            best = share, motion, information
    return best


def mean_twist(motion: Array, dt: float) -> Array:
    """Constant twist (3,) of a motion (3,) in a time dt (s)."""
    turn = motion[2]
    way = (motion[0] + 1j * motion[1]) * np.exp(-0.5j * turn) / np.sinc(turn / (2.0 * pi))
    return np.array([way.real, way.imag, turn]) / dt


# --- regression ------------------------------------------------------------------------------------------

Content = Literal["twist", "fixed", "pose"]
CONTENTS: Final[tuple[Content, ...]] = ("twist", "fixed", "pose")
LAGS: Final[list[float]] = np.arange(-10.0, 10.01, 0.25).tolist()  # candidate lags (s)
WIDE: Final = 2.0  # sigmas at which a motion counts as explained by `exp(-1/2)`
STEPS: Final = 6  # steps of reweighting
LAG_STEP: Final = 0.05  # half the difference that approximates a derivative by the lag (s)


@dataclass(frozen=True)
class Fit:
    """Factors of the regression; the defaults are those of a good log."""

    content: Content = "twist"
    """What the odometry has: the body twist, one along the axes of a fixed frame, or a pose. Only the speed
    of the last two counts, so any heading at the start is as good."""
    lag: float = 0.0  # time by which the stamps of the detections are too late (s)
    gain: complex = 1.0
    rate: float = 1.0
    lever: complex = 0.0  # place of the sensor, x + i y (m)
    sigmas: tuple[float, float] = (np.inf, np.inf)  # standard deviations of gain and lever


class Shares(NamedTuple):
    """To what degree (P,), from 0 to 1, each motion is explained."""

    way: Array
    turn: Array
    both: Array


class Better(NamedTuple):
    """How much more of the motions one reading explains than another."""

    gain: float  # sum of the differences of their shares
    words: str


def far_better(one: Array, other: Array) -> Better | None:
    """Compare explained shares (P,) where they differ; None unless `one` is clearly better."""
    difference = one - other
    telling = np.abs(difference) > 0.2
    if not telling.any():
        return None
    share, less = float(one[telling].mean()), float(other[telling].mean())
    chance = float(scipy.special.bdtrc(int((difference[telling] > 0.0).sum()) - 1, int(telling.sum()), 0.5))
    # by a sign test it is no chance, and it explains much more, and enough
    if chance > 1e-10 or share < max(1.8 * less, 0.3):
        return None
    words = f"{100.0 * less:.0f} % of the cones' motions, {100.0 * share:.0f} % with the likely cause"
    return Better(float(difference.sum()), f"the odometry explains {words}")


class Regression:
    """Regression of the motions of the cones on the odometry."""

    def __init__(self, odometry: Odometry, motions: Motions) -> None:
        self.motions, self._t = motions, odometry.t
        v, w = odometry.twist[:, 0] + 1j * odometry.twist[:, 1], odometry.twist[:, 2]
        period = 2.0 * pi if np.abs(w).max() < 4.0 * pi else 360.0
        way, path, turn = (
            np.append(0.0, np.cumsum(one[:-1] * np.diff(odometry.t))) for one in (v, np.abs(v), w)
        )
        self._sums = {"twist": (way, turn), "fixed": (path, turn), "pose": (v, np.unwrap(w, period=period))}
        sizes = np.abs([motions.velocity, motions.velocity, motions.rate]).T
        added = np.array([0.3, 0.3, 0.05]) + 0.08 * sizes  # standard deviations (m/s, m/s, rad/s)
        self._variance = variance = motions.covariance + np.square(added)[:, None] * np.eye(3)
        self._information, self._of_way = np.linalg.inv(variance), np.linalg.inv(variance[:, :2, :2])

    def stated(self, content: Content, lag: float) -> tuple[Complex, Array]:
        """Mean velocities and yaw rates (P,) that the odometry states for the motions."""
        begin, end = self.motions.begin - lag, self.motions.end - lag
        way, turn = (
            (np.interp(end, self._t, one) - np.interp(begin, self._t, one)) / (end - begin)
            for one in self._sums[content]
        )
        return np.asarray(np.abs(way) if content == "pose" else way, complex), turn

    def predicted(self, fit: Fit) -> tuple[Complex, Array]:
        v, w = self.stated(fit.content, fit.lag)
        return fit.gain * v + 1j * fit.lever * fit.rate * w, fit.rate * w

    def odometry(self, fit: Fit) -> Odometry:
        """Odometry that a fit takes for that of the sensor."""
        way, turn = (np.gradient(one, self._t) for one in self._sums[fit.content])
        v = fit.gain * (np.abs(way) if fit.content == "pose" else way)
        return Odometry(self._t + fit.lag, np.column_stack([v.real, v.imag, fit.rate * turn]))

    def explained(self, fit: Fit) -> Shares:
        return self.shares(*self.predicted(fit))

    def shares(self, v: Complex, w: Array) -> Shares:
        """Degrees to which velocities and yaw rates (P,) explain the motions."""
        off = self._off(v, w)
        way = np.einsum("pi,pij,pj->p", off[:, :2], self._of_way, off[:, :2])
        both = np.einsum("pi,pij,pj->p", off, self._information, off)
        squares = way, off[:, 2] ** 2 / self._variance[:, 2, 2], both
        return Shares(*(np.exp(-0.5 * square / WIDE**2) for square in squares))

    def _off(self, v: Complex, w: Array) -> Array:
        off = self.motions.velocity - v
        return np.column_stack([off.real, off.imag, self.motions.rate - w])

    def fit(self, content: Content, lag: float) -> Fit:
        """Fit rate, gain and lever by least squares with Cauchy's weights."""
        v, w = self.stated(content, lag)
        (rate,), _ = self._fitted(w[:, None], self.motions.rate, self._variance[:, 2, 2])
        columns = np.column_stack([v, 1j * rate * w])
        variance = 0.5 * np.trace(self._variance[:, :2, :2], axis1=1, axis2=2)
        (gain, lever), sigmas = self._fitted(columns, self.motions.velocity, variance)
        return Fit(
            content, lag, complex(gain), float(rate), complex(lever), (float(sigmas[0]), float(sigmas[1]))
        )

    @staticmethod
    def _fitted(columns: NDArray[Any], values: NDArray[Any], variance: Array) -> tuple[NDArray[Any], Array]:
        large = np.abs(columns[:, 0]) >= np.median(np.abs(columns[:, 0]))
        ratio = values[large] / (columns[large, 0] + 1e-9)
        off = values - (np.median(ratio.real) + 1j * np.median(ratio.imag)) * columns[:, 0]
        for _ in range(STEPS):
            weight = 1.0 / (variance + np.abs(off) ** 2)
            weighted = columns.conj().T * weight
            inverse = np.linalg.inv(weighted @ columns + 1e-9 * np.eye(columns.shape[1]))
            factors = inverse @ (weighted @ values)
            off = values - columns @ factors
        scores = in_blocks((weighted * off).T)
        return factors, np.sqrt(np.abs(np.diag(inverse @ (scores.T @ scores.conj()) @ inverse)))

    def best(self) -> tuple[Fit, dict[str, Better]]:
        """Simplest fit that no other explains far more than, with a refined lag.

        It comes with the reasons why its `content` and its `lag` are not those of a good log.
        """
        fits = {(content, lag): self.fit(content, lag) for content in CONTENTS for lag in LAGS}
        shares = {key: self.explained(fit).both for key, fit in fits.items()}
        worth = {key: float(share.mean()) - 0.002 * abs(key[1]) for key, share in shares.items()}
        latest = {content: max(LAGS, key=lambda lag: worth[content, lag]) for content in CONTENTS}
        best: tuple[Content, float] = "twist", 0.0
        for one in ((content, lag) for content in CONTENTS for lag in (0.0, latest[content])):
            # a gain of 5 makes the speeds of a fixed frame of mere noise
            possible = one[0] == "twist" or abs(fits[one].gain) < 5.0
            best = one if possible and far_better(shares[one], shares[best]) else best
        why = {
            "content": far_better(shares[best], shares["twist", latest["twist"]]),
            "lag": far_better(shares[best], shares[best[0], 0.0]),
        }
        fit = fits[best]
        fit = self.fit(fit.content, fit.lag + self.lag(fit)[0]) if fit.lag else fit
        return fit, {name: better for name, better in why.items() if better}

    def lag(self, fit: Fit) -> tuple[float, float]:
        """How much later than by a fit the stamps of the detections are (s), and its sigma."""
        total, information = 0.0, self._information
        for _ in range(STEPS):
            lags = fit.lag + total + LAG_STEP * np.array([-1.0, 0.0, 1.0])
            before, off, after = (self._off(*self.predicted(replace(fit, lag=lag))) for lag in lags.tolist())
            slope = (before - after) / (2.0 * LAG_STEP)
            weight = 1.0 / (1.0 + np.einsum("pi,pij,pj->p", off, information, off) / WIDE**2)
            weighted = np.einsum("p,pij,pj->pi", weight, information, slope)
            scores, curvature = (weighted * off).sum(axis=1), max(float((weighted * slope).sum()), 1e-12)
            total += float(np.clip(scores.sum() / curvature, -LAG_STEP, LAG_STEP))
        return total, float(np.linalg.norm(in_blocks(scores))) / curvature

    def jump(self, fit: Fit) -> tuple[float, float, float, Array, Array]:
        """When the lag jumps, the lags before and after (s), and the shares (P,) that are explained.

        The last shares are those by one of both lags alone, the better one.
        """
        lags = LAGS
        for _ in range(2):  # first among all lags, then near the two
            shares = np.stack([self.explained(replace(fit, lag=lag)).both for lag in lags])
            sums = shares.cumsum(axis=1)
            rest = sums[:, -1:] - sums
            k = int((sums.max(axis=0) + rest.max(axis=0)).argmax())
            first, second = int(sums[:, k].argmax()), int(rest[:, k].argmax())
            when, before, after = float(self.motions.end[k]), lags[first], lags[second]
            jumping = np.append(shares[first, : k + 1], shares[second, k + 1 :])
            constant = shares[max(first, second, key=lambda lag: sums[lag, -1])]
            lags = sorted(
                {lag + off for lag in (before, after) for off in np.linspace(-0.25, 0.25, 11).tolist()}
            )
        return when, before, after, jumping, constant


def in_blocks(scores: NDArray[Any]) -> NDArray[Any]:
    """Add up rows (P, ...) of a dozen successive motions, which share cycles."""
    return np.asarray(np.add.reduceat(scores, np.arange(0, len(scores), 12)))
