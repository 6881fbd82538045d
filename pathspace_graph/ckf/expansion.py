"""Expands the clamped curves by detections beyond their ends (paper: Expansion)."""

from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotated, rotation, to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.path import (
    CARRIED_TO,
    END_BEHIND,
    MIN_CARRY,
    MIN_LATERAL,
    SIDES,
    STATION_MARGIN,
    STRANDED,
    Candidates,
    End,
    PathAhead,
    chain,
)
from pathspace_graph.mapping.tentative import TentativeTracks, nearest_within
from pathspace_graph.settings.batch import CkfSettings
from pathspace_graph.settings.mapper import MapperSettings

from .state import CurveState

STRETCH: Final = 12.0
"""An extension is at most this long (m), so a longer one takes several."""
SIGMA_CARRY: Final = 1.0
"""Standard deviation (m) of the control point that carries on a stranded end along the path."""
RECENT: Final = 40
"""A confirmed track is compared with this many of the last cones, not with those of the lap's beginning."""
AT_END: Final = 1e-6
"""A foot point within this distance (m) of the end's parameter is at the end."""


class Expansion:
    """What was detected beyond the curves, which expands them.

    The paper's front end has no false detections. Here a detection expands a curve only if it belongs to a
    confirmed track that comes next along the path. An end that the vehicle has passed is extended beside the
    path, as in the other estimators.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.tentative = {label: TentativeTracks(settings.growth) for label in BOUNDARIES}
        """Tracks of all recent detections, by label."""
        self.observed: dict[int, list[Array]] = {label: [] for label in BOUNDARIES}
        """All distinct cones that were confirmed, as points (2,) in m, map frame, by label."""
        self._carried = dict.fromkeys(BOUNDARIES, 0.0)  # lengths (m) since the last cone

    def observe(self, state: CurveState, detections: Detections) -> None:
        """Add all detections of a cycle to the tracks, and newly confirmed ones to the observed cones."""
        points = to_map(detections.points_vehicle, state.pose[None])
        covariances = rotated(detections.covariances, np.full(len(points), state.pose[2]))
        for label, tentative in self.tentative.items():
            same = detections.labels == label
            tentative.add(points[same], covariances[same], detections.t)
            known, radius = self.observed[label], self.settings.growth.merge_radius
            for point in tentative.points[tentative.confirmed()]:
                if not known or np.hypot(*(np.array(known[-RECENT:]) - point).T).min() > radius:
                    known.append(point.copy())

    def expand(
        self, state: CurveState, detections: Detections, path_ahead: PathAhead, free: BoolArray
    ) -> set[int]:
        """Begin or extends each curve by detections that update none (`free` (m,)).

        Returns the labels of the curves that were extended.
        """
        extended: set[int] = set()
        for label in BOUNDARIES:
            rows = np.flatnonzero(free & (detections.labels == label))
            found = self._candidates(state, label, detections, rows, path_ahead)
            if label not in state.curves:
                self._begin(state, label, detections, found)
            elif self._extend(state, label, detections, found):
                extended.add(label)
                self._carried[label] = 0.0
            elif self._carry_on(state, label, path_ahead):
                extended.add(label)
        return extended

    def _candidates(
        self, state: CurveState, label: int, detections: Detections, rows: IntArray, path_ahead: PathAhead
    ) -> Candidates:
        """Return the detections `rows` of confirmed tracks that come next along the path."""
        settings, tentative = self.settings.growth, self.tentative[label]
        points = to_map(detections.points_vehicle[rows], state.pose[None])
        confirmed = tentative.points[self._undisputed(label, tentative.confirmed())]
        near = nearest_within(points, confirmed, settings.merge_radius)[1]
        stations, lateral = path_ahead.locate(points)
        found = Candidates(points, rows, stations, SIDES[label] * lateral)
        found = found.where(near & (stations <= path_ahead.stations[-1]) & (found.sides > 0.0))
        found = found.where(np.argsort(found.stations))
        end = None
        if label in state.curves:
            end = _end(state, label, path_ahead, END_BEHIND)
            found = found.where(self._beyond(state, label, found, end)) if len(found.points) else found
        return found.where(chain(found, end))

    def _undisputed(self, label: int, indices: IntArray) -> IntArray:
        """Return the tracks that do not have more detections with another label around them."""
        tracks = self.tentative[label]
        votes = tracks.counts[indices].astype(np.float64)
        for other in (self.tentative[b] for b in BOUNDARIES if b != label):
            offset = tracks.points[indices, None] - other.points
            near = np.hypot(offset[..., 0], offset[..., 1]) < self.settings.growth.merge_radius
            votes -= near @ other.counts
        return indices[votes >= 0.0]

    def _beyond(self, state: CurveState, label: int, found: Candidates, end: End) -> BoolArray:
        """Return which candidates (m,) meet the paper's three conditions, and lie ahead of the end."""
        foot = state.foot_points(label, found.points, *_last_stretch(state, label, len(found.points)))
        high, control_points = state.curves[label].domain[1], state.control_points(label)
        ahead = found.stations > end.station + STATION_MARGIN
        return ahead & beyond_end(found.points, foot.u, high, control_points, self.settings.ckf)

    def _begin(self, state: CurveState, label: int, detections: Detections, found: Candidates) -> None:
        """Begin a curve along at least two candidates."""
        found = found.where(found.sides < self.settings.growth.max_lateral)
        if len(found.points) > 1:
            rows = found.indices
            state.begin(label, detections.points_vehicle[rows], self._covariances(detections, rows))

    def _extend(self, state: CurveState, label: int, detections: Detections, found: Candidates) -> bool:
        """Extend a curve to the last candidate of the proximity chain; return whether there is any.

        Where one extension would be longer than `STRETCH`, it is first extended to a candidate before.
        """
        if len(found.points) == 0:
            return False
        order = proximity_chain(found.points, _end_position(state, label))
        points, rows = found.points[order], found.indices[order]
        covariances = self._covariances(detections, rows)
        last = _end_position(state, label)
        for i in range(len(rows)):
            final = i == len(rows) - 1
            too_far = not final and np.hypot(*(points[i + 1] - last)) > STRETCH
            if final or (too_far and np.hypot(*(points[i] - last)) > self.settings.ckf.threshold):
                state.extend(label, detections.points_vehicle[rows[i]], covariances[i])
                last = points[i]
        return True

    def _covariances(self, detections: Detections, rows: IntArray) -> Array:
        """Return the covariances (k, 2, 2) of detections as points of the curve, vehicle frame."""
        model = self.settings.ckf.sigma_model**2 * np.eye(2)
        return np.asarray(detections.covariances[rows] + model)

    def _carry_on(self, state: CurveState, label: int, path_ahead: PathAhead) -> bool:
        """Extend a curve whose end the vehicle has passed beside the path, nearly as far as the vehicle.

        It is carried on by at most `growth.max_unseen`. Returns whether the curve was extended.
        """
        settings = self.settings.growth
        end = _end(state, label, path_ahead, END_BEHIND)
        if end.station >= path_ahead.driven - STRANDED:
            return False
        side = SIDES[label] * max(end.side, MIN_LATERAL)
        point = path_ahead.beside(path_ahead.driven - CARRIED_TO, side)
        distance = float(np.hypot(*(point - end.position)))
        if not MIN_CARRY <= distance <= settings.max_unseen - self._carried[label]:
            return False
        self._carried[label] += distance
        point_vehicle = (point - state.pose[:2]) @ rotation(state.pose[2])
        state.extend(label, point_vehicle, SIGMA_CARRY**2 * np.eye(2))
        return True


