"""Fixed-lag online mapping, in the paper's order: predict, classify, expand, update, close, simplify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry, compose, integrate_twists

from .boundary import Boundary
from .closing import bend, near_start, register, tie
from .gating import admit
from .growth import Growth
from .labels import LEFT, RIGHT
from .log import Detections, Odometry
from .map import Map, SplineBoundary
from .narrowing import narrow
from .path import DrivenPath
from .pose_factors import pose_key
from .settings import MapperSettings
from .simplification import simplify
from .smoother import Smoother
from .stopwatch import Stopwatch
from .window import Prior, Rows

Array = NDArray[np.float64]

ODOMETRY_SIGMA = (0.25, 0.12, 0.035)
"""Noise of a twist reading (m/s, m/s, rad/s) where nothing else is told: that of the simulator."""


@dataclass(frozen=True, eq=False)
class CycleResult:
    """The estimate after one perception cycle."""

    t: float
    """Stamp, s."""
    pose: Array
    """(3,) x (m), y (m), theta (rad, not wrapped), map frame."""
    sizes: tuple[int, int]
    """Control points, or landmarks, of the left and the right boundary."""
    readings: int
    """How many of the cycle's readings were used."""
    closed: bool
    """Whether the loop has closed."""
    stages: dict[str, float] = field(default_factory=dict)
    """Time (s) that each stage of the update took, by its name."""


