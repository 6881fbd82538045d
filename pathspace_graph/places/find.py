"""Find the place of a vehicle on what is known, by hypotheses, fits and odds.

A prior or the shape of the driven path proposes poses, and cones or curves verify them. Cones stand at
regular distances, so a few of them fit in many places. A place has log odds against every rival: the other
places, and that the vehicle is at none of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, log
from typing import Final, Self

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.boundary import sampled
from pathspace_graph.spline.bspline import BSpline

from .constellation import (
    CURVE_STEP,
    FAILED,
    PLACES_APART,
    UNSEEN,
    Constellation,
    Known,
    Prior,
    SampledCurves,
)

SURE_ODDS: Final = 7.0  # least log odds of a place where a wrong one costs the map: a thousand to one
LEAST_CONES: Final = 6  # least number of cones in view at a place
FIT_MISFIT: Final = 2.0  # largest mean capped square of these: the expectation of matching cones in 2D
BEST_PLACES: Final = 3  # largest number of places returned
FITS_BY_CHANCE: Final = 0.55
"""Probability that a cone lies on some other by chance, at a wrong place where its neighbours do."""

ROAD_STEP: Final = 2.0  # step of the points of a way (m)
STEPS_AHEAD: Final = 2  # number of points straight ahead of the vehicle that are aligned with the way, too
MISFIT_OF_WAY: Final = 3.0  # largest rms distance of an aligned path from the way (m)
HYPOTHESES_APART: Final = 6.0  # least distance of hypotheses along the way (m)
AT_HYPOTHESIS: Final = (3.0, 3.0, 0.2), (6.0, 0.2)  # sigmas and reach of the pose about one (m, m, rad)
MOST_HYPOTHESES: Final = 16  # largest number of hypotheses, those of the best shape


@dataclass(frozen=True, eq=False)
class Place:
    """A pose on what is known."""

    pose: Array  # (3,) map frame
    information: Array  # (3, 3) of the pose, from what was seen
    odds: float  # log odds against every other place and against none of them; -inf if it does not fit


def find(seen: Constellation, known: Known, prior: Prior) -> list[Place]:
    """Find the best places where cones or lines, seen in the vehicle frame, lie on known ones, in order.

    The cost of a place is the sum of capped squares of what lies in view of the known there, plus the squared
    Mahalanobis distance from the prior, up to `FAILED`. What is out of view costs as much as at the next best
    place. So rows at regular distances, which fit in many places, count little. At none of them, the cones
    fit as well by chance, in any of the tries.
    """
    total = seen.weight * len(seen)
    if total < LEAST_CONES or len(prior.poses) == 0:
        return []
    fits = known.fits(seen, prior)
    misfit = fits.squares / np.maximum(fits.counts, 1.0)
    enough = fits.counts >= LEAST_CONES
    unseen = _best_of_others(np.where(enough, misfit, inf), fits.poses, UNSEEN)
    out_of_view = unseen * (total - fits.counts)
    costs = fits.squares + out_of_view + np.minimum(fits.away, FAILED)
    by_cone = np.minimum(2.0 * log(1.0 / FITS_BY_CHANCE), FIT_MISFIT - misfit)
    by_chance = by_cone * fits.counts - 2.0 * log(len(prior.poses))
    none = fits.squares + out_of_view + prior.failed + by_chance
    order, places = np.argsort(costs, kind="stable"), list[Place]()
    for i in order.tolist():
        pose = fits.poses[i]
        if len(places) == BEST_PLACES:
            break
        if any(np.hypot(*(pose - other.pose)[:2]) <= PLACES_APART for other in places):
            continue
        others = np.hypot(*(fits.poses - pose)[:, :2].T) > PLACES_APART
        rival = min(float(costs[others].min(initial=inf)), float(none[i]))
        is_fit = enough[i] and misfit[i] <= FIT_MISFIT
        places.append(Place(pose, fits.information[i], 0.5 * (rival - float(costs[i])) if is_fit else -inf))
    return places


def sure(places: Sequence[Place]) -> Place | None:
    """Return the first of the best places if its odds are `SURE_ODDS` or more."""
    return places[0] if places and places[0].odds >= SURE_ODDS else None


def _best_of_others(values: Array, poses: Array, limit: float) -> float:
    """Return the least value at another place than that of the least, up to a limit."""
    others = np.hypot(*(poses - poses[int(values.argmin())])[:, :2].T) > PLACES_APART
    return float(values[others].min(initial=limit))


# --- hypotheses by the shape of the path -------------------------------------------------------------------


def along(poses: Array, way: Array, is_closed: bool) -> Array:
    """Return the poses (k, 3) that the newest of poses (P, 3) has where the path aligns with a way (n, 2).

    The path, continued straight ahead, is aligned rigidly (Umeyama 1991) with each stretch of the way, whose
    points are `ROAD_STEP` apart. The best shape is first.
    """
    length = path_lengths(poses)
    offsets = np.arange(-min(int(length[-1] / ROAD_STEP), len(way) - 1 - STEPS_AHEAD), STEPS_AHEAD + 1)
    at = length[-1] + ROAD_STEP * offsets
    x, y = (np.interp(at, length, axis) for axis in poses[:, :2].T)
    path = x + 1j * y + np.maximum(ROAD_STEP * offsets, 0.0) * np.exp(1j * poses[-1, 2])
    ends, around = np.arange(len(way)), way @ np.array([1.0, 1j])
    if not is_closed:
        ends = ends[-offsets[0] : len(way) - STEPS_AHEAD]
    target = around[(ends[:, None] + offsets) % len(way)]
    mean, means = path.mean(), target.mean(axis=1)
    turn = ((path - mean).conj() * (target - means[:, None])).sum(axis=1)
    turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
    misfit = np.sqrt((np.abs(turn[:, None] * (path - mean) - (target - means[:, None])) ** 2).mean(axis=1))
    newest = turn * (poses[-1, :2] @ np.array([1.0, 1j]) - mean) + means
    found = np.column_stack([newest.real, newest.imag, np.angle(turn) + poses[-1, 2]])
    order = [i for i in np.argsort(misfit, kind="stable").tolist() if misfit[i] < MISFIT_OF_WAY]
    return found[_spread(ends[order], len(way) if is_closed else None, order)]


def _spread(ends: IntArray, around: int | None, order: list[int]) -> list[int]:
    """Return those of an order (k,), the first ones first, whose ends (k,) are apart along the way."""
    chosen, taken = list[int](), np.zeros(0)
    for end, i in zip(ends.tolist(), order, strict=True):
        away = np.abs(taken - end)
        if around is not None:
            away = np.minimum(away, around - away)
        if (away * ROAD_STEP >= HYPOTHESES_APART).all():
            chosen.append(i)
            taken = np.append(taken, end)
        if len(chosen) == MOST_HYPOTHESES:
            break
    return chosen


@dataclass(frozen=True, eq=False)
class KnownRoad:
    """A known road: what is seen on it, and the way along it."""

    seen: Known  # its cones, or its curves where it has none
    way: Array  # (n, 2) points of its middle in driving order, `ROAD_STEP` apart
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
        at = np.linspace(0.0, length[-1], max(round(length[-1] / ROAD_STEP), 1) + 1)
        way = np.column_stack([np.interp(at, length, axis) for axis in middle.T])
        closed = all(spline.periodic for spline in splines.values())
        return cls(seen, way[:-1] if closed else way, closed)

    def along(self, poses: Array) -> Prior:
        """Return the prior of the newest of poses (P, 3), wherever the path fits by its shape."""
        return Prior.about(along(poses, self.way, self.closed), *AT_HYPOTHESIS, failed=0.0)

    def backwards(self) -> Self:
        """Return the same road driven the other way, on which left is right."""
        other = {LEFT: RIGHT, RIGHT: LEFT}
        return replace(self, seen=self.seen.relabelled(other), way=self.way[::-1])
