"""The Hungarian landmark graph online: cones as points in the mapper's own smoother."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.projection import to_map
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.prediction import smoother_settings
from pathspace_graph.mapping.registration import near_start
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings

from .association import NONE, PLANE
from .closing import merge, optimize_loop, recognize
from .landmark_map import LandmarkMap
from .prediction import assign
from .state import LandmarkState
from .tentative import detected_by, duplicates

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class LandmarkFixedLag:
    """Maps cones as points: predict, associate, create, update, close, marginalize.

    Window, odometry and robust weights are those of `FixedLagMapper`; a reading is held against the one
    landmark that it is of. `odometry_sigma` (3,): standard deviation of a twist reading (m/s, m/s,
    rad/s).
    """

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)
        self.smoother = FixedLagSmoother(smoother_settings(self.settings), LandmarkMap(self.settings))
        """What is estimated, and from what."""
        self.smoother.window.exact = True
        self.path = DrivenPath(self.settings.path)
        """The way driven."""
        self.tentative = {label: TentativeTracks(self.settings.growth) for label in BOUNDARIES}
        """What isn't a landmark yet."""
        self.closed = False
        """Whether the loop has closed."""
        self._last_seen: Array = np.zeros(0)  # by number, path driven (m) when each landmark was seen last
        self._tried = 0.0

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """One perception cycle: the twists since the last one, and what was detected now."""
        watch = Stopwatch()
        durations = np.diff(np.append(odometry.t, detections.t))
        driven = integrate_twists(durations, odometry.twist, self.odometry_sigma)
        self.path.update(self.smoother.drive(detections.t, driven, self.settings.odometry.sigmas_start))
        watch.lap("predict")
        new = self.smoother.map.detections.append(detections, self.smoother.next_cycle - 1)
        assign(self.smoother, new, self._open_to_detections())
        watch.lap("associate")
        created = self._create(new, detections.t)
        watch.lap("create")
        for _ in range(self.settings.steps_grown if created else self.settings.steps):
            self.smoother.step()
        watch.lap("update")
        self._look_back()
        watch.lap("close")
        self.smoother.marginalize()
        watch.lap("marginalize")
        return self._result(detections.t, watch.laps)

    def _create(self, new: slice, t: float) -> bool:
        """Readings of no landmark are sightings; those seen often enough become landmarks. True if any."""
        detections, created = self.smoother.map.detections, False
        rows = new.start + np.flatnonzero(detections.landmark[new] == NONE)
        for label, tentative in self.tentative.items():
            of = rows[detections.label[rows] == label]
            points = to_map(detections.point[of], self.smoother.variables.poses_at(detections.cycle[of]))
            tentative.add(points, np.trace(detections.covariance[of], axis1=1, axis2=2), t)
            confirmed = tentative.confirmed()
            if len(confirmed):
                self._found(label, tentative.points[confirmed].copy())
                tentative.remove(confirmed)
                created = True
        return created

    def _found(self, label: int, points: Array) -> None:
        """New landmarks at points (k, 2) that readings in the window saw; those readings are of them."""
        detections, state = self.smoother.map.detections, self.smoother.map.state
        rows = np.flatnonzero((detections.label == label) & (detections.landmark == NONE))
        cycles = detections.cycle[rows]
        seen = to_map(detections.point[rows], self.smoother.variables.poses_at(cycles))
        chosen, which = detected_by(seen, cycles, points, self.settings.growth)
        held, which = np.unique(which, return_inverse=True)  # nothing would hold the others
        numbers = state.add(points[held], np.full(len(held), label, np.intp))[which]
        detections.take(rows[chosen], numbers)
        state.vote(detections.label[rows[chosen]], numbers)

    def _open_to_detections(self) -> NDArray[np.bool_]:
        """(n,) landmarks that readings may be of: until the loop has closed, near the start not the old ones.

        Drift is common to all that is seen: there one reading alone can't tell which old landmark it is of.
        """
        everything = np.ones(len(self.smoother.map.state), bool)
        return everything if self.closed or not self._near_start() else ~self._old()

    def _near_start(self) -> bool:
        return near_start(self.path, self.smoother.variables.poses[-1], self.settings.closing)

    def _old(self) -> NDArray[np.bool_]:
        last_seen = self._last_seen[self.smoother.map.state.numbers]
        return np.asarray(last_seen < self.path.length - self.settings.landmark.unseen)

    def _look_back(self) -> None:
        """Every few metres: close the loop where old landmarks are seen, then merge what is one cone."""
        detections, state, length = self.smoother.map.detections, self.smoother.map.state, self.path.length
        seen = np.unique(detections.landmark[detections.used])
        self._last_seen = np.append(self._last_seen, np.zeros(state.born - len(self._last_seen)))
        self._last_seen[seen] = length
        if length - self._tried < self.settings.closing.check_interval:
            return
        self._tried = length
        if self.closed:
            covariance = self.smoother.last_covariance
            self._merge(*duplicates(state, len(state), covariance, self.settings))
        elif self._near_start():
            settings = self.settings.closing
            reach = settings.radius + settings.drift * length
            pairs = recognize(self.smoother, state.positions(seen), np.flatnonzero(self._old()), reach)
            if pairs is not None:
                optimize_loop(self.smoother, pairs)
                self._merge(pairs.first, pairs.second)
                self.closed, self.smoother.window.exact = True, False

    def _merge(self, first: IntArray, second: IntArray) -> None:
        if len(first) == 0:
            return
        numbers = self.smoother.map.state.numbers
        np.maximum.at(self._last_seen, numbers[second], self._last_seen[numbers[first]])
        merge(self.smoother, first, second)

    def _result(self, t: float, stages: dict[str, float]) -> CycleResult:
        detections, state = self.smoother.map.detections, self.smoother.map.state
        used = int((detections.used & (detections.cycle == self.smoother.next_cycle - 1)).sum())
        left, right = (int((state.labels == label).sum()) for label in (LEFT, RIGHT))
        pose = self.smoother.variables.poses[-1].copy()
        return CycleResult(t, pose, (left, right), used, self.closed, stages)

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's landmarks."""
        state = self.smoother.map.state
        if len(state) == 0:
            return Map(self.closed, {})
        return point_map(state, self.smoother.last_covariance(state.keys), self.closed)


def point_map(state: LandmarkState, joint: Array, closed: bool) -> Map:
    """The landmarks by colour, each boundary's with its block of their joint covariance (2 n, 2 n)."""
    boundaries = {}
    for label in BOUNDARIES:
        of = np.flatnonzero(state.labels == label)
        if len(of):
            columns = (PLANE * of[:, None] + np.arange(PLANE)).ravel()
            boundaries[label] = PointBoundary(state.landmarks[of].copy(), joint[np.ix_(columns, columns)])
    return Map(closed, boundaries)
