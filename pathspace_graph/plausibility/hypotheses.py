"""Hypotheses about a log: the frame of its detections, and the meaning of its odometry.

Cones are static, so the likeliest hypothesis is the one under which most detections of nearby cycles
coincide.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, Self

import numpy as np
import scipy  # imports its modules lazily

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.factors.se2 import left_of, rotation, rotations, to_vehicle
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT, UNKNOWN

# --- pairs of cycles -------------------------------------------------------------------------------------

LEAST_COMPARED: Final = 2  # least number of detections of a compared cycle
MOST_COMPARED: Final = 14  # largest number of compared detections of a cycle, the nearest ones
SOME_CYCLES: Final = 200  # approximate number of cycles in the spacing of the cones
PAIR_GAPS: Final = (1, 2, 4, 8)  # steps in cycles between the two of a pair
PAIRS_OF_GAP: Final = 60  # approximate number of pairs for each step
LONGEST_PAIR: Final = 1.3  # longest time between the cycles of a pair (s), unless cycles are rarer
EXPLAINED_REACH: Final = 0.2  # distance with a weight of `exp(-1/2)`, over the spacing of the cones
VIEW_QUANTILE: Final = 0.95  # quantile of ranges and bearings that bounds the view of a cycle
ROUND_VIEW: Final = 0.1  # length of the mean direction to detections below which the view is all around


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of cycles; detections are in the frame of the log, padded with NaN."""

    begin: Array  # stamps (P,) of the earlier cycles (s)
    end: Array  # stamps (P,) of the later cycles (s)
    before: Array  # detections (P, m, 2) of the earlier cycles (m)
    after: Array  # detections (P, m, 2) of the later cycles (m)
    variances: Array  # variances (P, m, m) of one coordinate of each difference of two detections (m^2)
    gap: IntArray  # number (P,) of cycles from the earlier to the later one
    reach: float  # scale of the weight `exp(-d^2 / 2 reach^2)` of two detections at distance d (m)

    def __len__(self) -> int:
        return len(self.begin)

    def distances(self, frame: Array, motion: Array) -> Array:
        """Return the squared distances (m, m, P) of earlier from later detections; infinite for padding.

        `frame` (2, 2) rotates from the log's frame to the vehicle's. `motion` (P, 3) is the later pose in the
        earlier vehicle frame.
        """
        before, after = self.before @ frame.T, self.laid(frame, motion)
        # the pairs last, and contiguous, as there are far more of them than detections in a cycle
        x, y = np.ascontiguousarray(np.nan_to_num(before, nan=np.inf).T)
        u, v = np.ascontiguousarray(np.nan_to_num(after, nan=-np.inf).T)
        return np.asarray((x[:, None] - u) ** 2 + (y[:, None] - v) ** 2)

    def laid(self, frame: Array, motion: Array) -> Array:
        """Return the later detections (P, m, 2) in the earlier vehicle frame."""
        turn = rotations(motion[:, 2]).transpose(0, 2, 1)  # for points in rows
        return np.asarray((self.after @ frame.T) @ turn + motion[:, None, :2])

    def explained(self, frame: Array, motion: Array) -> Array:
        """Return the weighted share (P,) of detections that coincide with one of the other cycle."""
        square = self.distances(frame, motion)
        nearest = np.concatenate([square.min(axis=0), square.min(axis=1)])
        weights = np.exp(nearest / (-2.0 * self.reach**2))
        return np.asarray(weights.sum(axis=0) / np.maximum(self.count, 1))

    def chosen(self, rows: BoolArray) -> Self:
        arrays = {name: value[rows] for name, value in vars(self).items() if name != "reach"}
        return replace(self, **arrays)

    def overlap(self, motion: Array) -> Array:
        """Return the share (P,) of the later detections that are in view of the earlier cycle."""
        seen, again = (points @ [1.0, 1j] for points in (self.before, self.laid(np.eye(2), motion)))
        vector = np.nanmean(np.exp(1j * np.angle(seen)))
        back = vector.conjugate() if abs(vector) > ROUND_VIEW else 1.0  # turns the middle of the view ahead
        farthest = np.nanquantile(np.abs(seen), VIEW_QUANTILE)
        widest = np.nanquantile(np.abs(np.angle(seen * back)), VIEW_QUANTILE)
        inside = (np.abs(again) < farthest) & (np.abs(np.angle(again * back)) < widest)
        return np.asarray(inside.sum(axis=1) / np.isfinite(again).sum(axis=1))

    @property
    def count(self) -> IntArray:
        before, after = (np.isfinite(points[..., 0]).sum(axis=1) for points in (self.before, self.after))
        return np.asarray(before + after)


