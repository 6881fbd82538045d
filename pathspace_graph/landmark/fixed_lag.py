"""The Hungarian landmark graph online: cones are points in the same fixed-lag smoother as the curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.front_end.late import at_nearest_pose
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunNoise, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.motion import (
    doubt_calibrations,
    known_noise,
    predict,
    smoother_settings,
    vehicle_state,
)
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.registration import near_start
from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.run import CycleResult, Readings, Stopwatch
from pathspace_graph.scale.door import at_scale
from pathspace_graph.settings.mapper import MapperSettings

from .association import associate_created, associate_newest
from .closing import detect_loop, optimize_loop
from .landmark_map import LandmarkMap
from .merging import find_duplicates, merge
from .state import UNASSOCIATED, landmark_counts, point_map

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@at_scale
class LandmarkFixedLag:
    """Maps cones as points: predict, associate, create, update, close, marginalize.

    Window, odometry and robust weights are those of `FixedLagMapper`, but each detection has one landmark in
    place of a curve. `odometry_sigma` (3,) is the standard deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        noise = known_noise(odometry_sigma)
        self.odometry_sigma = noise.odometry
        self.front_end = FrontEnd(self.settings, noise)
        """It judges the readings of each cycle."""
        self.smoother = FixedLagSmoother(smoother_settings(self.settings), LandmarkMap(self.settings))
        """This holds the variables, the window and its prior."""
        self.smoother.window.exact = True
        self.path = DrivenPath()
        """This is the path driven."""
        self.tentative = {label: TentativeTracks(self.settings.growth) for label in BOUNDARIES}
        """These tracks by label are not landmarks yet."""
        self.believed = self.settings
        """These are the settings with the priors of the calibrations as they are now."""
        self.closed = False
        """This tells whether the loop has closed."""
        self._last_detected: Array = np.zeros(
            0
        )  # path driven (m) when each landmark was last seen, by number
        self._last_check = 0.0

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Processes one perception cycle: the twists since the last one, and the detections of now.

        A cycle that cannot be used is a ReadingError and changes nothing. One that is late is used as
        `FixedLagMapper.update` says.
        """
        watch = Stopwatch()
        cycle = self.front_end.admit(odometry, detections, self.smoother.times)
        if cycle.late:
            return cycle.counted(self._use_late(cycle.detections, watch))
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        motion, detections = reading.motion, reading.detections
        predict(self.smoother, self.path, motion, detections.t, self.settings)
        watch.lap("predict")
        new = self.smoother.map.add(detections, self.smoother.next_cycle - 1, motion.odometry.twist)
        associate_newest(self.smoother, new, self._eligible())
        watch.lap("associate")
        created = self._create(new, detections.t)
        watch.lap("create")
        for _ in range(self.settings.steps_grown if created else self.settings.steps):
            self.smoother.step()
        if not self.closed:
            self.believed = doubt_calibrations(
                self.smoother, self.believed, reading.sensor_doubted, reading.measured
            )
        watch.lap("update")
        self._close()
        watch.lap("close")
        self.smoother.marginalize()
        watch.lap("marginalize")
        return cycle.counted(self._result(detections.t, watch.laps))

    def _use_late(self, detections: Detections, watch: Stopwatch) -> CycleResult:
        """Uses the detections of a late cycle at its time, without a pose of their own."""
        detections = self.front_end.use_late(detections, self.smoother.times)
        late = at_nearest_pose(self.smoother, detections, self.settings.motion)
        new = self.smoother.map.add_late(late)
        associate_newest(self.smoother, new, self._eligible(), late.cycle)
        watch.lap("associate")
        created = self._create(new, detections.t)
        watch.lap("create")
        for _ in range(self.settings.steps_grown if created else self.settings.steps):
            self.smoother.step()
        watch.lap("update")
        used = int(self.smoother.map.detections.used[new].sum())
        return replace(self._result(detections.t, watch.laps), readings=used)

    def _create(self, new: slice, t: float) -> bool:
        """Adds detections without a landmark to the tentative tracks, and makes confirmed ones landmarks.

        Returns whether there are new landmarks.
        """
        detections, created = self.smoother.map.detections, False
        rows = new.start + np.flatnonzero(detections.landmark[new] == UNASSOCIATED)
        for label, tentative in self.tentative.items():
            own = rows[detections.label[rows] == label]
            poses = self.smoother.variables.poses_at(detections.cycle[own])
            covariances = rotated(detections.covariance[own], poses[:, 2])
            tentative.add(to_map(detections.point[own], poses), covariances, t)
            confirmed = tentative.confirmed()
            if len(confirmed):
                self._add_landmarks(label, tentative.points[confirmed].copy())
                tentative.remove(confirmed)
                created = True
        return created

    def _add_landmarks(self, label: int, points: Array) -> None:
        """Adds landmarks at points (k, 2), and associates the detections in the window that created them.

        A point without any such detection is left out, since nothing would hold the landmark.
        """
        detections, state = self.smoother.map.detections, self.smoother.map.state
        rows = np.flatnonzero((detections.label == label) & (detections.landmark == UNASSOCIATED))
        cycles = detections.cycle[rows]
        points_map = to_map(detections.point[rows], self.smoother.variables.poses_at(cycles))
        chosen, landmark = associate_created(points_map, cycles, points, self.settings.growth)
        held, landmark = np.unique(landmark, return_inverse=True)
        numbers = state.add(points[held], np.full(len(held), label, np.intp))[landmark]
        detections.take(rows[chosen], numbers)
        state.vote(detections.label[rows[chosen]], numbers)

    def _eligible(self) -> NDArray[np.bool_]:
        """Returns which landmarks (n,) may be associated. Near the start they exclude the old ones.

        Until the loop has closed, all detections there share the drift of the lap. So one detection alone
        can't tell which of the old landmarks it shows.
        """
        every = np.ones(len(self.smoother.map.state), bool)
        return every if self.closed or not self._near_start() else ~self._old()

    def _near_start(self) -> bool:
        return near_start(self.path, self.smoother.variables.poses[-1], self.settings.closing)

    def _old(self) -> NDArray[np.bool_]:
        last_detected = self._last_detected[self.smoother.map.state.numbers]
        return np.asarray(last_detected < self.path.length - self.settings.landmark.unseen)

    def _close(self) -> None:
        """Closes the loop or, once it has closed, merges duplicates; this is tried every few metres."""
        detections, state, length = self.smoother.map.detections, self.smoother.map.state, self.path.length
        detected = np.unique(detections.landmark[detections.used])
        self._last_detected = np.append(
            self._last_detected, np.zeros(state.next_number - len(self._last_detected))
        )
        self._last_detected[detected] = length
        if length - self._last_check < self.settings.closing.check_interval:
            return
        self._last_check = length
        if self.closed:
            self._merge(*find_duplicates(state, len(state), self.smoother.last_covariance, self.settings))
        elif self._near_start():
            reach = self.settings.closing.radius + self.settings.closing.drift * length
            recent, old = state.positions(detected), np.flatnonzero(self._old())
            pairs = detect_loop(self.smoother, recent, old, reach)
            if pairs is not None:
                optimize_loop(self.smoother, pairs)
                self._merge(pairs.recent, pairs.old)
                self.closed, self.smoother.window.exact = True, False

    def _merge(self, gone: IntArray, kept: IntArray) -> None:
        if len(gone) == 0:
            return
        numbers = self.smoother.map.state.numbers
        np.maximum.at(self._last_detected, numbers[kept], self._last_detected[numbers[gone]])
        merge(self.smoother, gone, kept)

    def _result(self, t: float, stages: dict[str, float]) -> CycleResult:
        detections, sizes = self.smoother.map.detections, landmark_counts(self.smoother.map.state.labels)
        used = int((detections.used & (detections.cycle == self.smoother.next_cycle - 1)).sum())
        return CycleResult(t, self.smoother.variables.poses[-1].copy(), sizes, used, self.closed, stages)

    def map(self) -> Map:
        """Returns the map as it stands, with the joint covariance of each boundary's landmarks."""
        state = self.smoother.map.state
        if len(state) == 0:
            return Map(self.closed, {})
        joint = self.smoother.last_covariance(state.keys)
        return point_map(state.landmarks, state.labels, joint, self.closed)

    def window_poses(self) -> Array:
        """Returns a copy of the poses (P, 3) in the window, the oldest first, map frame."""
        return self.smoother.variables.poses.copy()

    def readings(self) -> Readings:
        """Returns the detections of the newest cycle as they were used or gated, with their landmarks."""
        table, state = self.smoother.map.detections, self.smoother.map.state
        rows = np.flatnonzero(table.cycle == self.smoother.next_cycle - 1)
        used = table.used[rows]
        points = to_map(table.point[rows], self.smoother.variables.poses_at(table.cycle[rows]))
        feet = np.full(points.shape, np.nan)
        feet[used] = state.landmarks[state.positions(table.landmark[rows[used]])]
        return Readings(points, table.label[rows], used, feet)

    def noise_used(self) -> RunNoise:
        """Returns the noise that is used now, and what was measured so far."""
        return self.front_end.noise_used

    def vehicle_state(self) -> VehicleState:
        """Returns the newest pose and the calibration, with their joint covariance."""
        return vehicle_state(self.smoother)

    def outline(self) -> Map:
        """Returns a copy of the present map without covariances."""
        state = self.smoother.map.state
        return point_map(state.landmarks, state.labels, None, self.closed)
