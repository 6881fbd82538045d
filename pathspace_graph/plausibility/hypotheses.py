"""Hypotheses about a log: in which frame its detections are, and what its odometry means.

Static cones must move in the frame of the vehicle as the odometry says. Each hypothesis lays the detections
of nearby cycles on each other. One that explains far more of them than the log as it is written is the likely
truth.
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
from pathspace_graph.settings.plausibility import PlausibilitySettings

from .pairs import DEGREE, Meaning, Pairs, motions

QUARTER: Final = 90.0
"""This is a quarter turn in degrees."""
MEANINGS: Final = (
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
"""These meanings of the odometry are tried; of equally good ones the first is told."""


@dataclass(frozen=True)
class Frame:
    """Says how the frame of the detections stands in that of the vehicle."""

    turn: float = 0.0
    """The frame is turned by this to the left (degrees)."""
    mirrored: bool = False
    """The y axis points to the other side, seen from the x axis."""

    @property
    def matrix(self) -> Array:
        """Returns the matrix (2, 2) that leads to the vehicle's frame."""
        return rotation(self.turn * DEGREE) @ np.diag([1.0, -1.0 if self.mirrored else 1.0])


@dataclass(frozen=True)
class Hypothesis:
    """Says what the columns of a log mean."""

    frame: Frame = field(default_factory=Frame)
    """The detections are in this frame."""
    meaning: Meaning = field(default_factory=Meaning)
    """The odometry has this meaning."""
    late: float = 0.0
    """The stamps of the detections are too large by this (s)."""


AS_WRITTEN: Final = Hypothesis()
"""The log means what it should."""


@dataclass(frozen=True, eq=False)
class Trial:
    """Holds how well a hypothesis explains the pairs of cycles."""

    hypothesis: Hypothesis
    """This was tried."""
    explained: Array
    """(P,) It explains this share of the detections of each pair."""
    sided: float = 0.0
    """This share of the labelled detections is on the side of its label."""

    @property
    def share(self) -> float:
        """Returns the share of the detections that is explained."""
        return float(self.explained.mean())


@dataclass(frozen=True, eq=False)
class Verdict:
    """Compares a hypothesis with the log as it is written, on the pairs that tell them apart."""

    telling: int
    """This number of pairs tells them apart."""
    better: int
    """The hypothesis explains more detections of this number of them."""
    share: float
    """It explains this share of the detections of these pairs."""
    share_as_written: float
    """The log as it is written explains this share of them."""

    def is_clear(self, settings: PlausibilitySettings) -> bool:
        """Returns whether the hypothesis is better beyond doubt."""
        chance = float(bdtrc(self.better - 1, self.telling, 0.5))
        far_better = self.share > settings.far_better * self.share_as_written
        return chance < settings.chance and far_better and self.share > settings.least_share

    @property
    def figures(self) -> dict[str, float]:
        """The shares of the detections that lie where they are expected, as written and if it is so."""
        return {"as_written": self.share_as_written, "share": self.share}


def verdict(trial: Trial, reference: Trial, settings: PlausibilitySettings) -> Verdict:
    """Returns how a trial compares with the reference."""
    gain = trial.explained - reference.explained
    telling: BoolArray = np.abs(gain) > settings.telling
    if not telling.any():
        return Verdict(0, 0, 0.0, 0.0)
    return Verdict(
        int(telling.sum()),
        int((gain[telling] > 0.0).sum()),
        float(trial.explained[telling].mean()),
        float(reference.explained[telling].mean()),
    )