def beyond_end(
    points: Array, u: Array, high: float, control_points: Array, settings: CkfSettings
) -> BoolArray:
    """Return which points (m, 2) with foot points at u (m,) meet the paper's three conditions (m,).

    The foot point is the end of the curve, at the parameter `high`; the point is farther from `C_n` than the
    growth threshold, and farther from `C_{n-1}` than the separation.
    """
    at_end = u >= high - AT_END
    far = np.hypot(*(points - control_points[-1]).T) > settings.threshold
    apart = np.hypot(*(points - control_points[-2]).T) > settings.separation
    return np.asarray(at_end & far & apart)


def proximity_chain(points: Array, start: Array) -> IntArray:
    """Return the order (k,) of points (k, 2), each the nearest to the last; it begins at `start` (2,)."""
    remaining, order, last = list(range(len(points))), [], start
    while remaining:
        distances = np.hypot(*(points[remaining] - last).T)
        order.append(remaining.pop(int(distances.argmin())))
        last = points[order[-1]]
    return np.array(order, np.intp)


def _last_stretch(state: CurveState, label: int, count: int) -> tuple[Array, Array]:
    """Return the limits (count,) of the visible stretch of an open curve, prolonged to its end."""
    high = state.curves[label].domain[1]
    low, _ = state.visible_range(label, count)
    return np.minimum(low, high), np.full(count, high)


def _end_position(state: CurveState, label: int) -> Array:
    """Return S(1) (2,), which is the last control point of a clamped curve."""
    return np.array(state.control_points(label)[-1])


def _end(state: CurveState, label: int, path_ahead: PathAhead, behind: float) -> End:
    """Return the end of a curve relative to the path from `behind` (m) before the vehicle on."""
    position = _end_position(state, label)
    station, lateral = path_ahead.since(path_ahead.driven - behind).locate(position[None])
    return End(position, float(station[0]), SIDES[label] * float(lateral[0]))
