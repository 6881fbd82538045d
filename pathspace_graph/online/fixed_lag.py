"""Fixed-lag online mapping, in the paper's order: predict, classify, expand, update, close, simplify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.lap import ClosedMap
from pathspace_graph.batch.recurrence import Recurrence
from pathspace_graph.errors import SettingsError
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.graph.keys import POINT, POSE, name, pose_key, pose_keys
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.health import DEGRADED, LOST, Evidence, Health, HealthMonitor
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary, joint_covariance
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap, CurveSmoother
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.prediction import (
    doubt_calibrations,
    odometry_noise,
    predict,
    smoother_settings,
    vehicle_state,
)
from pathspace_graph.mapping.registration import near_start, register
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary

from .activation import deactivate_distant
from .association import associate
from .closing import apply_correspondences, optimize_loop, simplify
from .finding import FOUND, KnownLoop, Search, evidence_of, start_anew
from .growth import Growth
from .nonlinear_graph import window_graph
from .open_lap import LapBatch, OpenLapRecord
from .outlook import Outlook, confirmed, joint_covariance_of, look_ahead
from .recognition import recognize
from .swap import go_on_from

Array = NDArray[np.float64]


OWN_PRIOR = "the map goes on from the window's own prior"
"""This begins the notice of a cycle in which the batch of the lap does not replace the prior."""


class Solver(Protocol):
    """A solver replaces the smoother's own step; `incremental` has one."""

    def step(self, smoother: CurveSmoother, sigma_step: float) -> None:
        """Moves the smoother's variables to the estimate, and leaves its `last_step` for gating."""


