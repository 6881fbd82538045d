"""Mending: the curves of a closed map are led through cones that contradict them, and the drive solved again.

The poses are right: the vehicle is held by the other boundary and by the stretches before and after. So the
batch of the whole drive begins at these poses, with curves that lead through the cones that were seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.batch.association import path_lengths
from pathspace_graph.batch.lap import ClosedMap, LapMarginal
from pathspace_graph.batch.simplification import fit_through
from pathspace_graph.factors.se2 import to_map, to_vehicle
from pathspace_graph.labels import NAMES
from pathspace_graph.mapping.curve_map import CurveMap, CurveSmoother
from pathspace_graph.mapping.path import along_and_across
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.crossing import sampled

from .contradictions import Contradictions, Stretch
from .finding import KnownLoop

Array = NDArray[np.float64]

MENDED = "the map was mended"
"""This begins the notice of a cycle in which curves that were led anew take the place of the old ones."""


class Mending:
    """Notices that a closed map is contradicted, and begins and judges the batch that mends it."""

    def __init__(self, smoother: CurveSmoother) -> None:
        self.settings = smoother.map.settings.mending
        self.contradictions = Contradictions(smoother.map.settings)
        """These are the detections that no curve explains."""
        self._smoother = smoother
        self._stretches: list[Stretch] = []
        self._lap: Array = np.zeros((0, 3))  # the poses of the newest lap as the attempt began
        self._asked = -np.inf
        self._wait_until = 0.0
        self._attempts = 0

    def is_due(self, known: KnownLoop, driven: float) -> bool:
        """Returns whether the closed map is contradicted, after a path of this length (m)."""
        t = self._smoother.times[-1]
        if t < self._asked + self.settings.interval or driven < self._wait_until:
            return False
        self._asked = t
        if self._attempts >= self.settings.attempts:
            return False
        loop = known.get()
        self._stretches = self.contradictions.stretches(loop, t)
        if self._stretches:
            self._attempts, self._wait_until = self._attempts + 1, driven + loop.length
        return bool(self._stretches)

    def begin(self, poses: Array) -> ClosedMap:
        """Returns the map that the batch of the drive begins with, whose curves are led anew.

        The poses (P, 3) are those of all cycles, in the map frame.
        """
        self._smoother.refresh()
        state = self._smoother.map.state
        lengths = [boundary.length for boundary in state.boundaries.values()]
        self._lap = poses[lap_begin(poses, max(lengths)) :]
        splines = {
            label: led_through(self._smoother.map, label, self._stretches, poses)
            for label in state.boundaries
        }
        return ClosedMap(splines, poses, state.variables.calibrations.copy())

    def is_tried(self) -> bool:
        """Returns whether the batch that is under way mends a map, rather than closing it."""
        return bool(self._stretches)

    def end(self, marginal: LapMarginal | str) -> str:
        """Ends an attempt; returns the notice of a map that explains the contradictions, or an empty one."""
        stretches, self._stretches = self._stretches, []
        if isinstance(marginal, str):
            return ""
        label, cones = _cones(stretches)
        end = len(marginal.poses)
        cones = carried(cones, self._lap, marginal.poses[end - len(self._lap) :])
        distance = np.full(len(cones), np.inf)
        for own, spline in marginal.splines.items():
            curve = KDTree(sampled(spline, self.settings.sample))
            distance[label == own] = curve.query(cones[label == own])[0]
        explained = distance < self.settings.beside
        if explained.mean() < self.settings.explained:
            return ""
        self._wait_until = 0.0
        self.contradictions.clear()
        names = [name for number, name in enumerate(NAMES) if (label[explained] == number).any()]
        return f"{MENDED}: {int(explained.sum())} more cones on the {' and on the '.join(names)} lie on it"


def _cones(stretches: list[Stretch]) -> tuple[NDArray[np.intp], Array]:
    """Returns the label (k,) and the place (k, 2) of each cone of stretches."""
    labels = np.repeat([one.label for one in stretches], [len(one.cones) for one in stretches])
    return labels, np.concatenate([one.cones for one in stretches])


def carried(points: Array, before: Array, after: Array) -> Array:
    """Returns points (k, 2), each moved as the pose next to it has moved, from `before` to `after` (n, 3)."""
    nearest = KDTree(before[:, :2]).query(points)[1]
    return to_map(to_vehicle(points, before[nearest]), after[nearest])


def led_through(track: CurveMap, label: int, stretches: list[Stretch], poses: Array) -> BSpline:
    """Returns the closed curve of a boundary, led through the cones of its stretches.

    The cones of the curve are in the order in which the newest lap of the poses (P, 3) passes them. Those
    that lie beside a row of the stretches' cones, or are one of them, are removed.
    """
    state, settings = track.state, track.settings
    own = [stretch for stretch in stretches if stretch.label == label]
    if not own:
        return state.spline(label)
    boundary = state.boundaries[label]
    u = track.cones.get(label, np.arange(boundary.tables.low, boundary.tables.high, settings.spline.spacing))
    cones = boundary.evaluate(state.control_points(label), u)
    lap, stations = newest_lap(poses, boundary.length)
    at = along_and_across(cones, lap, stations)[0]
    for stretch in own:
        new_at = along_and_across(stretch.cones, lap, stations)[0]
        kept = ~_is_replaced(cones, at, stretch.cones, new_at, settings)
        cones, at = np.concatenate([cones[kept], stretch.cones]), np.append(at[kept], new_at)
    if len(cones) < settings.spline.min_size:
        return state.spline(label)
    return fit_through(cones[np.argsort(at)], True, settings, settings.batch.dense_share)


def newest_lap(poses: Array, length: float) -> tuple[Array, Array]:
    """Returns the positions (n, 2) on the newest lap of poses (P, 3), the first one again at the end.

    It begins at the place nearest to the newest pose about a lap of this length (m) before. The stations (n,)
    of the positions along it are returned, too.
    """
    first = lap_begin(poses, length)
    lap = np.concatenate([poses[first:, :2], poses[first : first + 1, :2]])
    return lap, path_lengths(lap)


def lap_begin(poses: Array, length: float) -> int:
    """Returns the index of the pose (P, 3) nearest to the newest one, about a lap of a length (m) before."""
    driven = path_lengths(poses)
    before = np.flatnonzero(np.abs(driven[-1] - driven - length) < 0.5 * length)
    away = np.hypot(*(poses[before, :2] - poses[-1, :2]).T)
    return int(before[away.argmin()]) if len(before) else 0


def _is_replaced(
    cones: Array, at: Array, row: Array, row_at: Array, settings: MapperSettings
) -> NDArray[np.bool_]:
    """Returns which cones (k, 2) at stations (k,) are those of a row (r, 2), or lie beside it."""
    order, beside = np.argsort(row_at), settings.mending.beside
    away = np.abs(along_and_across(cones, row[order], row_at[order])[1])
    within = (at > row_at.min() - beside) & (at < row_at.max() + beside)
    same = KDTree(row).query(cones)[0] < settings.growth.merge_radius
    return np.asarray(same | (within & (away > beside)))
