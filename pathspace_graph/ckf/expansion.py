"""Expansion of the clamped curves by readings beyond their ends (paper: Expansion)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.candidates import SIDES, Candidates, End, chain
from pathspace_graph.mapping.path import PathAhead
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.mapper import MapperSettings

from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

RECENT: Final = 40
"""A sighting is compared with so many of the last cones, not with those of the lap's beginning."""
AT_END: Final = 1e-6
"""A foot point this near to the end's parameter (m) is the end."""


class Expansion:
    """What was sighted, and what the curves are led on to.

    The paper's front end has no false detections. Here a reading expands a curve only where something was
    seen again and again, and comes next along the way driven; and an end that the vehicle has passed is
    carried on beside the way, as in the other estimators.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.tentative = {label: TentativeTracks(settings.growth) for label in BOUNDARIES}
        """Everything seen lately, by colour."""
        self.observed: dict[int, list[Array]] = {label: [] for label in BOUNDARIES}
        """Every distinct cone that was seen often enough, (2,), map frame."""

    def observe(self, state: CurveState, detections: Detections) -> None:
        """All readings of a cycle."""
        points = to_map(detections.points_vehicle, np.tile(state.pose, (len(detections.labels), 1)))
        variances = np.trace(detections.covariances, axis1=1, axis2=2)
        for label, tentative in self.tentative.items():
            of = detections.labels == label
            tentative.add(points[of], variances[of], detections.t)
            known, radius = self.observed[label], self.settings.growth.merge_radius
            for point in tentative.points[tentative.confirmed()]:
                if not known or np.hypot(*(np.array(known[-RECENT:]) - point).T).min() > radius:
                    known.append(point.copy())

    def expand(
        self, state: CurveState, detections: Detections, path_ahead: PathAhead, free: NDArray[np.bool_]
    ) -> set[int]:
        """Begin each curve or lead it on, by readings that no curve takes (`free` (m,)); gives the grown."""
        grown: set[int] = set()
        for label in BOUNDARIES:
            rows = np.flatnonzero(free & (detections.labels == label))
            found = self._candidates(state, label, detections, rows, path_ahead)
            if label not in state.curves:
                self._begin(state, label, detections, found)
            elif self._extend(state, label, detections, found) or self._carry_on(state, label, path_ahead):
                grown.add(label)
        return grown

    def _candidates(
        self, state: CurveState, label: int, detections: Detections, rows: IntArray, path_ahead: PathAhead
    ) -> Candidates:
        """Readings of trusted sightings that come next along the way; their indices are the cycle's rows."""
        settings, tentative = self.settings.growth, self.tentative[label]
        points = to_map(detections.points_vehicle[rows], np.tile(state.pose, (len(rows), 1)))
        trusted = tentative.points[self._undisputed(label, tentative.confirmed())]
        offset = points[:, None] - trusted[None]
        near = np.hypot(offset[..., 0], offset[..., 1]).min(axis=1, initial=np.inf) < settings.merge_radius
        stations, lateral = path_ahead.locate(points)
        found = Candidates(points, rows, stations, SIDES[label] * lateral)
        found = found.where(near & (stations <= path_ahead.stations[-1]) & (found.sides > 0.0))
        found = found.where(np.argsort(found.stations))
        end = None
        if label in state.curves:
            end = _end(state, label, path_ahead, self.settings.growth.end_behind)
            found = found.where(self._beyond(state, label, found, end)) if len(found.points) else found
        return found.where(chain(found, settings, end))

    def _undisputed(self, label: int, indices: IntArray) -> IntArray:
        """Those sightings that aren't seen oftener in another colour, as in the other estimators."""
        own, votes = self.tentative[label], self.tentative[label].counts[indices].astype(np.float64)
        for other in (self.tentative[b] for b in BOUNDARIES if b != label):
            offset = own.points[indices, None] - other.points
            near = np.hypot(offset[..., 0], offset[..., 1]) < self.settings.growth.merge_radius
            votes -= near @ other.counts
        return indices[votes >= 0.0]

    def _beyond(self, state: CurveState, label: int, found: Candidates, end: End) -> NDArray[np.bool_]:
        """The paper's three conditions: nearest to the end, far enough from it, and from C_{n-1}."""
        settings, curve = self.settings.ckf, state.curves[label]
        high = np.full(len(found.points), curve.domain[1])
        foot = state.find(label, found.points, *_last_stretch(state, label, len(found.points)))
        at_end = foot.u >= high - AT_END
        far = np.hypot(*(found.points - end.position).T) > settings.threshold
        apart = np.hypot(*(found.points - state.control_points(label)[-2]).T) > settings.separation
        ahead = found.stations > end.station + self.settings.growth.station_margin
        return np.asarray(at_end & far & apart & ahead)

    def _begin(self, state: CurveState, label: int, detections: Detections, found: Candidates) -> None:
        """A new curve along the first readings."""
        found = found.where(found.sides < self.settings.growth.max_lateral)
        if len(found.points) > 1:
            rows = found.indices
            state.begin(label, detections.points_vehicle[rows], self._covariances(detections, rows))

    def _extend(self, state: CurveState, label: int, detections: Detections, found: Candidates) -> bool:
        """Lead the end on to the last of the proximity chain; over others where that is too far at once."""
        if len(found.points) == 0:
            return False
        ckf = self.settings.ckf
        order = proximity_chain(found.points, _end_position(state, label))
        points, rows = found.points[order], found.indices[order]
        covariances = self._covariances(detections, rows)
        last = _end_position(state, label)
        for i in range(len(rows)):
            final = i == len(rows) - 1
            too_far = not final and np.hypot(*(points[i + 1] - last)) > ckf.stretch
            if final or (too_far and np.hypot(*(points[i] - last)) > ckf.threshold):
                state.extend(label, detections.points_vehicle[rows[i]], covariances[i])
                last = points[i]
        return True

    def _covariances(self, detections: Detections, rows: IntArray) -> Array:
        """(k, 2, 2) of readings as places on the curve, vehicle frame."""
        model = self.settings.ckf.sigma_model**2 * np.eye(2)
        return np.asarray(detections.covariances[rows] + model)

    def _carry_on(self, state: CurveState, label: int, path_ahead: PathAhead) -> bool:
        """The vehicle has passed a stranded end: lead it beside the way nearly as far as the vehicle is."""
        settings = self.settings.growth
        end = _end(state, label, path_ahead, settings.end_behind)
        if end.station >= path_ahead.driven - settings.stranded:
            return False
        side = SIDES[label] * max(end.side, settings.min_lateral)
        point = path_ahead.beside(path_ahead.driven - settings.stranded_left * settings.stranded, side)
        if np.hypot(*(point - end.position)) < settings.min_carry:
            return False
        local = (point - state.pose[:2]) @ rotation(state.pose[2])
        state.extend(label, local, self.settings.ckf.sigma_carry**2 * np.eye(2))
        return True


def proximity_chain(points: Array, start: Array) -> IntArray:
    """Order (k,) of points (k, 2): the one nearest to `start` (2,), then always the nearest to the last."""
    left, order, last = list(range(len(points))), [], start
    while left:
        distances = np.hypot(*(points[left] - last).T)
        order.append(left.pop(int(distances.argmin())))
        last = points[order[-1]]
    return np.array(order, np.intp)


def _last_stretch(state: CurveState, label: int, count: int) -> tuple[Array, Array]:
    """Limits (count,) of what the vehicle sees of an open curve, as far as its end."""
    high = state.curves[label].domain[1]
    low, _ = state.visible(label, count)
    return np.minimum(low, high), np.full(count, high)


def _end_position(state: CurveState, label: int) -> Array:
    """S(1) (2,), which is the last control point of a clamped curve."""
    return np.array(state.control_points(label)[-1])


def _end(state: CurveState, label: int, path_ahead: PathAhead, behind: float) -> End:
    """The end of a curve, beside the latest stretch of the way, from `behind` (m) on."""
    position = _end_position(state, label)
    station, lateral = path_ahead.since(path_ahead.driven - behind).locate(position[None])
    return End(position, float(station[0]), SIDES[label] * float(lateral[0]))