class FixedLagMapper:
    """Maps a track's two boundaries cycle by cycle, as splines in one factor graph with the vehicle's poses.

    The last `settings.lag` seconds of poses and every control point are solved for in each cycle; what left
    the window is a Gaussian prior. `odometry_sigma` (3,): standard deviation of a twist reading (m/s, m/s,
    rad/s).
    """

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)
        self.smoother = Smoother(self.settings)
        """What is estimated, and from what."""
        self.path = DrivenPath(self.settings.path)
        """The way driven."""
        self.growth = Growth(self.settings.growth)
        """What isn't on a curve yet."""
        self.closed = False
        """Whether the loop has closed, and the map its final size."""
        self._grown: frozenset[int] = frozenset()
        self._closing_tried = 0.0

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        factors: Sequence[gtsam.NonlinearFactor] = (),
    ) -> CycleResult:
        """One perception cycle: the twists since the last one, and what was detected now.

        `factors`: GTSAM factors of your own on Pose2 keys in the window (`pose_key`, `next_pose_key`). Each
        is relinearized at every step as long as all of its poses are in the window, and then a part of the
        prior; SettingsError, and nothing done, where a key isn't in the window.
        """
        watch = Stopwatch()
        self.smoother.add_factors(factors)
        self._predict(odometry, detections.t)
        watch.lap("predict")
        self._classify(detections)  # projects and gates: what no curve takes may expand one
        watch.lap("classify")
        self._expand()
        narrow(self.smoother)
        watch.lap("expand")
        for _ in range(self.settings.steps_grown if self._grown else self.settings.steps):
            self.smoother.step(self.settings.sigma_step)
        watch.lap("update")
        closes = self._close()
        watch.lap("close")
        if closes:
            self._simplify()
        watch.lap("simplify")
        self.smoother.marginalize()
        watch.lap("marginalize")
        return self._result(detections.t, watch.laps)

    # --- the stages --------------------------------------------------------------------------------------

    def _predict(self, odometry: Odometry, t: float) -> None:
        """The newest pose, by the calibrated odometry; and how the way goes on from there."""
        durations = np.diff(np.append(odometry.t, t))
        integrated = integrate_twists(durations, odometry.twist, self.odometry_sigma)
        delta = integrated.delta - _calibration_error(integrated, self.calibration)
        if self.smoother.times:
            pose = compose(self.poses[-1], delta)
            self.smoother.follow(t, pose, integrated)
        else:
            pose = compose(np.zeros(3), delta)
            start = self.settings.odometry
            sigmas = np.array([start.sigma_start, start.sigma_start, start.sigma_start_heading])
            self.smoother.begin(t, pose, integrated.covariance + np.diag(sigmas) ** 2)
        self.path.update(pose)
        self.path.steer(odometry.twist)

    def _classify(self, detections: Detections) -> None:
        """Which readings update a curve, and which are sightings of what no curve explains yet."""
        new = self.smoother.add_readings(detections)
        if self.boundaries:
            admit(self.smoother, self._grown)
        if not self.closed:
            self.growth.sight(self.smoother, new, detections.t)

    def _expand(self) -> None:
        """Lead each open end through the sightings that come next along the way driven."""
        self._grown = frozenset()
        if not self.closed:
            way = self.path.ahead(self.poses[-1], self.settings.growth.reach)
            self._grown = self.growth.expand(self.smoother, way)

    def _close(self) -> bool:
        """Bend the drive so that the newest readings lie on the beginning; True in the cycle that does."""
        settings, length = self.settings.closing, self.path.length
        if self.closed or not self.boundaries or not near_start(self.path, self.poses[-1], settings):
            return False
        if length - self._closing_tried < settings.check_interval:
            return False
        self._closing_tried = length
        self.smoother.refresh()
        registration = register(self.smoother, self.path.beginning, settings)
        if registration is None:
            return False
        tie(self.smoother, registration)
        bend(self.smoother)
        self.closed = True
        return True

    def _simplify(self) -> None:
        """Both curves become periodic and have their final size."""
        simplify(self.smoother)
        self.growth.clear()

    def _result(self, t: float, stages: dict[str, float]) -> CycleResult:
        readings = self.smoother.readings
        used = int((readings.used & (readings.slot == len(self.smoother.times) - 1)).sum())
        left, right = (self.boundaries[b].size if b in self.boundaries else 0 for b in (LEFT, RIGHT))
        return CycleResult(t, self.poses[-1].copy(), (left, right), used, self.closed, stages)

    # --- what is known -----------------------------------------------------------------------------------

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's control points."""
        if not self.boundaries:
            return Map(self.closed, {})
        joint, state = self.smoother.map_covariance(), self.smoother.state
        if self.closed:
            joint = joint + np.eye(len(joint)) * self.settings.spline.sigma_shape**2
        boundaries = {}
        for label, boundary in self.boundaries.items():
            block = state.block(label)
            spline = boundary.spline(self.control_points(label).copy())
            boundaries[label] = SplineBoundary(spline, joint[block, block])
        return Map(self.closed, boundaries)

    @staticmethod
    def pose_key(cycle: int) -> int:
        """GTSAM's key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Key of the pose that the next update adds."""
        return pose_key(self.smoother.next_cycle)

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """The curves by label, without their control points."""
        return self.smoother.state.boundaries

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary, map frame, m: a view."""
        self.smoother.refresh()
        return self.smoother.state.control_points(label)

    @property
    def poses(self) -> Array:
        """Poses (P, 3) in the window, oldest first, map frame: a view."""
        return self.smoother.state.poses

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]) of the odometry: a view."""
        return self.smoother.state.calibration

    @property
    def state(self) -> Array:
        """The flat state (n,), see `State`."""
        return self.smoother.state.vector

    @property
    def prior(self) -> Prior:
        """What stands for all that has left the window."""
        return self.smoother.prior

    def linearize(self) -> list[Rows]:
        """Whitened rows of all in the window but the prior and the smoothness, at the current estimate."""
        return self.smoother.linearize()


def _calibration_error(integrated: IntegratedOdometry, calibration: Array) -> Array:
    """(3,) what calibration takes off an integrated odometry, in the frame of its start."""
    local = integrated.calibration_jacobian @ calibration
    c, s = np.cos(integrated.delta[2]), np.sin(integrated.delta[2])
    return np.array([c * local[0] - s * local[1], s * local[0] + c * local[1], local[2]])