def pairs_of(cycles: Sequence[Detections]) -> Pairs | None:
    """Return pairs of cycles spread over a log, or None without such pairs."""
    full = [cycle for cycle in cycles if len(cycle.labels) >= LEAST_COMPARED]
    spacing = spacing_of(full[:: max(1, len(full) // SOME_CYCLES)])
    if spacing is None or len(full) < 2:
        return None
    stamps, pairs = np.array([cycle.t for cycle in full]), []
    longest = max(LONGEST_PAIR, 1.5 * float(np.median(np.diff(stamps))))
    for gap in PAIR_GAPS:
        later = np.arange(gap, len(full))
        later = later[stamps[later] - stamps[later - gap] <= longest]
        chosen = later[:: max(1, len(later) // PAIRS_OF_GAP)]
        pairs.append([chosen - gap, chosen, np.full(len(chosen), gap)])
    first, second, gaps = np.concatenate(pairs, axis=1)
    if len(first) == 0:
        return None
    points, variances = _padded([full[k] for k in np.concatenate([first, second]).tolist()])
    (before, after), (early, late) = np.split(points, 2), np.split(variances, 2)
    both = early[:, :, None] + late[:, None]
    return Pairs(stamps[first], stamps[second], before, after, both, gaps, EXPLAINED_REACH * spacing)


def _padded(cycles: Sequence[Detections]) -> tuple[Array, Array]:
    """Return the nearest detections (C, m, 2) of each cycle and their variances (C, m), padded with NaN."""
    variances = np.full((len(cycles), MOST_COMPARED), np.nan)
    points = np.stack([variances, variances], axis=2)
    for k, cycle in enumerate(cycles):
        nearest = np.argsort(np.hypot(*cycle.points_vehicle.T), kind="stable")[:MOST_COMPARED]
        points[k, : len(nearest)] = cycle.points_vehicle[nearest]
        variances[k, : len(nearest)] = 0.5 * np.trace(cycle.covariances[nearest], axis1=1, axis2=2)
    return points, variances


def spacing_of(cycles: Sequence[Detections]) -> float | None:
    """Return the median distance from a detection to the nearest one elsewhere in its cycle, if any."""
    found = []
    for cycle in cycles:
        off = cycle.points_vehicle[:, None] - cycle.points_vehicle  # which may be infinite
        square = (off * off).sum(axis=-1)
        square[square == 0.0] = np.inf  # itself, or a repetition
        found.append(np.sqrt(square.min(axis=1)))
    spacing = float(np.median(np.concatenate(found))) if found else np.inf
    return spacing if spacing < np.inf else None


def motions(odometry_t: Array, poses: Array, begin: Array, end: Array) -> Array:
    """Interpolate poses (N, 3) at stamps (P,); return the motions (P, 3) from `begin` to `end`."""
    first, last = (np.column_stack([np.interp(t, odometry_t, one) for one in poses.T]) for t in (begin, end))
    return np.column_stack([to_vehicle(last[:, :2], first), last[:, 2] - first[:, 2]])


# --- meanings of the columns -----------------------------------------------------------------------------

TURN_STEP: Final = 15.0  # step of the candidate angles of the detections' frame (degrees)
EQUAL_SHARES: Final = 0.02  # difference of explained shares below which hypotheses are equally good
SIDED_BETTER: Final = 0.2  # difference of label shares that decides between equally good hypotheses
TELLING_PAIR: Final = 0.2  # difference of explained shares from which a pair discriminates two hypotheses
WON_BY_CHANCE: Final = 1e-8  # largest p-value of an accepted hypothesis (sign test)
FAR_BETTER: Final = 1.8  # least ratio of its explained share to that of the log as written
LEAST_EXPLAINED: Final = 0.3  # least explained share of an accepted hypothesis
MOUNTING_STEPS: Final = 5  # Gauss-Newton steps for the mounting of the sensor
LEAST_MATCHES: Final = 60  # least number of matched detections for the mounting
WORST_CONDITION: Final = 1e6  # largest condition number for the mounting
LATEST_STAMPS: Final = 10.0  # largest candidate delay or lead of detections (s)
LATE_STEP: Final = 0.25  # step of the candidates (s)
DEGREE: Final = float(np.pi / 180.0)  # degree in radians
Content = Literal["twist", "twist in the map frame", "pose", "nothing"]


@dataclass(frozen=True)
class Hypothesis:
    """Meaning of the columns of a log."""

    content: Content = "twist"  # content of the odometry; `nothing` is a vehicle at rest
    speed: float = 1.0  # unit of the speeds (m/s)
    rate: float = 1.0  # unit of the yaw rate (rad/s)
    turn: float = 0.0  # rotation of the detections' frame in the vehicle's, positive to the left (degrees)
    mirrored: bool = False  # whether that frame is left-handed
    late: float = 0.0  # excess of the stamps of the detections (s)

    @property
    def stands(self) -> tuple[float, bool]:
        return self.turn, self.mirrored

    @property
    def frame(self) -> Array:
        return rotation(self.turn * DEGREE) @ np.diag([1.0, -1.0 if self.mirrored else 1.0])

    def poses(self, odometry: Odometry) -> Array:
        """Integrate the odometry to poses (N, 3) at its stamps; theta is not wrapped."""
        measured = odometry.twist * [self.speed, self.speed, self.rate]
        if self.content == "pose":
            return np.column_stack([measured[:, :2], np.unwrap(measured[:, 2])])
        if self.content == "nothing":
            return np.zeros_like(measured)
        durations, held = np.diff(odometry.t), measured[:-1]
        is_twist = self.content == "twist"
        moved = integrate_poses(durations, held) if is_twist else np.cumsum(held * durations[:, None], axis=0)
        return np.concatenate([np.zeros((1, 3)), moved])


SPEED_UNITS: Final = {  # words for units of the speeds, by size in m/s
    1.0 / 3.6: "are in km/h, not in m/s",
    0.44704: "are in miles per hour, not in m/s",
    0.514444: "are in knots, not in m/s",
    1e-2: "are in cm/s, not in m/s",
    1e-3: "are in mm/s, not in m/s",
    3.6: "were divided by 3.6 although they were in m/s",
    1e3: "were divided by 1000 although they were in m/s",
}
RATE_UNITS: Final = {  # words for units of the yaw rate, by size in rad/s
    DEGREE: "is in degrees per second, not in rad/s",
    1.0 / DEGREE: "was converted from degrees to radians although it was in rad/s",
}
AS_WRITTEN: Final = Hypothesis()  # the log conforms to the format
MEANINGS: Final = (  # candidate meanings of the odometry; of equally good ones the first wins
    AS_WRITTEN,
    Hypothesis("nothing"),
    *(Hypothesis(rate=rate) for rate in RATE_UNITS),
    *(Hypothesis(speed=speed) for speed in SPEED_UNITS),
    *(Hypothesis(speed=speed, rate=DEGREE) for speed in (1.0 / 3.6, 1e-2, 1e-3)),
    Hypothesis("twist in the map frame"),
    Hypothesis("twist in the map frame", rate=DEGREE),
    Hypothesis("pose"),
    Hypothesis("pose", rate=DEGREE),
    Hypothesis(speed=1e-3, rate=1e-3),
)


@dataclass(frozen=True, eq=False)
class Trial:
    """Fit of a hypothesis to the pairs of cycles."""

    hypothesis: Hypothesis
    explained: Array  # explained share (P,) of the detections of each pair
    sided: float = 0.0  # share of the labelled detections on the side of their label

    @property
    def share(self) -> float:
        return float(self.explained.mean())


def far_better(trial: Trial, reference: Trial) -> dict[str, float] | None:
    """Return the explained shares (%) on discriminating pairs; None unless the trial is clearly better."""
    gain = trial.explained - reference.explained
    telling: BoolArray = np.abs(gain) > TELLING_PAIR
    if not telling.any():
        return None
    share, as_written = (float(one.explained[telling].mean()) for one in (trial, reference))
    chance = float(scipy.special.bdtrc(int((gain[telling] > 0.0).sum()) - 1, int(telling.sum()), 0.5))
    clear = chance < WON_BY_CHANCE and share > FAR_BETTER * as_written and share > LEAST_EXPLAINED
    return {"as_written": 100.0 * as_written, "share": 100.0 * share} if clear else None


class Trials:
    """Evaluation of hypotheses on the pairs of cycles of a log."""

    def __init__(self, log: Log, pairs: Pairs) -> None:
        self.log, self.pairs = log, pairs
        self._poses: dict[Hypothesis, Array] = {}  # of the newest meaning of the odometry

    def motion(self, hypothesis: Hypothesis) -> Array:
        """Return the motion (P, 3) of the vehicle from the earlier to the later cycle of each pair."""
        odometry, pairs = self.log.odometry, self.pairs
        meaning = replace(hypothesis, turn=0.0, mirrored=False, late=0.0)
        if meaning not in self._poses:
            self._poses = {meaning: meaning.poses(odometry)}  # one: trials of a meaning follow each other
        begin, end = pairs.begin - hypothesis.late, pairs.end - hypothesis.late
        return motions(odometry.t, self._poses[meaning], begin, end)

    def trial(self, hypothesis: Hypothesis) -> Trial:
        explained = self.pairs.explained(hypothesis.frame, self.motion(hypothesis))
        return Trial(hypothesis, explained, self.sided(hypothesis.frame))

    @cached_property
    def as_written(self) -> Trial:
        return self.trial(AS_WRITTEN)

    def best(self) -> Trial:
        """Return the trial with the largest explained share; labels decide between equally good ones."""
        trials = [self.as_written, *(self.trial(one) for one in self._others())]
        most = max(trial.share for trial in trials)
        near = [trial for trial in trials if trial.share > most - EQUAL_SHARES]
        return max(near, key=lambda trial: trial.sided > max(one.sided for one in near) - SIDED_BETTER)

    def _others(self) -> Iterator[Hypothesis]:
        """Yield frames in fine steps for odometry as written, and in quarter turns for other meanings."""
        for meaning in MEANINGS:
            step = TURN_STEP if meaning == AS_WRITTEN else 90.0
            for turn in np.arange(0.0, 360.0, step).tolist():
                for mirrored in (False, True):
                    one = replace(meaning, turn=turn - 360.0 if turn > 180.0 else turn, mirrored=mirrored)
                    if one != AS_WRITTEN and (meaning.content != "nothing" or one == meaning):
                        yield one

    def sided(self, matrix: Array) -> float:
        """Return the share of labelled detections on their label's side in a frame; 0.5 without labels."""
        points, labels = self._labelled
        on_side = ((points @ matrix.T)[:, 1] > 0.0) == (labels == LEFT)
        return float(on_side.mean()) if len(labels) else 0.5

    @cached_property
    def _labelled(self) -> tuple[Array, IntArray]:
        some = self.log.cycles[:: max(1, len(self.log.cycles) // SOME_CYCLES)]
        points = np.concatenate([cycle.points_vehicle for cycle in some])
        labels = np.concatenate([cycle.labels for cycle in some])
        distance = np.hypot(*points.T)
        near = (labels != UNKNOWN) & (distance < np.median(distance))
        return points[near], labels[near]


# --- mounting and latency of the sensor ------------------------------------------------------------------

MEDIAN_SQUARE: Final = 2.0 * float(np.log(2.0))  # median of |x|^2 of two standard normals


@dataclass(frozen=True, eq=False)
class Mounting:
    """Mounting of the sensor relative to the frame of a hypothesis."""

    values: Array  # (3,) yaw to the left (rad), and lever arm l: ahead and left of the odometry's point (m)
    sigmas: Array  # (3,) their standard deviations
    scatter: float  # median distance of detections of one cone (m)
    claimed: float  # median distance according to their covariances (m)


def mounting_of(trials: Trials, hypothesis: Hypothesis) -> Mounting | None:
    """Return the mounting that minimizes the distances of matched detections; None if it is not observable.

    A cone at a (earlier vehicle frame) and b (later), with the motion (R, t) between them, has the residual
    `a - R b - t + (J t) yaw + (I - R) l`: first order in the yaw, exact in the lever arm l.
    """
    motion, frame = trials.motion(hypothesis), hypothesis.frame
    values = np.zeros(3)
    for _ in range(MOUNTING_STEPS):
        seen = motion + lever(motion, values[1:])
        off, variances, rows = _matches(trials, rotation(values[0]) @ frame, seen)
        if len(rows) < LEAST_MATCHES:
            return None
        by_arm = [-lever(motion[rows], unit)[:, :2] for unit in np.eye(2)]
        columns = np.stack([left_of(seen[rows, :2]), *by_arm], axis=2)
        normal = np.einsum("nki,nkj->ij", columns, columns)
        if np.linalg.cond(normal) > WORST_CONDITION:
            return None
        values = values - np.linalg.solve(normal, np.einsum("nki,nk->i", columns, off))
    scores, inverse = np.zeros((len(motion), 3)), np.linalg.inv(normal)
    np.add.at(scores, rows, np.einsum("nki,nk->ni", columns, off))  # matches of a pair are dependent
    sigmas = np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse))
    claimed = np.median(np.sqrt(variances * MEDIAN_SQUARE))
    return Mounting(values, sigmas, float(np.median(np.hypot(*off.T))), float(claimed))


def lever(motion: Array, arm: Array) -> Array:
    """Return the change `(R - I) l` of motions (P, 3) for a sensor at the lever arm l (2,)."""
    c, s = np.cos(motion[:, 2]) - 1.0, np.sin(motion[:, 2])
    return np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1], np.zeros(len(motion))])


def _matches(trials: Trials, frame: Array, motion: Array) -> tuple[Array, Array, IntArray]:
    """Return offsets (n, 2) of mutually nearest detections, their variances (n,), and their pairs (n,)."""
    pairs = trials.pairs
    square = np.moveaxis(pairs.distances(frame, motion), -1, 0)
    forth, back = square.argmin(axis=2), square.argmin(axis=1)
    mutual = np.take_along_axis(back, forth, axis=1) == np.arange(square.shape[1])
    near = np.take_along_axis(square, forth[..., None], axis=2)[..., 0] < (2.0 * pairs.reach) ** 2
    rows, before = np.nonzero(mutual & near)
    after = forth[rows, before]
    off = pairs.before[rows, before] @ frame.T - pairs.laid(frame, motion)[rows, after]
    return off, pairs.variances[rows, before, after], rows


def best_lateness(trials: Trials, best: Trial) -> Trial:
    """Return the trial with the best latency of the detections for a hypothesis."""
    steps = np.arange(-LATEST_STAMPS, LATEST_STAMPS + LATE_STEP, LATE_STEP)
    others = (trials.trial(replace(best.hypothesis, late=late)) for late in steps[steps != 0.0].tolist())
    return max([best, *others], key=lambda trial: trial.share)
