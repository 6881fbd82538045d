"""Closes the loop of a landmark map: detects which of the landmarks seen now are those of the beginning.

The landmarks seen now and those not seen for long have one joint covariance. So a set of pairs can be tested
as a whole, since each accepted pair moves all others (joint compatibility, Neira and Tardos 2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pathspace_graph.graph.keys import POINT
from pathspace_graph.labels import BOUNDARIES

from .association import Gates, squared_mahalanobis
from .landmark_map import LandmarkSmoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class LoopPairs:
    """Holds a hypothesis: pairs of landmarks that are the same cone."""

    recent: IntArray
    """(k,) These are the positions of landmarks that were seen lately."""
    old: IntArray
    """(k,) These are the positions of the landmarks of the beginning that they are."""
    distance: float
    """This is the squared Mahalanobis distance of all pairs together, with 2 k degrees of freedom."""

    def score(self, gate: float) -> float:
        """Returns `k gate - d^2`: how much better the pairs explain the detections than new landmarks do."""
        return len(self.recent) * gate - self.distance

    def overlaps(self, other: LoopPairs) -> bool:
        """Returns whether both hypotheses have a pair in common."""
        own = set(zip(self.recent.tolist(), self.old.tolist(), strict=True))
        return not own.isdisjoint(zip(other.recent.tolist(), other.old.tolist(), strict=True))


class JointCompatibility:
    """Tests sets of pairs against the joint Gaussian of some recent and some old landmarks.

    `scale` multiplies all standard deviations. `sigma` (m) is the standard deviation of the true offset of a
    pair, since two estimates of one cone may differ a little more than their covariance says.
    """

    def __init__(
        self, smoother: LandmarkSmoother, recent: IntArray, old: IntArray, scale: float, sigma: float
    ) -> None:
        state = smoother.map.state
        self.recent, self.old, self.variance = recent, old, sigma**2
        both = np.concatenate([recent, old])
        self.mean = state.landmarks[both].copy()
        self.covariance = scale**2 * smoother.last_covariance(state.keys[both])
        self.same_label = state.labels[recent][:, None] == state.labels[old][None]

    def distances(self, mean: Array, covariance: Array) -> Array:
        """Returns the squared Mahalanobis distances (k, n) of all pairs; other labels give infinity."""
        k, points = len(self.recent), len(mean)
        blocks = covariance.reshape(points, POINT, points, POINT).transpose(0, 2, 1, 3)
        own = blocks[np.arange(points), np.arange(points)]
        cross = blocks[:k, k:]
        spread = own[:k, None] + own[None, k:] - cross - np.swapaxes(cross, 2, 3)
        spread = spread + self.variance * np.eye(POINT)
        return np.where(self.same_label, squared_mahalanobis(mean[:k, None] - mean[None, k:], spread), np.inf)

    def conditioned(self, mean: Array, covariance: Array, i: int, j: int) -> tuple[Array, Array]:
        """Returns the Gaussian given that recent landmark i is old landmark j: one Kalman update."""
        a, b = POINT * i, POINT * (len(self.recent) + j)
        cross = covariance[:, a : a + POINT] - covariance[:, b : b + POINT]
        spread = cross[a : a + POINT] - cross[b : b + POINT] + self.variance * np.eye(POINT)
        gain = np.linalg.solve(spread, cross.T).T
        innovation = mean[i] - mean[len(self.recent) + j]
        return mean - (gain @ innovation).reshape(-1, POINT), covariance - gain @ cross.T

    def grow(self, i: int, j: int, gate: float) -> LoopPairs:
        """Returns a hypothesis that begins with one pair and adds the best pair while that is in the gate.

        Each pair is tested given those before it.
        """
        mean, covariance, total = self.mean, self.covariance, 0.0
        distances = self.distances(mean, covariance)
        free = np.ones(distances.shape, bool)
        chosen: list[tuple[int, int]] = []
        while distances[i, j] < gate:
            chosen.append((i, j))
            total += float(distances[i, j])
            free[i], free[:, j] = False, False
            mean, covariance = self.conditioned(mean, covariance, i, j)
            distances = np.where(free, self.distances(mean, covariance), np.inf)
            i, j = divmod(int(distances.argmin()), distances.shape[1])
        index = np.array(chosen, np.intp).reshape(-1, 2)
        return LoopPairs(self.recent[index[:, 0]], self.old[index[:, 1]], total)


def detect_loop(
    smoother: LandmarkSmoother, recent: IntArray, old: IntArray, reach: float
) -> LoopPairs | None:
    """Returns the pairs of the best hypothesis, or None if it is not clear or has too few pairs.

    Old landmarks farther than `reach` (m) from all recent ones are not tested.
    """
    settings, points = smoother.map.settings.landmark, smoother.map.state.landmarks
    offset = points[recent][:, None] - points[old][None]
    old = old[(np.hypot(offset[..., 0], offset[..., 1]) < reach).any(axis=0)]
    if len(recent) < settings.min_pairs or len(old) < settings.min_pairs:
        return None
    gate, scale = Gates.of(settings).match, smoother.map.settings.closing.prior_scale
    test = JointCompatibility(smoother, recent, old, scale, settings.sigma_merge)
    seeds = np.argwhere(test.distances(test.mean, test.covariance) < gate)
    if len(seeds) == 0:
        return None
    hypotheses = [test.grow(int(i), int(j), gate) for i, j in seeds]
    best = max(hypotheses, key=lambda pairs: pairs.score(gate))
    others = [pairs.score(gate) for pairs in hypotheses if not pairs.overlaps(best)]
    clear = best.score(gate) - max(others, default=0.0) >= settings.min_lead * gate
    return best if clear and _is_acceptable(smoother, best) else None


def _is_acceptable(smoother: LandmarkSmoother, pairs: LoopPairs) -> bool:
    """Returns whether there are enough pairs of either label, which are compatible as a whole."""
    settings, labels = smoother.map.settings.landmark, smoother.map.state.labels[pairs.recent]
    enough = all((labels == label).sum() >= settings.min_pairs // 3 for label in BOUNDARIES)
    joint = chi2.ppf(settings.create, POINT * len(labels)) if len(labels) else 0.0
    return bool(enough and len(labels) >= settings.min_pairs and pairs.distance < joint)


def optimize_loop(smoother: LandmarkSmoother, pairs: LoopPairs) -> None:
    """Solves the whole loop with the pairs held together, each submap relinearized in its own frame.

    The caller merges the pairs next.
    """
    smoother.map.loop_pairs = smoother.map.state.numbers[np.column_stack([pairs.recent, pairs.old])]
    smoother.solve_loop(smoother.map.settings.closing.iterations, None)
