"""How far cones stand off the curves: those that were sighted, and those that never were."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from .cones import FEWEST, FOLD, cone_clusters, path_begin
from .knots import fit_through

Array = NDArray[np.float64]

FOLDS = 4
"""Every so-manieth cone is left out at a time: its neighbours never are."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """What a curve of so few control points doesn't follow, as a variance to be added to its own.

    `sigma^2(u) = seen^2 + (d / s)^2 (unseen^2 - seen^2)`, d the distance along the curve from u to the
    nearest cone that was sighted, s the usual distance of two of them. Where a cone was seen, the curve
    passes it by `seen`. A cone that was never seen, d = s, it passes by as much as those that were, if they
    are left out where knots are chosen and the curve is fitted: cross-validation. Without this the claimed
    covariance is right at cones that were seen, and several times too small at the others.
    """

    seen: float
    """Root mean square distance (m) of the sighted cones, each the mean of its readings, from the curves."""
    unseen: float
    """The same from a curve that is chosen and fitted without them, m."""
    places: dict[int, Array]
    """Of each boundary the parameters (k,) of its sighted cones."""
    lengths: dict[int, float]
    """Of each boundary the curve's length, where it closes, in parameter units; else infinite."""

    def sigma(self, label: int, u: Array) -> Array:
        """(m,) standard deviation (m) at parameters (m,) of a boundary."""
        places = self.places.get(label, np.zeros(0))
        if len(places) < 2:
            return np.full(len(u), self.unseen)
        away = np.abs(u[:, None] - places)
        length = self.lengths[label]
        if np.isfinite(length):
            away = np.mod(away, length)
            away = np.minimum(away, length - away)
        share = away.min(axis=1) / np.median(np.diff(np.sort(places)))
        return np.asarray(np.sqrt(self.seen**2 + share**2 * max(self.unseen**2 - self.seen**2, 0.0)))


def scatter_of_cones(state: State, detections: DetectionTable, settings: MapperSettings) -> Scatter:
    """How far the sighted cones stand off the curves that the state has, and off curves without them."""
    seen, unseen = [np.zeros(0)], [np.zeros(0)]
    places, lengths = {}, {}
    for label, boundary in state.boundaries.items():
        cones = cone_clusters(state, detections, label, settings)
        near = path_begin(state, label) + cones.u
        foot = boundary.find(state.control_points(label), cones.points, near - FOLD, near + FOLD)
        seen.append(foot.distance)
        unseen.append(left_out(cones.points, boundary.periodic, settings, boundary.size / max(len(near), 1)))
        places[label] = foot.u
        lengths[label] = boundary.length if boundary.periodic else np.inf
    return Scatter(_rms(np.concatenate(seen)), _rms(np.concatenate(unseen)), places, lengths)


def left_out(points: Array, periodic: bool, settings: MapperSettings, share: float) -> Array:
    """(k,) distances (m) of cones (k, 2) from curves of so many control points by cones, made without them.

    The first and the last cone of an open curve are never left out: nothing is known beyond them.
    """
    number = np.arange(len(points))
    ends = np.zeros(len(points), bool) if periodic else (number == 0) | (number == len(points) - 1)
    distances = [np.zeros(0)]
    for fold in range(FOLDS):
        out = (number % FOLDS == fold) & ~ends
        if (~out).sum() < FEWEST:
            continue
        spline = fit_through(points[~out], periodic, settings, share)
        low, high = spline.domain
        feet = foot_points(
            spline.tables,
            spline.control_points,
            points[out],
            np.full(out.sum(), low),
            np.full(out.sum(), high),
            settings.spline.search_step,
        )
        distances.append(np.minimum(np.abs(feet.distance), settings.gate.rough))
    return np.concatenate(distances)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
