"""Find the place of a vehicle on what is known, by hypotheses, fits and odds.

A prior or the shape of the driven path proposes poses, and cones or curves verify them. Cones stand at
regular distances, so a few of them fit in many places. A place has log odds against every rival: the other
places, and that the vehicle is at none of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf, log
from typing import Final, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.boundary import sampled
from pathspace_graph.spline.bspline import BSpline

from .constellation import (
    CURVE_STEP,
    FAILED,
    MATCHING,
    PATH_STEP,
    PLACES_APART,
    REACH,
    Constellation,
    Known,
    Prior,
    SampledCurves,
)

SURE_ODDS: Final = 7.0  # least log odds of a place where a wrong one costs the map: a thousand to one
LEAST_CONES: Final = 6  # least number of cones in view at a place
FITS_BY_CHANCE: Final = 0.55
"""Probability that a cone lies on some other by chance, at a wrong place where its neighbours do."""

AT_HYPOTHESIS: Final = (3.0, 3.0, 0.2)  # sigmas of the pose about a hypothesis (m, m, rad)
MISFIT_OF_WAY: Final = 3.0  # largest rms distance of an aligned path from the way (m)
MOST_HYPOTHESES: Final = 16  # largest number of hypotheses, those of the best shape


@dataclass(frozen=True, eq=False)
class Place:
    """A pose on what is known."""

    pose: Array  # (3,) map frame
    information: Array  # (3, 3) of the pose, from what was seen
    odds: float  # log odds against every other place and against none of them; -inf if it does not fit


def find(seen: Constellation, known: Known, prior: Prior) -> Place | None:
    """Find the best place where cones or lines, seen in the vehicle frame, lie on known ones.

    The cost of a place is the sum of capped squares of what lies in view of the known there, plus the squared
    Mahalanobis distance from the prior, up to `FAILED`. What is out of view costs as much as at the next best
    place. So rows at regular distances, which fit in many places, count little. At none of them, the cones
    fit as well by chance, in any of the tries.
    """
    total = seen.weight * len(seen)
    if total < LEAST_CONES or len(prior.poses) == 0:
        return None
    fits = known.fits(seen, prior)
    misfit = fits.squares / np.maximum(fits.counts, 1.0)
    enough = fits.counts >= LEAST_CONES
    unseen = _best_of_others(np.where(enough, misfit, inf), fits.poses, MATCHING)
    out_of_view = unseen * (total - fits.counts)
    costs = fits.squares + out_of_view + np.minimum(fits.away, FAILED)
    best = int(costs.argmin())
    by_cone = min(2.0 * log(1.0 / FITS_BY_CHANCE), MATCHING - float(misfit[best]))
    by_chance = by_cone * float(fits.counts[best]) - 2.0 * log(len(prior.tried))
    none = float(fits.squares[best] + out_of_view[best]) + prior.failed + by_chance
    rival = min(_best_of_others(costs, fits.poses, inf), none)
    is_fit = enough[best] and misfit[best] <= MATCHING
    odds = 0.5 * (rival - float(costs[best])) if is_fit else -inf
    return Place(fits.poses[best], fits.information[best], odds)


def sure(place: Place | None) -> Place | None:
    """Return the place if its odds are `SURE_ODDS` or more."""
    return place if place is not None and place.odds >= SURE_ODDS else None


def _best_of_others(values: Array, poses: Array, limit: float) -> float:
    """Return the least value at another place than that of the least, up to a limit."""
    others = np.hypot(*(poses - poses[int(values.argmin())])[:, :2].T) > PLACES_APART
    return float(values[others].min(initial=limit))


# --- hypotheses by the shape of the path -------------------------------------------------------------------


def along(poses: Array, way: Array, is_closed: bool) -> Array:
    """Return the poses (k, 3) that the newest of poses (P, 3) has where the path aligns with a way (n, 2).

    The path p is aligned rigidly (Umeyama 1991) with each stretch q of the way, whose points are `PATH_STEP`
    apart. With both as complex numbers about their means, the turn is that of sum(p* q), and the sum of
    squared distances is sum |p|^2 + sum |q|^2 - 2 |sum(p* q)|. The best shape is first.
    """
    length = path_lengths(poses)
    steps = min(int(length[-1] / PATH_STEP), len(way) - 1)
    at = length[-1] - PATH_STEP * np.arange(steps, -1, -1)
    x, y = (np.interp(at, length, axis) for axis in poses[:, :2].T)
    path, around = x + 1j * y, way @ np.array([1.0, 1j])
    if is_closed:
        around = np.concatenate([around[len(way) - steps :], around])
    stretches = sliding_window_view(around, steps + 1)
    mean, means = path.mean(), stretches.mean(axis=1)
    turn = stretches @ (path - mean).conj()
    spread = np.square(np.abs(stretches - means[:, None])).sum(axis=1)
    misfit = np.square(np.abs(path - mean)).sum() + spread - 2.0 * np.abs(turn)
    chosen = list[int]()
    for i in np.argsort(misfit, kind="stable").tolist():
        if misfit[i] > len(path) * MISFIT_OF_WAY**2 or len(chosen) == MOST_HYPOTHESES:
            break
        away = np.abs(np.array(chosen) - i)
        if is_closed:
            away = np.minimum(away, len(way) - away)
        if (away * PATH_STEP >= REACH[0]).all():
            chosen.append(i)
    heading = np.angle(turn[chosen])
    newest = np.exp(1j * heading) * (poses[-1, :2] @ np.array([1.0, 1j]) - mean) + means[chosen]
    return np.column_stack([newest.real, newest.imag, heading + poses[-1, 2]])


@dataclass(frozen=True, eq=False)
class KnownRoad:
    """A known road: what is seen on it, and the way along it."""

    seen: Known  # its cones, or its curves where it has none
    way: Array  # (n, 2) points of its middle in driving order, `PATH_STEP` apart
    closed: bool

    @classmethod
    def of(cls, splines: Mapping[int, BSpline], cones: Mapping[int, Array] | None = None) -> Self:
        """Lay out both curves of a map by label, and their cones (k, 2), parameters and sigmas (m).

        Cones count only if both curves have some.
        """
        seen: Known = SampledCurves.of(splines)
        if cones and all(len(cones.get(label, ())) for label in splines):
            points = [spline.evaluate(cones[label][:, 0]) for label, spline in splines.items()]
            labels = np.concatenate([np.full(len(cones[label]), label) for label in splines])
            variances = np.concatenate([cones[label][:, 1] ** 2 for label in splines])
            seen = Constellation(np.concatenate(points), variances[:, None, None] * np.eye(2), labels)
        first, other = (sampled(spline, CURVE_STEP) for spline in splines.values())
        middle = 0.5 * (first + other[KDTree(other).query(first)[1]])
        length = path_lengths(middle)
        at = np.linspace(0.0, length[-1], max(round(length[-1] / PATH_STEP), 1) + 1)
        way = np.column_stack([np.interp(at, length, axis) for axis in middle.T])
        closed = all(spline.periodic for spline in splines.values())
        return cls(seen, way[:-1] if closed else way, closed)

    def along(self, poses: Array) -> Prior:
        """Return the prior of the newest of poses (P, 3), wherever the path fits by its shape."""
        return Prior.about(along(poses, self.way, self.closed), AT_HYPOTHESIS, failed=0.0)

    def backwards(self) -> Self:
        """Return the same road driven the other way, on which left is right."""
        other = {LEFT: RIGHT, RIGHT: LEFT}
        return replace(self, seen=self.seen.relabelled(other), way=self.way[::-1])
