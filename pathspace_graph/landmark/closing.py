"""Closing the loop of a landmark map: which landmarks of the newest row are those of the beginning.

The landmarks seen now and those not seen for long are one Gaussian, with one joint covariance, so a set of
pairs can be tested as a whole: each pair taken moves all others (joint compatibility, Neira and Tardos).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pathspace_graph.labels import BOUNDARIES

from .association import PLANE, Gates, squared_mahalanobis
from .landmark_map import LandmarkSmoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Landmarks that may be the same."""

    first: IntArray
    """(k,) positions of those seen lately."""
    second: IntArray
    """(k,) positions of those that each may be, seen long ago."""
    distance: float
    """Squared Mahalanobis distance of all of them together, 2 k degrees of freedom."""

    def score(self, gate: float) -> float:
        """How much better they explain what is seen than new landmarks do: `k gate - d^2`."""
        return len(self.first) * gate - self.distance

    def shares(self, other: Pairs) -> bool:
        """Whether any pair is the same."""
        own = set(zip(self.first.tolist(), self.second.tolist(), strict=True))
        return not own.isdisjoint(zip(other.first.tolist(), other.second.tolist(), strict=True))


class Belief:
    """Joint Gaussian of some landmarks seen lately and some seen long ago."""

    def __init__(
        self, smoother: LandmarkSmoother, recent: IntArray, old: IntArray, scale: float, sigma: float
    ) -> None:
        """`scale` multiplies all sigmas; a pair may be apart by `sigma` (m) anyway."""
        state = smoother.map.state
        self.recent, self.old, self.variance = recent, old, sigma**2
        both = np.concatenate([recent, old])
        self.mean = state.landmarks[both].copy()
        self.covariance = scale**2 * smoother.last_covariance(state.keys[both])
        self.same_colour = state.labels[recent][:, None] == state.labels[old][None]

    def distances(self, mean: Array, covariance: Array) -> Array:
        """(k, n) squared Mahalanobis distances of all pairs, infinite where the colours differ."""
        k, points = len(self.recent), len(mean)
        blocks = covariance.reshape(points, PLANE, points, PLANE).transpose(0, 2, 1, 3)
        own = blocks[np.arange(points), np.arange(points)]
        cross = blocks[:k, k:]
        spread = own[:k, None] + own[None, k:] - cross - np.swapaxes(cross, 2, 3)
        spread = spread + self.variance * np.eye(PLANE)
        return np.where(
            self.same_colour, squared_mahalanobis(mean[:k, None] - mean[None, k:], spread), np.inf
        )

    def joined(self, mean: Array, covariance: Array, i: int, j: int) -> tuple[Array, Array]:
        """The Gaussian given that landmark i of the recent ones is landmark j of the old ones."""
        a, b = PLANE * i, PLANE * (len(self.recent) + j)
        gradient = covariance[:, a : a + PLANE] - covariance[:, b : b + PLANE]
        spread = gradient[a : a + PLANE] - gradient[b : b + PLANE] + self.variance * np.eye(PLANE)
        gain = np.linalg.solve(spread, gradient.T).T
        innovation = mean[i] - mean[len(self.recent) + j]
        return mean - (gain @ innovation).reshape(-1, PLANE), covariance - gain @ gradient.T

    def grown_from(self, i: int, j: int, gate: float) -> Pairs:
        """One pair, then always the one that fits best given those before, as long as it is in the gate."""
        mean, covariance, total = self.mean, self.covariance, 0.0
        distances = self.distances(mean, covariance)
        free = np.ones(distances.shape, bool)
        chosen: list[tuple[int, int]] = []
        while distances[i, j] < gate:
            chosen.append((i, j))
            total += float(distances[i, j])
            free[i], free[:, j] = False, False
            mean, covariance = self.joined(mean, covariance, i, j)
            distances = np.where(free, self.distances(mean, covariance), np.inf)
            i, j = divmod(int(distances.argmin()), distances.shape[1])
        index = np.array(chosen, np.intp).reshape(-1, 2)
        return Pairs(self.recent[index[:, 0]], self.old[index[:, 1]], total)


def recognize(smoother: LandmarkSmoother, recent: IntArray, old: IntArray, reach: float) -> Pairs | None:
    """The landmarks seen lately that are surely old ones; None where they may be others, or too few are.

    Old ones farther than `reach` (m) from all of them aren't looked at.
    """
    settings, points = smoother.map.settings.landmark, smoother.map.state.landmarks
    offset = points[recent][:, None] - points[old][None]
    old = old[(np.hypot(offset[..., 0], offset[..., 1]) < reach).any(axis=0)]
    if len(recent) < settings.min_pairs or len(old) < settings.min_pairs:
        return None
    gate = Gates.of_probabilities(settings.match, settings.create).match
    belief = Belief(smoother, recent, old, smoother.map.settings.closing.prior_scale, settings.sigma_merge)
    distances = belief.distances(belief.mean, belief.covariance)
    seeds = np.argwhere(distances < gate)
    if len(seeds) == 0:
        return None
    hypotheses = [belief.grown_from(int(i), int(j), gate) for i, j in seeds]
    best = max(hypotheses, key=lambda pairs: pairs.score(gate))
    others = [pairs.score(gate) for pairs in hypotheses if not pairs.shares(best)]
    clear = best.score(gate) - max(others, default=0.0) >= settings.min_lead * gate
    return best if clear and _believed(smoother, best) else None


def _believed(smoother: LandmarkSmoother, pairs: Pairs) -> bool:
    """Enough pairs of either colour, compatible as a whole."""
    settings, labels = smoother.map.settings.landmark, smoother.map.state.labels[pairs.first]
    enough = all((labels == label).sum() >= settings.min_pairs // 3 for label in BOUNDARIES)
    joint = chi2.ppf(settings.create, PLANE * len(labels)) if len(labels) else 0.0
    return bool(enough and len(labels) >= settings.min_pairs and pairs.distance < joint)


def optimize_loop(smoother: LandmarkSmoother, pairs: Pairs) -> None:
    """Solve the whole loop with the pairs tied, each submap relinearized in its own frame.

    The pairs are to be merged next.
    """
    smoother.map.ties = smoother.map.state.numbers[np.column_stack([pairs.first, pairs.second])]
    smoother.solve_loop(smoother.map.settings.closing.iterations, None)


def merge(smoother: LandmarkSmoother, first: IntArray, second: IntArray) -> None:
    """Landmarks `first` (k,) become `second` (k,), by position; exact, nothing is forgotten.

    A step follows, since the last one's columns are gone.
    """
    keys = smoother.map.state.keys
    smoother.merge(keys[first], keys[second])
    smoother.map.merge(first, second)
    smoother.step()
