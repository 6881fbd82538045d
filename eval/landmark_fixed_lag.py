"""The Hungarian landmark graph online: cones as points, the mapper's own smoother, odometry and gates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.closing import near_start
from pathspace_graph.factors.projection import to_map
from pathspace_graph.fixed_lag import ODOMETRY_SIGMA, CycleResult
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.log import Detections, Odometry
from pathspace_graph.map import Map, PointBoundary
from pathspace_graph.path import DrivenPath
from pathspace_graph.settings import MapperSettings
from pathspace_graph.sightings import Sightings
from pathspace_graph.stopwatch import Stopwatch

from .landmark_association import NONE, PLANE
from .landmark_closing import Pairs, bend, duplicates, merge, recognize
from .landmark_gating import assign
from .landmark_sightings import sighted_by
from .landmark_state import LandmarkState
from .landmark_window import LandmarkSmoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class LandmarkFixedLag:
    """Maps cones as points: predict, associate, create, update, close, marginalize.

    State, window, odometry and robust weights are those of `FixedLagMapper`; a reading is held against the
    one landmark that it is of. `odometry_sigma` (3,): standard deviation of a twist reading (m/s, m/s,
    rad/s).
    """

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)
        self.smoother = LandmarkSmoother(self.settings)
        """What is estimated, and from what."""
        self.path = DrivenPath(self.settings.path)
        """The way driven."""
        self.sightings = {label: Sightings(self.settings.growth) for label in BOUNDARIES}
        """What isn't a landmark yet."""
        self.closed = False
        """Whether the loop has closed."""
        self._last_seen: Array = np.zeros(0)  # (n,) path driven (m) when each landmark was seen last
        self._tried = 0.0

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """One perception cycle: the twists since the last one, and what was detected now."""
        watch = Stopwatch()
        self.path.update(self.smoother.drive(odometry, detections.t, self.odometry_sigma))
        watch.lap("predict")
        new = self.smoother.add_readings(detections)
        assign(self.smoother, new, self._open_to_readings())
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
        readings, created = self.smoother.readings, False
        rows = np.arange(new.start, new.stop)
        rows = rows[~readings.used[rows] & (readings.landmark[rows] == NONE)]
        for label, sightings in self.sightings.items():
            of = rows[readings.label[rows] == label]
            points = to_map(readings.point[of], self.smoother.state.poses[readings.slot[of]])
            sightings.add(points, np.trace(readings.covariance[of], axis1=1, axis2=2), t)
            confirmed = sightings.confirmed()
            if len(confirmed):
                self._found(label, sightings.points[confirmed].copy())
                sightings.remove(confirmed)
                created = True
        return created

    def _found(self, label: int, points: Array) -> None:
        """New landmarks at points (k, 2) that readings in the window saw; those readings are of them."""
        readings, poses = self.smoother.readings, self.smoother.state.poses
        rows = np.flatnonzero(~readings.used & (readings.label == label) & (readings.landmark == NONE))
        seen = to_map(readings.point[rows], poses[readings.slot[rows]])
        chosen, which = sighted_by(seen, readings.slot[rows], points, self.settings.growth)
        held, which = np.unique(which, return_inverse=True)  # nothing would hold the others
        landmarks = self.smoother.add_landmarks(points[held], np.full(len(held), label, np.intp))
        readings.take(rows[chosen], landmarks[which])
        self.smoother.state.vote(readings.label[rows[chosen]], landmarks[which])

    def _open_to_readings(self) -> NDArray[np.bool_]:
        """(n,) landmarks that readings may be of: until the loop has closed, near the start not the old ones.

        Drift is common to all that is seen: there one reading alone can't tell which old landmark it is of.
        """
        everything = np.ones(len(self._last_seen), bool)
        return everything if self.closed or not self._near_start() else ~self._old()

    def _near_start(self) -> bool:
        return near_start(self.path, self.smoother.state.poses[-1], self.settings.closing)

    def _old(self) -> NDArray[np.bool_]:
        return self._last_seen < self.path.length - self.settings.landmark.unseen

    def _look_back(self) -> None:
        """Every few metres: close the loop where old landmarks are seen, then merge what is one cone."""
        readings, length = self.smoother.readings, self.path.length
        seen = np.unique(readings.landmark[readings.used])
        created = len(self.smoother.state.labels) - len(self._last_seen)
        self._last_seen = np.append(self._last_seen, np.zeros(created))
        self._last_seen[seen] = length
        if length - self._tried < self.settings.closing.check_interval:
            return
        self._tried = length
        if self.closed:
            self._merge(duplicates(self.smoother))
        elif self._near_start():
            settings = self.settings.closing
            reach = settings.radius + settings.drift * length
            pairs = recognize(self.smoother, seen, np.flatnonzero(self._old()), reach)
            if pairs is not None:
                bend(self.smoother, pairs)
                self._merge(pairs)
                self.closed = True

    def _merge(self, pairs: Pairs) -> None:
        if len(pairs.first) == 0:
            return
        merge(self.smoother, pairs.first, pairs.second)
        np.maximum.at(self._last_seen, pairs.second, self._last_seen[pairs.first])
        self._last_seen = np.delete(self._last_seen, pairs.first)

    def _result(self, t: float, stages: dict[str, float]) -> CycleResult:
        readings, state = self.smoother.readings, self.smoother.state
        used = int((readings.used & (readings.slot == len(self.smoother.times) - 1)).sum())
        left, right = (int((state.labels == label).sum()) for label in (LEFT, RIGHT))
        return CycleResult(t, state.poses[-1].copy(), (left, right), used, self.closed, stages)

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's landmarks."""
        everything = np.arange(len(self.smoother.state.labels))
        if len(everything) == 0:
            return Map(self.closed, {})
        return point_map(self.smoother.state, self.smoother.covariance(everything), self.closed)


def point_map(state: LandmarkState, joint: Array, closed: bool) -> Map:
    """The landmarks by colour, each boundary's with its block of their joint covariance (2 n, 2 n)."""
    boundaries = {}
    for label in BOUNDARIES:
        of = np.flatnonzero(state.labels == label)
        if len(of):
            columns = (PLANE * of[:, None] + np.arange(PLANE)).ravel()
            boundaries[label] = PointBoundary(state.landmarks[of].copy(), joint[np.ix_(columns, columns)])
    return Map(closed, boundaries)
