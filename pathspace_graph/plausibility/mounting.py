"""Where the sensor is in the vehicle, and how late it is, by least squares over the pairs of cycles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.settings.plausibility import PlausibilitySettings

from .hypotheses import Hypothesis, Trial, Trials
from .motions import DEGREE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

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
