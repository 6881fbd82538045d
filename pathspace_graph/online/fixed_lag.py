"""The online mapper: the steps of the paper for each cycle, and read-only queries of the estimate."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Self

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.front_end.gate import Admitted
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.rows import Revisit, odometry_factor
from pathspace_graph.graph.variables import POINT, POSE, name, pose_key, pose_keys
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.health import Health
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import NO_CONES, NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import LapBatches, RunNoise, VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop import lap_solver
from pathspace_graph.loop.closed import Lost
from pathspace_graph.loop.drive import Drive, Phase
from pathspace_graph.loop.open import Open, Seeking
from pathspace_graph.mapping.curve_map import curve_factors
from pathspace_graph.mapping.motion import known_noise, vehicle_state, with_size
from pathspace_graph.mapping.road import Road
from pathspace_graph.online.outlook import Outlook, confirmed, curves_ahead, joint_covariance_of, look_ahead
from pathspace_graph.run import CycleResult, Readings, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, known_settings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.planning import CurveAhead, TrackAhead, check_line, track_ahead


class MapperEstimate:
    """Read-only queries of a fixed-lag mapper."""

    settings: MapperSettings
    road: Road
    drive: Drive
    phase: Phase

    def __repr__(self) -> str:
        times, name = self.road.smoother.times, type(self).__name__
        if not times:
            return f"{name}(no cycle yet)"
        poses = f"{self.road.next_cycle} cycles up to {times[-1]:.1f} s, {len(times)} poses in the window"
        return f"{name}({poses},\n    {self.outline()})"

    def map(self) -> Map:
        """Return a copy of the map, with the joint covariance of each boundary's control points.

        An open curve includes the tentative stretch that `outline` describes. The covariance of a closed
        curve includes the scatter of the cones about it.
        """
        road, track = self.road, self.road.smoother.map
        with self.looked_at():
            outlooks, points = self._outlooks(), road.orange_cones()
            if not outlooks:
                return Map(road.closed, {}, points=points)
            newest = pose_keys(np.array([road.next_cycle - 1]))
            joint = road.smoother.covariance(np.concatenate([track.state.map_keys, newest]))
            lengths = np.concatenate([track.state.map_points.ravel(), road.poses[-1, :2], [0.0]])
            joint = with_size(joint, lengths, self._sigma_size)
            if road.closed:
                sizes, shape = [len(one.known) for one in outlooks.values()], road.settings.spline.sigma_shape
                of_label = zip(outlooks, sizes, strict=True)
                sigmas = [track.scatter.get(label, np.full(size, shape)) for label, size in of_label]
                joint = joint[:-POSE, :-POSE] + np.diag(np.repeat(np.concatenate(sigmas), POINT) ** 2)
                blocks = [slice(*ends) for ends in pairwise([0, *(POINT * np.cumsum(sizes)).tolist()])]
            else:
                joint, blocks = joint_covariance_of(list(outlooks.values()), joint, road.poses[-1])
            cones = {} if road.settings.of_lines else track.cones
            boundaries = {
                label: SplineBoundary(
                    outlook.spline, joint[block, block], outlook.confirmed_until, cones.get(label, NO_CONES)
                )
                for (label, outlook), block in zip(outlooks.items(), blocks, strict=True)
            }
            return Map(road.closed, boundaries, joint, points)

    def outline(self) -> Map:
        """Return a copy of the map without covariances, in a hundredth of the time of `map`.

        Past `confirmed_until` an open curve is tentative: each call fits it through cones with fewer
        detections. A boundary without a confirmed curve may consist of a tentative stretch alone.
        """
        with self.looked_at():
            boundaries = {
                label: SplineBoundary(outlook.spline, NO_COVARIANCE, outlook.confirmed_until)
                for label, outlook in self._outlooks().items()
            }
        return Map(self.road.closed, boundaries, points=self.road.orange_cones())

    def _outlooks(self) -> dict[int, Outlook]:
        """Curves by label, open ones with their tentative stretches."""
        road = self.road
        road.smoother.refresh()
        if road.closed or road.next_cycle == 0:
            return confirmed(road.smoother.map)
        return look_ahead(road.smoother.map, road.growth.tentative, road.path, road.smoother.times[-1])

    def ahead(self, distance: float, step: float = 1.0) -> TrackAhead:
        """Return the next `distance` metres of the track in the vehicle's frame, `step` (m) apart.

        The call is fast enough for a controller in each cycle. While the loop is open, the line continues
        past the confirmed ends through the cones of `outline`, and says where. There is none while the
        vehicle is lost. SettingsError is raised for a length out of its range.
        """
        check_line(distance, step)
        road, track, curves = self.road, self.road.smoother.map, dict[int, CurveAhead]()
        if isinstance(self.phase, Lost) or not road.smoother.times:
            return track_ahead(curves, np.zeros(POSE), distance, step)
        if road.closed:
            for label, boundary in road.boundaries.items():
                points = boundary.extended(track.state.control_points(label))
                curves[label] = CurveAhead(boundary.tables, points, float(track.state.pose_u[label][-1]))
        else:
            curves = curves_ahead(track, road.growth.tentative, road.path, road.smoother.times[-1])
        return track_ahead(curves, road.poses[-1], distance, step)

    def looked_at(self) -> AbstractContextManager[None]:
        """Return a context in which no query changes the estimate.

        Outside of it, `control_points` refreshes the inactive part of an open map, which may move later
        estimates by millimetres.
        """
        return self.road.smoother.variables.looked_at()

    def readings(self) -> Readings:
        """Return the used and gated detections of the newest cycle, with foot points.

        Parameters of the foot points are of the last linearization, positions of the present curve.
        """
        track, table = self.road.smoother.map, self.road.smoother.map.detections
        newest = slice(int(table.cycle.searchsorted(self.road.next_cycle - 1)), None)
        used, boundary = table.used[newest].copy(), table.boundary[newest].copy()
        points = table.points_map(newest, track.variables)
        feet = np.full(points.shape, np.nan)
        for label, curve in self.road.boundaries.items():
            on = np.flatnonzero(used & (boundary == label))
            if len(on):
                feet[on] = curve.evaluate(track.state.control_points(label), table.u[newest][on])
        return Readings(points, boundary, used, feet)

    def vehicle_state(self) -> VehicleState:
        """Return the newest pose and the calibration, with their joint covariance."""
        with self.looked_at():
            return vehicle_state(self.road.smoother, self._sigma_size)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the window as GTSAM factors: projection, gauge, odometry, stations, user factors and prior.

        The factors are on the active variables, which `values` returns. Linearized at the estimate, they give
        the mapper's own system in GTSAM's tangent space of the poses. The graph shares nothing with the
        mapper: optimize it, print its errors, or compute its marginals with GTSAM's classes.
        """
        smoother, graph = self.road.smoother, gtsam.NonlinearFactorGraph()
        factors = [one for label in self.road.boundaries for one in curve_factors(smoother.map, label)]
        intervals = enumerate(smoother.window.odometry.intervals, start=smoother.first_cycle)
        factors += [odometry_factor(cycle, interval) for cycle, interval in intervals]
        prior = factors_of(smoother.absolute_prior())
        linear = [as_nonlinear(factor, smoother.variables) for factor in prior]
        for factor in (*factors, *smoother.user_factors.factors, *linear):
            graph.add(factor)
        return graph

    def values(self) -> gtsam.Values:
        """Return the active variables: poses as `Pose2`, control points and calibrations as points."""
        return self.road.smoother.variables.gtsam_values(self.road.smoother.layout.keys)

    def marginal_covariance(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance (q, q) of any variables (k,), in the order of their keys.

        Units are m for control points, m and rad for poses (x, y, theta), both in the map frame, and (-,
        rad/s) for the calibration. SettingsError is raised for a pose outside the window or a key of former
        knots.
        """
        wanted, smoother = np.array(keys, np.intp), self.road.smoother
        unknown = wanted[smoother.variables.layout.positions(wanted) == UNKNOWN_PLACE]
        if len(unknown):
            first, last = smoother.first_cycle, smoother.next_cycle - 1
            raise SettingsError(
                f"covariance of {name(unknown[0])}: expected keys of poses x{first} to x{last}, "
                "of control points of the present curves, or of the calibration"
            )
        return smoother.covariance(wanted)

    @staticmethod
    def pose_key(cycle: int) -> int:
        """Return the GTSAM key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Return the key of the pose of the next update."""
        return pose_key(self.road.next_cycle)

    def control_keys(self, label: int) -> list[int]:
        """Return the keys of a boundary's control points; they change only when the map is replaced."""
        keys: list[int] = self.road.smoother.map.state.control_keys(label).tolist()
        return keys

    # --- the loop ----------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether the loop has closed."""
        return self.road.closed

    @property
    def placed_at(self) -> float | None:
        """Return the stamp (s) of the localization on the known map, if there was one."""
        return self.drive.placed_at

    @property
    def corrected_poses(self) -> Array:
        """Return the poses (k, 3) of the first k cycles, corrected by loop closure or revisits."""
        return self.drive.record.corrected

    def smoothed(self, t: Array) -> Array:
        """Return the corrected poses (n, 3) at stamps t (n,) of cycles; NaN after the last corrected one."""
        poses = self.corrected_poses
        stamps = np.array([*self.drive.record.stamps][: len(poses)])
        found, known = np.full((len(t), POSE), np.nan), t <= stamps.max(initial=-np.inf)
        found[known] = poses[np.maximum(stamps.searchsorted(t[known], side="right") - 1, 0)]
        return found

    @property
    def revisits(self) -> tuple[Revisit, ...]:
        """Return the relative poses by which the open map was optimized."""
        return self.drive.revisits

    @property
    def closed_by(self) -> tuple[Revisit, ...]:
        """Return the relative pose that started the batch of the loop closure, in a tuple of at most one."""
        return (self.drive.closed_by,) if self.drive.closed_by else ()

    @property
    def lap_seconds(self) -> float:
        """Return the wall time (s) of the batch of the present map; NaN without one."""
        return self.drive.lap_seconds

    def wait(self) -> None:
        """Wait without limit for the batch whose result may be due in the next update.

        A replay calls this before each update, so that a log always gives the same map.
        """
        self.drive.solver.wait(self.road.next_cycle)

    def batches(self) -> LapBatches:
        """Return the cycles in which batches ended, and how late they would have been in a vehicle."""
        solver = self.drive.solver
        return LapBatches(solver.ends(self.road.next_cycle), solver.late_cycles)

    # --- the estimate ------------------------------------------------------------------------------------

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Return the knots and cones of the curves by label; `control_points` has their control points."""
        return self.road.boundaries

    def control_points(self, label: int) -> Array:
        """Return a view of a boundary's control points (m, 2) in m, map frame."""
        self.road.smoother.refresh()
        return self.road.smoother.map.state.control_points(label)

    @property
    def poses(self) -> Array:
        """Return a view of the poses (P, 3) in the window, oldest first, map frame."""
        return self.road.poses

    def window_poses(self) -> Array:
        """Return a copy of the poses (P, 3) in the window, oldest first, map frame."""
        return self.poses.copy()

    @property
    def calibration(self) -> Array:
        """Return a view of the odometry's calibration: (scale error [-], yaw-rate bias [rad/s])."""
        return self.road.smoother.variables.calibration

    @property
    def _sigma_size(self) -> float:
        """Return the relative standard deviation of the map's size, if it is not estimated (-)."""
        return self.drive.priors.odometry.sigma_size


# --- the mapper ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Before:
    """Copy of a mapper's state before a cycle."""

    front_end: FrontEnd
    road: Road
    drive: Drive
    phase: Phase
    health: Health

    @classmethod
    def of(cls, mapper: "FixedLagMapper") -> Self:
        front_end, road = mapper.front_end.copy(), mapper.road.copy()
        return cls(front_end, road, mapper.drive.copy(), mapper.phase.copy(), mapper.health)


class FixedLagMapper(MapperEstimate):
    """Fixed-lag smoother of both boundaries of a track, as splines in one factor graph with the poses.

    Each cycle solves for the poses of the last `settings.lag` seconds and for every control point. All
    earlier information is in a Gaussian prior. `odometry_sigma` (3,) is the standard deviation of one
    measured twist (m/s, m/s, rad/s).
    """

    ROAD: ClassVar = Road  # class of the estimate
    FIRST_PHASE: ClassVar = Open  # class of the first phase

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        noise = known_noise(odometry_sigma)
        self.failures = 0  # number of failed updates
        self.front_end = FrontEnd(self.settings, noise)
        self.road: Road = self.ROAD(self.settings)
        self.drive = Drive(self.settings)
        self.phase: Phase = self.FIRST_PHASE(self.settings)
        self.health = Health()  # health of the newest estimate
        self._unused: Odometry | None = None  # twists of a skipped cycle
        lap_solver.submit(lap_solver.nothing)  # start the process now: a cycle would wait for it

    @classmethod
    def on(
        cls,
        track: Map,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        *,
        start: Array | None = None,
        keep: bool = False,
    ) -> Self:
        """Return a mapper on a known map; all results are in its frame once the vehicle is found on it.

        Until then the mapper maps a road of its own. `start` (3,) in m, m and rad, map frame, is the
        approximate first pose; it is required on an open map and optional on a closed one. Detections refine
        the map, unless `keep` fixes it. SettingsError is raised for a map without both curves or without
        covariances.
        """
        mapper = cls(settings, odometry_sigma)
        pose = None if start is None else np.array(start, float)
        mapper.phase = Seeking(mapper.settings, track, pose, keep)
        return mapper

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        *,
        strict: bool = False,
    ) -> CycleResult:
        """Process one perception cycle: the twists since the last cycle, and its detections.

        An unusable cycle (`front_end.gate`, `settings.mapper`) raises a ReadingError and changes nothing.
        Impossible detections are dropped and counted. Each twist is held until the next one; twists that end
        before the newest cycle are left out.

        The call waits for a running batch no longer than the time since the previous cycle. A replay calls
        `wait` first, so that the map does not depend on the speed of the machine.

        `factors` are GTSAM factors of your own, on poses in the window (`pose_key`,
        `next_pose_key`: `Pose2`), on control points (`control_keys`: `Point2`) and on the calibration. Each
        is relinearized at every step until one of its poses leaves the window; then it is part of the prior.
        The batch of the lap includes the factors as rows, since one in Python cannot reach its process:
        linearized in this cycle, or when the batch begins if it is on control points. There, and after the
        loop has closed, the curves have other knots. So one on control points becomes one on the points of
        the curves that determine them. A factor without information is left out.
        SettingsError is raised, and nothing changes, if a key is not a variable of the graph or a number is
        not finite.

        No other error is raised, unless `strict`: if a step fails, the mapper restores its state before the
        cycle and retries with less, as the notice says, and `failures` counts.
        """
        factors = tuple(factors)
        cycle = self._admit(odometry, detections, factors)
        before = _Before.of(self)
        try:
            result = self._process(cycle, factors)
        except Exception as error:  # the vehicle drives on, whatever fails
            if strict:
                self._go_back(before)
                raise
            result = self._without(before, cycle, factors, error)
        else:
            self._unused = None
        return cycle.counted(result)

    def _process(self, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor]) -> CycleResult:
        """Run the steps of the paper, and the step of the phase."""
        watch, road, drive = Stopwatch(), self.road, self.drive
        factors = road.smoother.informative(factors)
        held = road.add_factors(factors)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        road.predict(reading.motion, reading.orange)
        drive.record.measured(reading)
        drive.record.given(factors, road)
        watch.lap("predict")
        twist, use = reading.motion.odometry.twist, self.phase.uses_detections
        classified = road.classify(reading.detections, twist, use=use)
        phase, health = self.phase.judge(road, drive, classified, reading)
        watch.lap("classify")
        grown = road.expand(solving=drive.solver.is_busy)  # through detections that no curve explains
        watch.lap("expand")
        road.update()
        watch.lap("update")
        step = phase.step(road, drive, reading, watch.spent)
        watch.lap("loop")
        road.marginalize(drive.solver.first_kept)
        watch.lap("marginalize")
        self.phase, self.health = step.phase, step.health or health
        notice = "; ".join(filter(None, [held, step.notice, grown, reading.notice]))
        return self._result(cycle.detections.t, watch.laps, step.jump, notice)

    def _without(
        self, before: _Before, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor], error: Exception
    ) -> CycleResult:
        """Retry a failed cycle with the road alone, then without detections; otherwise skip the cycle.

        Each attempt starts from the state before the cycle. The notice says what failed.
        """
        self.failures += 1
        why = f": {type(error).__name__}: {error}" if self.failures == 1 else f" (failure {self.failures})"
        failed, seen = " ".join(f"an update failed{why}".split()), cycle.detections
        blind = replace(cycle, detections=seen.where(np.zeros(len(seen.labels), bool)))
        attempts = {"the loop is left as it is": cycle, "its detections are not used": blind}
        for consequence, attempt in attempts.items():
            self._go_back(before)
            self.drive.rest(self.road)
            try:
                result = self._process(attempt, factors)
            except Exception:  # the next attempt does less
                continue
            self._unused = None
            return replace(result, notice="; ".join(filter(None, [failed, consequence, result.notice])))
        self._go_back(before)
        self._unused = cycle.odometry
        return self._result(cycle.detections.t, {}, None, f"{failed}; the cycle is not used")

    def _go_back(self, before: _Before) -> None:
        """Restore the state before a cycle; `before` can be used again."""
        self.front_end, self.road = before.front_end.copy(), before.road.copy()
        self.drive, self.phase = before.drive.copy(), before.phase.copy()
        self.health = before.health

    def _admit(
        self, odometry: Odometry, detections: Detections, factors: Sequence[gtsam.NonlinearFactor]
    ) -> Admitted:
        try:
            self.road.smoother.check_factors(factors)
        except SettingsError:
            self.front_end.gate.refuse()
            raise
        cycle, unused = self.front_end.admit(odometry, detections), self._unused
        return cycle if unused is None else replace(cycle, odometry=unused.followed_by(cycle.odometry))

    def finish(self) -> None:
        """Wait for a running batch and use its result, after the last cycle of a drive.

        A return in the last metres of a drive closes the loop only here.
        """
        self.phase.begin(self.road, self.drive, self.front_end.noise)
        outcome = self.drive.solver.last_outcome(self.road.next_cycle - 1)
        if outcome is not None:
            self.phase = self.phase.take(self.road, self.drive, outcome).phase

    def _result(self, t: float, stages: dict[str, float], jump: Array | None, notice: str) -> CycleResult:
        road = self.road
        left, right = (road.boundaries[b].size if b in road.boundaries else 0 for b in (LEFT, RIGHT))
        pose = road.poses[-1].copy() if len(road.poses) else np.zeros(POSE)
        detections, closed = road.smoother.map.detections, road.closed
        used = int(detections.used[detections.cycle.searchsorted(road.next_cycle - 1) :].sum())
        return CycleResult(t, pose, (left, right), used, closed, stages, jump, notice, self.health)

    def noise_used(self) -> RunNoise:
        """Return the noise in use, and the newest measurement."""
        return self.front_end.noise_used