class FixedLagMapper:
    """Maps a track's two boundaries cycle by cycle, as splines in one factor graph with the vehicle's poses.

    Each cycle solves for the poses of the last `settings.lag` seconds and for every control point; all
    earlier information is a Gaussian prior. `odometry_sigma` (3,) is the standard deviation of one measured
    twist (m/s, m/s, rad/s).
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | None = None,
        solver: Solver | None = None,
    ) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = odometry_noise(odometry_sigma)
        self.front_end = FrontEnd(self.settings, self.odometry_sigma)
        """It judges the readings of each cycle."""
        self.smoother = FixedLagSmoother(smoother_settings(self.settings), CurveMap(self.settings))
        """The smoother holds the variables, the factors of the window, and the prior."""
        self.smoother.window.exact = True
        self.solver = solver
        """The solver replaces the smoother's own step, unless it is None."""
        self.path = DrivenPath(self.settings.path)
        """This is the path that the vehicle has driven."""
        self.growth = Growth(self.settings.growth)
        """The open curves grow through the tentative tracks that are collected here."""
        self.smoother.followers = [self.smoother.map, self.path, self.growth]
        self.closed = False
        """The flag is set when the loop has closed: the map has its final size."""
        self.corrected_poses: Array = np.zeros((0, 3))
        """(k, 3) These are the poses of the first k cycles as the closing of the loop has corrected them."""
        self.lap_seconds = float("nan")
        """The batch of the lap took this wall time (s) in its own process, once it has replaced the prior."""
        self._open_lap = OpenLapRecord(self.settings)
        if self.settings.open_lap.prior == "window" or solver is not None:
            self._open_lap.give_up("no batch of the lap was asked for")
        self._monitor = HealthMonitor(self.settings.health)
        self._health = Health()
        self._known_loop = KnownLoop(self.smoother)
        self._search: Search | None = None
        self._lap_batch: LapBatch | None = None
        self._grown: frozenset[int] = frozenset()
        self._believed = self.settings  # with the priors of the calibrations as they are now
        self._closing_tried = 0.0
        self._loop_tried, self._recognition_tried = 0.0, 0.0

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        factors: Sequence[gtsam.NonlinearFactor] = (),
    ) -> CycleResult:
        """Processes one perception cycle: the twists since the last cycle, and its detections.

        `factors` are GTSAM factors of your own on poses in the window (`pose_key`, `next_pose_key`: `Pose2`),
        on control points (`control_keys`: `Point2`) and on the calibration. Each is relinearized at every
        step until one of its poses leaves the window; then it is part of the prior. A factor on control
        points alone is kept until the loop closes, which replaces the control points. If a key is not a
        variable of the graph, SettingsError is raised and nothing is changed.
        """
        watch = Stopwatch()
        self.smoother.add_factors(factors)
        if factors:
            self._open_lap.give_up("the batch of the lap does not know the user's factors")
        reading = self._predict(odometry, detections)
        watch.lap("predict")
        self._classify(reading)  # detections that no curve explains may expand one
        watch.lap("classify")
        self._expand()
        if self.solver is None:
            deactivate_distant(self.smoother)
        watch.lap("expand")
        for _ in range(self.settings.steps_grown if self._grown else self.settings.steps):
            self._step()
        watch.lap("update")
        if not self.closed:
            self._believed = doubt_calibrations(self.smoother, self._believed)
        closes = self._close()
        watch.lap("close")
        if closes:
            self._simplify()
        watch.lap("simplify")
        jump, notice = self._go_on(closes)
        watch.lap("swap")
        if self._search is not None:
            jump, notice = self._find_back()
        watch.lap("find")
        self.smoother.marginalize(self._lap_batch.first_kept if self._lap_batch else None)
        watch.lap("marginalize")
        return self._result(detections.t, watch.laps, jump, notice)

    def _step(self) -> None:
        """Takes one Gauss-Newton step, relinearized at the current estimate, or the solver's step."""
        if self.solver is None:
            self.smoother.step(self.settings.sigma_step)
        else:
            self.solver.step(self.smoother, self.settings.sigma_step)

    # --- the steps of the paper --------------------------------------------------------------------------

    def _predict(self, odometry: Odometry, detections: Detections) -> Reading:
        """Adds the pose of the cycle by the calibrated odometry, and extends the driven path.

        Returns the readings as the front end has judged them.
        """
        reading = self.front_end.update(odometry, detections)
        motion, t = reading.motion, detections.t
        predict(self.smoother, self.path, motion.odometry, motion.twists, t, self.settings)
        if not self.closed:
            self._open_lap.measured(t, motion.odometry, reading.detections)
        if self.solver is not None:
            self.smoother.submaps = None  # another solver's loop closure relinearizes no submap
        return reading

    def _classify(self, reading: Reading) -> None:
        """Associates detections with the curves; those that no curve uses become tentative tracks."""
        detections, motion, cycle = reading.detections, reading.motion, self.smoother.next_cycle - 1
        new = self.smoother.map.detections.append(detections, cycle, motion.odometry.twist)
        self.smoother.map.correct()
        evidence = Evidence(detections.t)
        if self.boundaries:
            tested = associate(self.smoother, self._grown, use=self._search is None)
            evidence = evidence_of(self.smoother, tested, self._known_loop)
            self.smoother.map.place_detections(new.start)
        if self._search is None:
            self._health = self._monitor.update(replace(evidence, odometry=motion.fault))
            self._begin_search()
        else:
            corrected = self.smoother.map.detections.point[new].copy()
            self._search.observe(self.poses[-1], replace(detections, points_vehicle=corrected))
        if not self.closed:
            self.growth.observe(self.smoother, new, detections.t)

    def _expand(self) -> None:
        """Extends each open curve through the confirmed tracks that come next along the path."""
        self._grown = frozenset()
        if not self.closed:
            path_ahead = self.path.ahead(self.poses[-1], self.settings.growth.reach)
            self._grown = self.growth.expand(self.smoother, path_ahead)

    def _close(self) -> bool:
        """Closes the loop if the newest detections are registered with the beginning; True if it closes."""
        settings, length = self.settings.closing, self.path.length
        if self.closed or not self.boundaries or not near_start(self.path, self.poses[-1], settings):
            return False
        if length - self._closing_tried < settings.check_interval:
            return False
        self._closing_tried = length
        self.smoother.carry()
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
        """Makes both curves periodic; they have their final size then."""
        simplify(self.smoother)
        self.growth.clear()
        self.smoother.window.exact = False  # hardly anything moves from now on

    def _solve_lap(self) -> str:
        """Sends the lap to be solved as a batch in the cycle in which the loop has closed.

        Returns a notice that says why it cannot be solved, or an empty one.
        """
        smoother, record = self.smoother, self._open_lap
        closed = record.closed_map(smoother)
        self.corrected_poses = closed.poses
        cones = len(smoother.map.state.map_keys) / self.settings.spline.size_share
        if cones > self.settings.open_lap.max_cones:
            record.give_up("the lap has too many cones for a batch")
        if record.unsolvable is not None:
            return f"{OWN_PRIOR}: {record.unsolvable}"
        self._begin_batch(closed)
        return ""

    def _begin_batch(self, start: ClosedMap | Recurrence) -> None:
        """Sends the lap to its batch, which begins at a map that has just been closed, or at odometry."""
        own, first, cycle = self.settings.open_lap, self.smoother.first_cycle, self.smoother.next_cycle - 1
        wait = max(min(own.cycles, cycle - first), int(own.cycles_share * cycle))
        first_kept = min(first + wait, cycle)
        lap = self._open_lap.lap(first_kept, start, self._believed)
        self._lap_batch = LapBatch(lap, cycle + wait)

    def _try_loop(self) -> None:
        """Sends the lap to a batch from odometry where the drive says that it is over.

        That happens where the registration keeps refusing to close the loop.
        """
        if self.path.length < self._loop_tried or set(self.boundaries) != set(BOUNDARIES):
            return
        self._loop_tried = self.path.length + self.settings.closing.check_interval
        recurrence = self._recurrence()
        if recurrence is not None:
            self._loop_tried = self.path.length + self.settings.open_lap.retry
            self._begin_batch(recurrence)

    def _recurrence(self) -> Recurrence | None:
        """Returns after which length the drive recurs, by its odometry or by the shape of the curves."""
        record, settings = self._open_lap, self.settings.closing.recognition
        if record.unsolvable is not None:
            return None
        found = record.recurrence()
        if found is not None or self.path.length < self._recognition_tried + settings.interval:
            return found
        self._recognition_tried = self.path.length
        place = recognize(self.smoother)
        return None if place is None else record.recurrence_since(place)

    def _go_on(self, closes: bool) -> tuple[Array | None, str]:
        """Records the open lap, has it solved when it closes, and goes on from the result when it is due.

        Returns the jump (3,) of the newest pose if the map was replaced, and a notice if it was not.
        """
        batch = self._lap_batch
        if closes:
            return None, self._solve_lap()
        if not self.closed:
            self._open_lap.estimated(self.smoother.map.state)
            if self.path.length > self.settings.closing.min_path:
                self._open_lap.prepare()
                if batch is None:
                    self._try_loop()
        if batch is None or self.smoother.next_cycle - 1 < batch.due:
            return None, ""
        self._lap_batch, marginal = None, batch.marginal()
        if isinstance(marginal, str):
            return None, f"{OWN_PRIOR}: {marginal}" if self.closed else ""
        if not self.closed:
            self.closed, self.smoother.window.exact = True, False
            self.growth.clear()
        self.corrected_poses, self.lap_seconds = marginal.poses, marginal.seconds
        return go_on_from(self.smoother, marginal), ""

    def _begin_search(self) -> None:
        """Takes all detections of the window out of use, if the vehicle is lost on a map that is complete.

        So the map stays as it was before. Nothing is done before the batch of the lap has replaced it.
        """
        ready = self.closed and self._lap_batch is None and set(self.boundaries) == set(BOUNDARIES)
        if self._health.condition == LOST and ready:
            detections = self.smoother.map.detections
            detections.release(np.arange(len(detections)))
            self._search = Search(self.smoother)

    def _find_back(self) -> tuple[Array | None, str]:
        """Starts the window anew where a lost vehicle is found; returns its jump (3,) and a notice."""
        if self._search is None:
            return None, ""
        found = self._search.find()
        if found is None:
            return None, ""
        first_cycle = max(self._search.first_cycle, self.smoother.first_cycle)
        self._search, self._health = None, Health(DEGRADED, FOUND)
        self._monitor.restart()
        return start_anew(self.smoother, first_cycle, found), FOUND

    def _result(self, t: float, stages: dict[str, float], jump: Array | None, notice: str) -> CycleResult:
        """Returns the newest pose, the sizes of the boundaries, and the cycle's detections in use."""
        detections = self.smoother.map.detections
        used = int(detections.used[detections.cycle.searchsorted(self.smoother.next_cycle - 1) :].sum())
        left, right = (self.boundaries[b].size if b in self.boundaries else 0 for b in (LEFT, RIGHT))
        pose, sizes = self.poses[-1].copy(), (left, right)
        return CycleResult(t, pose, sizes, used, self.closed, stages, jump, notice, self._health)

    def map(self) -> Map:
        """Returns a copy of the present map, with the joint covariance of each boundary's control points.

        An open curve goes on beyond its confirmed end, as `outline` says.
        """
        state, outlooks = self.smoother.map.state, self._outlooks()
        if not outlooks:
            return Map(self.closed, {})
        newest = pose_keys(np.array([self.smoother.next_cycle - 1]))
        joint = self.smoother.covariance(np.concatenate([state.map_keys, newest]))
        if self.closed:
            return self._closed_map(joint[:-POSE, :-POSE])
        joint, blocks = joint_covariance_of(
            list(outlooks.values()), joint, self.poses[-1], self.settings.tentative.sigma_bend
        )
        boundaries = {
            label: SplineBoundary(outlook.spline, joint[block, block].copy(), outlook.confirmed_until)
            for (label, outlook), block in zip(outlooks.items(), blocks, strict=True)
        }
        return Map(False, boundaries, joint)

    def _closed_map(self, joint: Array) -> Map:
        """Returns the closed map, whose control points have a covariance (2m, 2m) from the graph.

        What a curve with few control points cannot follow is added: no number of detections averages it out.
        """
        shape, scatter = self.settings.spline.sigma_shape, self.smoother.map.scatter
        boundaries, at = {}, 0
        for label, boundary in self.boundaries.items():
            block = slice(at, at := at + POINT * boundary.size)
            sigma = scatter.get(label, np.full(boundary.size, shape))
            covariance = joint[block, block] + np.diag(np.repeat(sigma, POINT) ** 2)
            spline = self.smoother.map.state.spline(label)
            boundaries[label] = SplineBoundary(spline, covariance, spline.domain[1])
        return Map(True, boundaries, joint_covariance(joint, boundaries))

    def outline(self) -> Map:
        """Returns a copy of the present map without covariances, which takes a hundredth of the time.

        An open curve is confirmed up to `confirmed_until`. From there on it is tentative: it leads through
        cones that were seen less often, and is fitted anew in each call. A curve that has not begun may
        consist of a tentative stretch alone.
        """
        values, boundaries = self.smoother.variables.values.copy(), {}
        for label, outlook in self._outlooks().items():
            spline = outlook.spline
            until = spline.domain[1] if self.closed else outlook.confirmed_until
            boundaries[label] = SplineBoundary(spline, NO_COVARIANCE, until)
        self.smoother.variables.values[:] = values  # to look at the map must not change the estimate
        return Map(self.closed, boundaries)

    def vehicle_state(self) -> VehicleState:
        """Returns the newest pose and the calibration, with their joint covariance."""
        return vehicle_state(self.smoother)

    def _outlooks(self) -> dict[int, Outlook]:
        """Returns the curves; open ones have a tentative stretch."""
        self.smoother.refresh()
        if self.closed or self.smoother.next_cycle == 0:
            return confirmed(self.smoother)
        return look_ahead(self.smoother, self.growth, self.path)

    # --- the graph ---------------------------------------------------------------------------------------

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Returns the window as GTSAM factors: projection, spacing, smoothness, odometry, your own and prior.

        The factors hold the active variables, which `values` returns. The graph shares nothing with the
        mapper: optimize it, print its errors, or compute its marginals with GTSAM's own classes. There is no
        such factor for `spline.residual` "point" or for places of cones, where SettingsError is raised.
        """
        if self.settings.spline.residual != "across":
            raise SettingsError(
                f"graph: expected spline.residual across, found {self.settings.spline.residual}"
            )
        if self.settings.place.use != "none":
            raise SettingsError(f"graph: expected place.use none, found {self.settings.place.use}")
        return window_graph(self.smoother)

    def values(self) -> gtsam.Values:
        """Returns the active variables: poses as `Pose2`, control points and the calibration as points."""
        return self.smoother.variables.gtsam_values(self.smoother.layout.keys)

    def marginal_covariance(self, keys: Sequence[int]) -> Array:
        """Returns the joint covariance (q, q) of any variables (k,), in the order of their keys.

        Control points are in m, poses (x, y, theta) in m and rad, both in the map frame; the calibration is
        (-, rad/s). SettingsError is raised for a key that is not a variable: its pose has left the window, or
        its curve has new knots.
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
        """Returns GTSAM's key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Returns the key of the pose that the next update adds."""
        return pose_key(self.smoother.next_cycle)

    def control_keys(self, label: int) -> list[int]:
        """Returns the keys of a boundary's control points, which change only when the loop closes."""
        keys: list[int] = self.smoother.map.state.keys(label).tolist()
        return keys

    # --- the estimate ------------------------------------------------------------------------------------

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Returns the curves by label; their control points are in `control_points`."""
        return self.smoother.map.state.boundaries

    def control_points(self, label: int) -> Array:
        """Returns a view of a boundary's control points (m, 2) in m, map frame."""
        self.smoother.refresh()
        return self.smoother.map.state.control_points(label)

    def pose_parameter(self, label: int) -> float:
        """Returns the parameter (m) of the newest pose's foot point; it increases from lap to lap."""
        return float(self.smoother.map.state.pose_u[label][-1])

    @property
    def poses(self) -> Array:
        """Returns a view of the poses (P, 3) in the window, the oldest first, map frame."""
        return self.smoother.variables.poses

    @property
    def calibration(self) -> Array:
        """Returns a view of the odometry's calibration: (scale error [-], yaw-rate bias [rad/s])."""
        return self.smoother.variables.calibration

    @property
    def calibrations(self) -> Array:
        """Returns a view of the calibrations of the odometry and, where it is estimated, of the sensor."""
        return self.smoother.variables.calibrations
