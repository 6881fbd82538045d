"""Hypotheses about a log: in which frame its detections are, and what its odometry means.

Each lays the detections of nearby cycles on each other, since cones stand still. One that explains far more
of them than the log as it is written is the likely truth.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.special import bdtrc

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, UNKNOWN

from .pairs import DEGREE, SOME_CYCLES, Meaning, Pairs, motions

TURN_STEP: Final = 15.0  # step of the angles that the frame of the detections is tried at (degrees)
EQUAL: Final = 0.02  # difference of explained shares below which hypotheses are equally good
SIDED: Final = 0.2  # further share of labels on their side by which one of equal hypotheses is better
TELLING: Final = 0.2  # difference of explained shares from which a pair tells two hypotheses apart
CHANCE: Final = 1e-8  # probability of winning by chance below which a hypothesis is believed
FAR_BETTER: Final = 1.8  # least ratio of what it explains to what the log as written does
LEAST_SHARE: Final = 0.3  # least share of the detections that a believed hypothesis explains
MOUNTING_STEPS: Final = 5  # Gauss-Newton steps that find the mounting of the sensor
LEAST_MATCHES: Final = 60  # least number of matched detections from which the mounting is found
WORST_CONDITION: Final = 1e6  # largest condition number at which the mounting is found
LATEST: Final = 10.0  # largest delay or lead of detections that is tried (s)
LATE_STEP: Final = 0.25  # step of these (s)
QUARTER: Final = 90.0  # a quarter turn in degrees
MEANINGS: Final = (  # meanings of the odometry that are tried; of equally good ones the first is told
    Meaning(),
    Meaning(content="nothing"),
    Meaning(rate=DEGREE),
    Meaning(rate=1.0 / DEGREE),
    Meaning(speed=1.0 / 3.6),
    Meaning(speed=0.44704),
    Meaning(speed=0.514444),
    Meaning(speed=1e-2),
    Meaning(speed=1e-3),
    Meaning(speed=3.6),
    Meaning(speed=1e3),
    Meaning(speed=1.0 / 3.6, rate=DEGREE),
    Meaning(speed=1e-2, rate=DEGREE),
    Meaning(speed=1e-3, rate=DEGREE),
    Meaning(content="twist in the map frame"),
    Meaning(content="twist in the map frame", rate=DEGREE),
    Meaning(content="pose"),
    Meaning(content="pose", rate=DEGREE),
    Meaning(speed=1e-3, rate=1e-3),
)


@dataclass(frozen=True)
class Frame:
    """How the frame of the detections stands in that of the vehicle."""

    turn: float = 0.0  # turn to the left (degrees)
    mirrored: bool = False  # whether the y axis points to the other side, seen from the x axis

    @property
    def matrix(self) -> Array:
        return rotation(self.turn * DEGREE) @ np.diag([1.0, -1.0 if self.mirrored else 1.0])


@dataclass(frozen=True)
class Hypothesis:
    """What the columns of a log mean."""

    frame: Frame = Frame()
    meaning: Meaning = field(default_factory=Meaning)
    late: float = 0.0  # how much too large the stamps of the detections are (s)


AS_WRITTEN: Final = Hypothesis()  # the log means what it should


@dataclass(frozen=True, eq=False)
class Trial:
    """How well a hypothesis explains the pairs of cycles."""

    hypothesis: Hypothesis
    explained: Array  # share (P,) of the detections of each pair that is explained
    sided: float = 0.0  # share of the labelled detections on the side of their label

    @property
    def share(self) -> float:
        return float(self.explained.mean())


@dataclass(frozen=True, eq=False)
class Verdict:
    """Comparison of a hypothesis with the log as it is written, on the pairs that tell them apart."""

    telling: int  # number of these pairs
    better: int  # number of those that the hypothesis explains better
    share: float  # share of their detections that it explains
    share_as_written: float  # share of their detections that the log as it is written explains

    def is_clear(self) -> bool:
        chance = float(bdtrc(self.better - 1, self.telling, 0.5))
        far_better = self.share > FAR_BETTER * self.share_as_written
        return chance < CHANCE and far_better and self.share > LEAST_SHARE

    @property
    def figures(self) -> dict[str, float]:
        return {"as_written": self.share_as_written, "share": self.share}


def verdict(trial: Trial, reference: Trial) -> Verdict:
    gain = trial.explained - reference.explained
    telling: BoolArray = np.abs(gain) > TELLING
    if not telling.any():
        return Verdict(0, 0, 0.0, 0.0)
    shares = (float(one.explained[telling].mean()) for one in (trial, reference))
    return Verdict(int(telling.sum()), int((gain[telling] > 0.0).sum()), *shares)


class Trials:
    def __init__(self, log: Log, pairs: Pairs) -> None:
        self.log, self.pairs = log, pairs
        self._poses: dict[Meaning, Array] = {}

    def motion(self, hypothesis: Hypothesis) -> Array:
        """Return the motion (P, 3) of the vehicle from the earlier to the later cycle of each pair."""
        odometry, pairs, meaning = self.log.odometry, self.pairs, hypothesis.meaning
        if meaning not in self._poses:
            self._poses[meaning] = meaning.poses(odometry)
        begin, end = pairs.begin - hypothesis.late, pairs.end - hypothesis.late
        return motions(odometry.t, self._poses[meaning], begin, end)

    def trial(self, hypothesis: Hypothesis) -> Trial:
        matrix = hypothesis.frame.matrix
        explained = self.pairs.explained(matrix, self.motion(hypothesis))
        return Trial(hypothesis, explained, self.sided(matrix))

    @cached_property
    def as_written(self) -> Trial:
        return self.trial(AS_WRITTEN)

    def best(self) -> Trial:
        """Return the hypothesis that explains most; labels on their sides decide between equal ones."""
        trials = [self.as_written, *(self.trial(one) for one in self._others())]
        most = max(trial.share for trial in trials)
        near = [trial for trial in trials if trial.share > most - EQUAL]
        return max(near, key=lambda trial: trial.sided > max(one.sided for one in near) - SIDED)

    def _others(self) -> Iterator[Hypothesis]:
        """Yield frames in fine steps for a right odometry, and in quarter turns for any other."""
        for meaning in MEANINGS:
            step = TURN_STEP if meaning == Meaning() else QUARTER
            for turn in np.arange(0.0, 360.0, step).tolist():
                for mirrored in (False, True):
                    one = Hypothesis(Frame(turn - 360.0 if turn > 180.0 else turn, mirrored), meaning)
                    is_tried = meaning.content != "nothing" or one.frame == Frame()
                    if one != AS_WRITTEN and is_tried:
                        yield one

    def sided(self, matrix: Array) -> float:
        """Return the share of labelled detections on the side of their label in a frame; 0.5 without any."""
        points, labels = self._labelled
        if len(labels) == 0:
            return 0.5
        return float((((points @ matrix.T)[:, 1] > 0.0) == (labels == LEFT)).mean())

    @cached_property
    def _labelled(self) -> tuple[Array, IntArray]:
        some = self.log.cycles[:: max(1, len(self.log.cycles) // SOME_CYCLES)]
        points = np.concatenate([cycle.points_vehicle for cycle in some])
        labels = np.concatenate([cycle.labels for cycle in some])
        distance = np.hypot(*points.T)
        near = (labels != UNKNOWN) & (distance < np.median(distance))
        return points[near], labels[near]


# --- where the sensor is in the vehicle, and how late it is ----------------------------------------------

MEDIAN_SQUARE: Final = 2.0 * float(np.log(2.0))  # median of |x|^2 of two standard normals


@dataclass(frozen=True, eq=False)
class Mounting:
    """How the sensor stands in the vehicle, beyond the frame of a hypothesis."""

    values: Array  # (3,) turn to the left (rad), and place ahead and to the left of the odometry's point (m)
    sigmas: Array  # (3,) their standard deviations
    scatter: float  # median distance of detections of one cone (m)
    claimed: float  # the same by their covariances (m)

    @property
    def yaw(self) -> tuple[float, float]:
        """Turn to the left and its standard deviation in degrees."""
        return float(self.values[0]) / DEGREE, float(self.sigmas[0]) / DEGREE

    @property
    def arm(self) -> tuple[float, float]:
        """Length of the lever arm, and the larger standard deviation of its components (m)."""
        return float(np.hypot(*self.values[1:])), float(self.sigmas[1:].max())


def mounting_of(trials: Trials, hypothesis: Hypothesis) -> Mounting | None:
    """Return the mounting under which nearby detections lie on each other best; None without any.

    A cone at a (vehicle frame, earlier cycle) and b (later) with the motion (R, t) between them leaves
    `a - R b - t + (J t) yaw + (I - R) l`, in first order of the yaw and exactly in the lever arm l.
    """
    motion, frame = trials.motion(hypothesis), hypothesis.frame.matrix
    values, sigmas = np.zeros(3), np.full(3, np.inf)
    for _ in range(MOUNTING_STEPS):
        turned = rotation(values[0]) @ frame
        seen = motion + lever(motion, values[1:])
        off, variances, rows = _matches(trials, turned, seen)
        if len(rows) < LEAST_MATCHES:
            return None
        columns = _columns(motion[rows], values[1:])
        normal = np.einsum("nki,nkj->ij", columns, columns)
        if np.linalg.cond(normal) > WORST_CONDITION:
            return None
        values = values - np.linalg.solve(normal, np.einsum("nki,nk->i", columns, off))
        sigmas = _sigmas(columns, off, rows, normal)
    scatter = float(np.median(np.hypot(*off.T)))
    return Mounting(values, sigmas, scatter, float(np.median(np.sqrt(variances * MEDIAN_SQUARE))))


def lever(motion: Array, arm: Array) -> Array:
    """Return what a lever arm (2,) adds to motions (P, 3): a sensor there moves by `t + (R - I) l`."""
    c, s = np.cos(motion[:, 2]) - 1.0, np.sin(motion[:, 2])
    return np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1], np.zeros(len(motion))])


def _columns(motion: Array, arm: Array) -> Array:
    seen = motion + lever(motion, arm)
    columns = np.zeros((len(motion), 2, 3))
    columns[:, 0, 0], columns[:, 1, 0] = -seen[:, 1], seen[:, 0]
    for k, unit in enumerate(np.eye(2)):
        columns[:, :, 1 + k] = -lever(motion, unit)[:, :2]
    return columns


def _matches(trials: Trials, frame: Array, motion: Array) -> tuple[Array, Array, IntArray]:
    """Return offsets (n, 2) of mutually nearest detections, a coordinate's variances (n,), and pairs (n,)."""
    pairs = trials.pairs
    square = pairs.distances(frame, motion)
    forth, back = square.argmin(axis=2), square.argmin(axis=1)
    mutual = np.take_along_axis(back, forth, axis=1) == np.arange(square.shape[1])
    near = np.take_along_axis(square, forth[..., None], axis=2)[..., 0] < (2.0 * pairs.reach) ** 2
    rows, before = np.nonzero(mutual & near)
    after = forth[rows, before]
    off = pairs.before[rows, before] @ frame.T - pairs.laid(frame, motion)[rows, after]
    return off, pairs.variances[rows, before, after], rows


def _sigmas(columns: Array, off: Array, rows: IntArray, normal: Array) -> Array:
    """Return the standard deviations (3,), for which the matches of one pair count as one observation."""
    scores = np.zeros((int(rows.max()) + 1, 3))
    np.add.at(scores, rows, np.einsum("nki,nk->ni", columns, off))
    inverse = np.linalg.inv(normal)
    return np.asarray(np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse)))


def best_lateness(trials: Trials, best: Trial) -> Trial:
    """Return the trial of the lateness of the detections under which a hypothesis explains most."""
    steps = np.arange(-LATEST, LATEST + LATE_STEP, LATE_STEP)
    others = (trials.trial(replace(best.hypothesis, late=late)) for late in steps[steps != 0.0].tolist())
    return max([best, *others], key=lambda trial: trial.share)
