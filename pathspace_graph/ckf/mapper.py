"""The paper's spline filter: predict, classify, expand, update, close, simplify."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import RunNoise, VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.belief import Belief
from pathspace_graph.mapping.motion import MeasuredMotion, known_noise
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.registration import WINDOW, near_start
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.scale.door import at_scale
from pathspace_graph.settings.mapper import MapperSettings

from .closing import associate_early_segment, simplify, update_by_correspondences
from .expansion import Expansion
from .state import CurveState
from .update import OnCurve, classify, update

Array = NDArray[np.float64]


@at_scale
class CkfMapper:
    """Maps a track's two boundaries by a cubature Kalman filter over the pose and all control points.

    `fit.py` lists what the paper leaves open, and what was chosen. `odometry_sigma` (3,) is the standard
    deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        noise = known_noise(odometry_sigma)
        self.odometry_sigma = noise.odometry
        self.front_end = FrontEnd(self.settings, noise)
        """It judges the readings of each cycle."""
        self.state = CurveState(
            Belief.at_start(self.settings.odometry, self.settings.calibration), self.settings
        )
        """This holds the pose, the curves and their joint covariance."""
        self.path = DrivenPath()
        """This is the path driven."""
        self.expansion = Expansion(self.settings)
        """This holds what is not on a curve yet."""
        self.closed = False
        """This tells whether the loop has closed, so that the map has its final size."""
        self._recent: list[tuple[Array, Detections]] = []
        self._last_check = 0.0

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Processes one perception cycle: the twists since the last one, and the detections of now.

        A cycle that cannot be used is a ReadingError and changes nothing. So is one that is late, since a
        filter has no earlier pose that could take its detections.
        """
        watch = Stopwatch()
        cycle = self.front_end.admit(odometry, detections)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        self._predict(reading.motion)
        detections = self.state.belief.corrected(reading.detections)
        watch.lap("predict")
        found = classify(self.state, detections)
        watch.lap("classify")
        found = self._expand(detections, found)
        watch.lap("expand")
        update(self.state, detections, found)
        watch.lap("update")
        self._close(detections)
        watch.lap("close")
        used = sum(len(on.rows) for on in found.values())
        return cycle.counted(self._result(detections.t, used, watch.laps))

    def _predict(self, motion: MeasuredMotion) -> None:
        """Predicts the pose by the motion since the last cycle, and locates it on the curves."""
        self.state.belief.follow(motion)
        self.state.locate_vehicle()
        self.path.update(self.state.pose.copy())
        self.path.steer(motion.twists)

    def _expand(self, detections: Detections, found: dict[int, OnCurve]) -> dict[int, OnCurve]:
        """Expands the curves; then detections on the new stretch update it with the rest."""
        if self.closed:
            return found
        self.expansion.observe(self.state, detections)
        free = np.ones(len(detections.labels), bool)
        for on in found.values():
            free[on.rows] = False
        path_ahead = self.path.ahead(self.state.pose, self.settings.ckf.reach)
        extended = self.expansion.expand(self.state, detections, path_ahead, free)
        return classify(self.state, detections) if extended else found

    def _close(self, detections: Detections) -> None:
        """Looks for the early segment after the shortest lap, and closes and simplifies both curves there."""
        settings, state = self.settings.closing, self.state
        if self.closed:
            return
        self._recent.append((state.pose.copy(), detections))
        self._recent = [cycle for cycle in self._recent if cycle[1].t > detections.t - WINDOW]
        if len(state.curves) == 0 or not near_start(self.path, state.pose, settings):
            return
        if self.path.length - self._last_check < settings.check_interval:
            return
        self._last_check = self.path.length
        motion = associate_early_segment(state, self._recent, self.path.beginning)
        if motion is not None and update_by_correspondences(state, motion):
            simplify(state, self.expansion.observed)
            self.closed = True

    def _result(self, t: float, used: int, stages: dict[str, float]) -> CycleResult:
        curves = self.state.curves
        left, right = (curves[label].size if label in curves else 0 for label in (LEFT, RIGHT))
        return CycleResult(t, self.state.pose.copy(), (left, right), used, self.closed, stages)

    def map(self) -> Map:
        """Returns the map as it stands, with the joint covariance of each boundary's control points."""
        state = self.state
        curves = {b: SplineBoundary(state.spline(b), state.covariance(b)) for b in state.curves}
        keys = [state.columns(b, np.arange(curve.size)) for b, curve in sorted(state.curves.items())]
        columns = np.concatenate([np.zeros(0, np.intp), *keys])
        return Map(self.closed, curves, state.belief.covariance[np.ix_(columns, columns)])

    def noise_used(self) -> RunNoise:
        """Returns the noise that is used now, and what was measured so far."""
        return self.front_end.noise_used

    def vehicle_state(self) -> VehicleState:
        """Returns the newest pose and the calibration, with their joint covariance."""
        return self.state.belief.vehicle_state()

    def outline(self) -> Map:
        """Returns a copy of the present map without covariances."""
        curves = {b: SplineBoundary(self.state.spline(b), NO_COVARIANCE) for b in self.state.curves}
        return Map(self.closed, curves)
