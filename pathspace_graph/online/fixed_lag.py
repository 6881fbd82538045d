"""Fixed-lag online mapping, in the paper's order: predict, classify, expand, update, close, simplify."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.graph.keys import POINT, name, pose_key, pose_keys
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap, CurveSmoother
from pathspace_graph.mapping.measurements import integrate_odometry
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.prediction import smoother_settings
from pathspace_graph.mapping.registration import near_start, register
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings
from pathspace_graph.spline.boundary import Boundary

from .activation import narrow
from .association import associate
from .closing import apply_correspondences, optimize_loop
from .growth import Growth
from .nonlinear_graph import window_graph
from .simplification import simplify

Array = NDArray[np.float64]


class Solver(Protocol):
    """Another way to come from the window's factors to an estimate, as `incremental` has one."""

    def step(self, smoother: CurveSmoother, sigma_step: float) -> None:
        """Move the smoother's variables to the estimate; its `last_step` is the window's."""


class FixedLagMapper:
    """Maps a track's two boundaries cycle by cycle, as splines in one factor graph with the vehicle's poses.

    The last `settings.lag` seconds of poses and every control point are solved for in each cycle; what left
    the window is a Gaussian prior. `odometry_sigma` (3,): standard deviation of a twist reading (m/s, m/s,
    rad/s).
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | None = None,
        solver: Solver | None = None,
    ) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)
        self.smoother = FixedLagSmoother(smoother_settings(self.settings), CurveMap(self.settings))
        """What is estimated, and from what: variables, factors of the window, and the prior."""
        self.smoother.window.exact = True
        self.solver = solver
        """What takes the place of the smoother's own step."""
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

        `factors`: GTSAM factors of your own, on poses in the window (`pose_key`, `next_pose_key`: `Pose2`),
        on control points (`control_keys`: `Point2`) and on the calibration. Each is relinearized at every
        step until one of its poses leaves the window, and is a part of the prior then; one on control points
        alone until the loop closes and there are new ones. SettingsError, and nothing done, where a key is
        not a variable of the graph.
        """
        watch = Stopwatch()
        self.smoother.add_factors(factors)
        self._predict(odometry, detections.t)
        watch.lap("predict")
        self._classify(detections)  # projects and gates: what no curve takes may expand one
        watch.lap("classify")
        self._expand()
        if self.solver is None:
            narrow(self.smoother)
        watch.lap("expand")
        for _ in range(self.settings.steps_grown if self._grown else self.settings.steps):
            self._step()
        watch.lap("update")
        closes = self._close()
        watch.lap("close")
        if closes:
            self._simplify()
        watch.lap("simplify")
        self.smoother.marginalize()
        watch.lap("marginalize")
        return self._result(detections.t, watch.laps)

    def _step(self) -> None:
        """One Gauss-Newton step, relinearized at the current estimate, or what the solver does instead."""
        if self.solver is None:
            self.smoother.step(self.settings.sigma_step)
        else:
            self.solver.step(self.smoother, self.settings.sigma_step)

    # --- the stages --------------------------------------------------------------------------------------

    def _predict(self, odometry: Odometry, t: float) -> None:
        """The newest pose, by the calibrated odometry; and how the way goes on from there."""
        integrated = integrate_odometry(odometry, t, self.odometry_sigma)
        self.path.update(self.smoother.predict(t, integrated, self.settings.odometry.sigmas_start))
        if self.solver is not None:
            self.smoother.submaps = None  # nothing of another solver is relinearized when the loop closes
        self.path.steer(odometry.twist)

    def _classify(self, detections: Detections) -> None:
        """Which readings update a curve, and which are sightings of what no curve explains yet."""
        new = self.smoother.map.detections.append(detections, self.smoother.next_cycle - 1)
        if self.boundaries:
            associate(self.smoother, self._grown)
        if not self.closed:
            self.growth.observe(self.smoother, new, detections.t)

    def _expand(self) -> None:
        """Lead each open end through the sightings that come next along the way driven."""
        self._grown = frozenset()
        if not self.closed:
            path_ahead = self.path.ahead(self.poses[-1], self.settings.growth.reach)
            self._grown = self.growth.expand(self.smoother, path_ahead)

    def _close(self) -> bool:
        """Bend the drive so that the newest readings lie on the beginning; True in the cycle that does."""
        settings, length = self.settings.closing, self.path.length
        if self.closed or not self.boundaries or not near_start(self.path, self.poses[-1], settings):
            return False
        if length - self._closing_tried < settings.check_interval:
            return False
        self._closing_tried = length
        self.smoother.refresh()
        covariance = self.smoother.covariance(pose_keys(np.array([self.smoother.next_cycle - 1])))
        beginning = self.path.beginning
        registration = register(self.smoother.map, self.smoother.times, covariance, beginning, settings)
        if registration is None:
            return False
        apply_correspondences(self.smoother, registration)
        optimize_loop(self.smoother)
        self.closed = True
        return True

    def _simplify(self) -> None:
        """Both curves become periodic and have their final size; from now on hardly anything moves."""
        simplify(self.smoother)
        self.growth.clear()
        self.smoother.window.exact = False

    def _result(self, t: float, stages: dict[str, float]) -> CycleResult:
        detections = self.smoother.map.detections
        used = int(detections.used[detections.cycle.searchsorted(self.smoother.next_cycle - 1) :].sum())
        left, right = (self.boundaries[b].size if b in self.boundaries else 0 for b in (LEFT, RIGHT))
        return CycleResult(t, self.poses[-1].copy(), (left, right), used, self.closed, stages)

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's control points."""
        boundaries, shape = {}, self.settings.spline.sigma_shape if self.closed else 0.0
        state = self.smoother.map.state
        if not self.boundaries:
            return Map(self.closed, {})
        joint, at = self.smoother.covariance(state.map_keys), 0
        for label, boundary in self.boundaries.items():
            block = slice(at, at := at + POINT * boundary.size)
            covariance = joint[block, block] + shape**2 * np.eye(POINT * boundary.size)
            spline = boundary.spline(self.control_points(label).copy())
            boundaries[label] = SplineBoundary(spline, covariance)
        return Map(self.closed, boundaries)

    # --- the graph ---------------------------------------------------------------------------------------

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The window as GTSAM has it: projection, spacing, smoothness, odometry, your own and prior factors.

        On the keys of `values`: what is active. It shares nothing with the mapper, so optimize it, print its
        errors, or ask marginals of it with GTSAM's own classes. SettingsError where readings are held against
        their foot points, for which there is no such factor.
        """
        if self.settings.spline.residual != "across":
            raise SettingsError(
                f"graph: expected spline.residual across, found {self.settings.spline.residual}"
            )
        return window_graph(self.smoother)

    def values(self) -> gtsam.Values:
        """The estimate of the window: `Pose2` for poses, points for control points and the calibration."""
        return self.smoother.variables.gtsam_values(self.smoother.layout.keys)

    def marginal_covariance(self, keys: Sequence[int]) -> Array:
        """(q, q) joint covariance of any variables (k,) of the map and the window, in the order of the keys.

        Control points (m), poses (x, y, theta) in the map frame (m, m, rad), calibration (-, rad/s).
        SettingsError where a key is no variable: its pose has left the window, or the curve has new knots.
        """
        wanted = np.array(keys, np.intp)
        unknown = wanted[self.smoother.variables.layout.positions(wanted) == UNKNOWN_PLACE]
        if len(unknown):
            first, last = self.smoother.first_cycle, self.smoother.next_cycle - 1
            raise SettingsError(
                f"covariance of {name(unknown[0])}: expected keys of poses x{first} to x{last}, "
                "of control points of the present curves, or of the calibration"
            )
        return self.smoother.covariance(wanted)

    @staticmethod
    def pose_key(cycle: int) -> int:
        """GTSAM's key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Key of the pose that the next update adds."""
        return pose_key(self.smoother.next_cycle)

    def control_keys(self, label: int) -> list[int]:
        """Keys of a boundary's control points. They stay while it grows, and are new ones when it closes."""
        keys: list[int] = self.smoother.map.state.keys(label).tolist()
        return keys

    # --- what is known -----------------------------------------------------------------------------------

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """The curves by label, without their control points."""
        return self.smoother.map.state.boundaries

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary, map frame, m: a view."""
        self.smoother.refresh()
        return self.smoother.map.state.control_points(label)

    def pose_parameter(self, label: int) -> float:
        """Parameter (m) on a boundary of the point beside the newest pose; on a closed one laps add up."""
        return float(self.smoother.map.state.pose_u[label][-1])

    @property
    def poses(self) -> Array:
        """Poses (P, 3) in the window, oldest first, map frame: a view."""
        return self.smoother.variables.poses

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]) of the odometry: a view."""
        return self.smoother.variables.calibration