class Trials:
    """Tries hypotheses on the pairs of cycles of a log."""

    def __init__(self, log: Log, pairs: Pairs, settings: PlausibilitySettings) -> None:
        self.log, self.pairs, self.settings = log, pairs, settings
        self._poses: dict[Meaning, Array] = {}

    def motion(self, hypothesis: Hypothesis) -> Array:
        """Returns the motion (P, 3) of the vehicle from the earlier to the later cycle of each pair."""
        odometry, pairs, meaning = self.log.odometry, self.pairs, hypothesis.meaning
        if meaning not in self._poses:
            self._poses[meaning] = meaning.poses(odometry)
        begin, end = pairs.begin - hypothesis.late, pairs.end - hypothesis.late
        return motions(odometry.t, self._poses[meaning], begin, end)

    def trial(self, hypothesis: Hypothesis) -> Trial:
        """Returns how well a hypothesis explains the pairs."""
        matrix = hypothesis.frame.matrix
        explained = self.pairs.explained(matrix, self.motion(hypothesis))
        return Trial(hypothesis, explained, self.sided(matrix))

    @cached_property
    def as_written(self) -> Trial:
        """Returns how well the log as it is written explains the pairs."""
        return self.trial(AS_WRITTEN)

    def best(self) -> Trial:
        """Returns the hypothesis that explains most; labels on their sides decide between equal ones."""
        trials = [self.as_written, *(self.trial(one) for one in self._others())]
        most = max(trial.share for trial in trials)
        near = [trial for trial in trials if trial.share > most - self.settings.equal]
        return max(near, key=lambda trial: trial.sided > max(one.sided for one in near) - self.settings.sided)

    def _others(self) -> Iterator[Hypothesis]:
        """Yields frames in fine steps for a right odometry, and in quarter turns for any other."""
        for meaning in MEANINGS:
            step = self.settings.turn if meaning == Meaning() else QUARTER
            for turn in np.arange(0.0, 360.0, step).tolist():
                for mirrored in (False, True):
                    one = Hypothesis(Frame(turn - 360.0 if turn > 180.0 else turn, mirrored), meaning)
                    is_tried = meaning.content != "nothing" or one.frame == Frame()
                    if one != AS_WRITTEN and is_tried:
                        yield one

    def sided(self, matrix: Array) -> float:
        """Returns the share of labelled detections on the side of their label in a frame; 0.5 without any."""
        points, labels = self._labelled
        if len(labels) == 0:
            return 0.5
        return float((((points @ matrix.T)[:, 1] > 0.0) == (labels == LEFT)).mean())

    @cached_property
    def _labelled(self) -> tuple[Array, IntArray]:
        """Returns the near detections (m, 2) of some cycles that have a label, and the labels (m,)."""
        some = self.log.cycles[:: max(1, len(self.log.cycles) // self.settings.cycles)]
        points = np.concatenate([cycle.points_vehicle for cycle in some])
        labels = np.concatenate([cycle.labels for cycle in some])
        distance = np.hypot(*points.T)
        near = (labels != UNKNOWN) & (distance < np.median(distance))
        return points[near], labels[near]


# --- where the sensor is in the vehicle, and how late it is ----------------------------------------------

MEDIAN_SQUARE: Final = 2.0 * float(np.log(2.0))
"""The squared length of a vector of two standard normal numbers has this median."""


@dataclass(frozen=True, eq=False)
class Mounting:
    """Holds how the sensor stands in the vehicle, beyond the frame of a hypothesis."""

    values: Array
    """(3,) It is turned to the left (rad), and sits ahead and to the left (m) of the odometry's point."""
    sigmas: Array
    """(3,) These are the standard deviations."""
    scatter: float
    """Detections of one cone are this far from each other as a rule (m)."""
    claimed: float
    """Their covariances say that they are this far from each other as a rule (m)."""

    @property
    def yaw(self) -> tuple[float, float]:
        """Returns the turn to the left and its standard deviation in degrees."""
        return float(self.values[0]) / DEGREE, float(self.sigmas[0]) / DEGREE

    @property
    def arm(self) -> tuple[float, float]:
        """Returns the length of the lever arm, and the larger standard deviation of its components (m)."""
        return float(np.hypot(*self.values[1:])), float(self.sigmas[1:].max())


def mounting_of(trials: Trials, hypothesis: Hypothesis, settings: PlausibilitySettings) -> Mounting | None:
    """Returns the mounting under which nearby detections lie on each other best; None without any.

    A cone at a (vehicle frame, earlier cycle) and b (later) with the motion (R, t) between them leaves
    `a - R b - t + (J t) yaw + (I - R) l`, in first order of the yaw and exactly in the lever arm l.
    """
    motion, frame = trials.motion(hypothesis), hypothesis.frame.matrix
    values, sigmas = np.zeros(3), np.full(3, np.inf)
    for _ in range(settings.iterations):
        turned = rotation(values[0]) @ frame
        seen = motion + lever(motion, values[1:])
        off, variances, rows = _matches(trials, turned, seen)
        if len(rows) < settings.least_matches:
            return None
        columns = _columns(motion[rows], values[1:])
        normal = np.einsum("nki,nkj->ij", columns, columns)
        if np.linalg.cond(normal) > settings.worst_condition:
            return None
        values = values - np.linalg.solve(normal, np.einsum("nki,nk->i", columns, off))
        sigmas = _sigmas(columns, off, rows, normal)
    scatter = float(np.median(np.hypot(*off.T)))
    return Mounting(values, sigmas, scatter, float(np.median(np.sqrt(variances * MEDIAN_SQUARE))))


def lever(motion: Array, arm: Array) -> Array:
    """Returns what a lever arm (2,) adds to motions (P, 3): a sensor there moves by `t + (R - I) l`."""
    c, s = np.cos(motion[:, 2]) - 1.0, np.sin(motion[:, 2])
    return np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1], np.zeros(len(motion))])


def _columns(motion: Array, arm: Array) -> Array:
    """Returns the derivatives (n, 2, 3) of the residuals by yaw and lever arm."""
    seen = motion + lever(motion, arm)
    columns = np.zeros((len(motion), 2, 3))
    columns[:, 0, 0], columns[:, 1, 0] = -seen[:, 1], seen[:, 0]
    for k, unit in enumerate(np.eye(2)):
        columns[:, :, 1 + k] = -lever(motion, unit)[:, :2]
    return columns


def _matches(trials: Trials, frame: Array, motion: Array) -> tuple[Array, Array, IntArray]:
    """Returns the offsets (n, 2) of detections that are nearest to each other.

    With them come the variances (n,) of one coordinate of each, in m^2, and the pair (n,) of each.
    """
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
    """Returns the standard deviations (3,), for which the matches of one pair count as one observation."""
    scores = np.zeros((int(rows.max()) + 1, 3))
    np.add.at(scores, rows, np.einsum("nki,nk->ni", columns, off))
    inverse = np.linalg.inv(normal)
    return np.asarray(np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse)))


def best_lateness(trials: Trials, best: Trial, settings: PlausibilitySettings) -> Trial:
    """Returns the trial of the lateness of the detections under which a hypothesis explains most."""
    steps = np.arange(-settings.latest, settings.latest + settings.late_step, settings.late_step)
    others = (trials.trial(replace(best.hypothesis, late=late)) for late in steps[steps != 0.0].tolist())
    return max([best, *others], key=lambda trial: trial.share)
