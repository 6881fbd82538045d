"""Offline batch: every pose, every detection and both curves of a log in one least-squares problem."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Final

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, SolveError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import compose, inverse
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system
from pathspace_graph.graph.exchange import pose_graph
from pathspace_graph.graph.gaussian import FactoredSystem, cholesky
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    SENSOR_KEY,
    Layout,
    are_poses,
    pose_key,
    pose_keys,
)
from pathspace_graph.graph.window import check_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary, joint_covariance
from pathspace_graph.io.results import BatchRun, CycleRecord, RunNoise, RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.laps import LapCounter
from pathspace_graph.lengths import POSE_LENGTHS
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.motion import known_noise, vehicle_of, with_inflated_priors, with_size
from pathspace_graph.mapping.tracks import OrangeDetections, orange_cones
from pathspace_graph.run import Stopwatch, settings_dict, solved
from pathspace_graph.settings.mapper import MapperSettings, Start, known_settings

from .lap import evidence_against, unmapped
from .simplification import Scatter, map_block, own_settings, simplified
from .start import CurveMapper, find_revisits, start_odometry, start_online
from .system import (
    BatchSystem,
    Convergence,
    Evaluation,
    Optimizer,
    OwnFactors,
    drive_factors,
    nonlinear_graph,
)

NAME: Final = "spline"  # name of the estimator on the command line


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class BatchResult(BatchRun):
    """Result of a batch optimization, its convergence, and its uncertainty."""

    LENGTHS: ClassVar = RunResult.LENGTHS | {
        **dict.fromkeys(("scatter", "online", "objection"), 0),
        "map_covariance": 2,
    }

    convergence: Convergence
    map_covariance: Array
    """Joint covariance (2m, 2m) of the control points of both boundaries, left first, in m^2, from the
    measurements alone, without the scatter of the cones."""
    scatter: Scatter
    """Distance of the cones from the map's curves, which have too few control points to meet them."""
    calibration: Array
    """Calibration (2,): scale error of the speeds (-), bias of the yaw rate (rad/s)."""
    online: RunResult | None
    """Online run in which the batch began, if any."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage (s)."""
    system: BatchSystem
    """Problem that was solved, on curves with about one knot for each cone."""
    optimum: Evaluation
    objection: str = ""
    """Evidence against the map as a whole; empty if there is none."""
    drive: int = 0
    """Index of the drive in the problem."""

    @cached_property
    def pose_covariances(self) -> Array:
        """Marginal covariance (n, 3, 3) of each pose (x, y, theta), map frame, computed once."""
        with threadpool_limits(limits=1):
            weights = self.scale ** np.array(POSE_LENGTHS, float)
            marginals = self.system.eliminated(self.optimum).pose_marginals
            lengths = self.optimum.state.poses * [1.0, 1.0, 0.0]
            size = self.system.settings.odometry.sigma_size
            marginals = marginals + size**2 * lengths[:, :, None] * lengths[:, None, :]
            state = self.optimum.state
            own = state.drives.parts(len(state.poses))[self.drive]
            return (np.outer(weights, weights) * marginals)[own]

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the whole problem at the optimum by `nonlinear_graph`; lengths are divided by the scale."""
        return nonlinear_graph(self.system, self.optimum)

    def pose_graph(self) -> gtsam.NonlinearFactorGraph:
        """Return odometry and revisits by `graph.exchange:pose_graph`; lengths are divided by the scale."""
        factors = drive_factors(self.system, self.optimum)  # no need for those of detections
        return pose_graph(factors, self.system.chains[0].odometry, self.calibration)

    @property
    def own_factors(self) -> tuple[int, float]:
        """Number of your own factors, and their share of `cost`."""
        return len(self.system.own), self.optimum.own_cost

    def values(self) -> gtsam.Values:
        """Return the optimum divided by the scale: control points l_j and r_j, calibration b_0, poses x_k."""
        variables = self.optimum.state.variables
        return variables.gtsam_values(variables.keys)


@dataclass(frozen=True, eq=False)
class Found:
    """An optimum and its convergence."""

    optimizer: Optimizer
    at: Evaluation
    convergence: Convergence

    @property
    def system(self) -> BatchSystem:
        """Problem that was solved."""
        return self.optimizer.system


class BatchMapper:
    """Mapper of a whole log at once."""

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        """Take the settings and the standard deviation (3,) of a measured twist (m/s, m/s, rad/s).

        `online` makes an online mapper, whose map is the start of the optimization if odometry is not.
        """
        self.settings = known_settings(settings)
        self.online = online
        self.odometry_sigma = odometry_sigma
        known_noise(odometry_sigma)  # check it early

    def factors(self, log: Log) -> OwnFactors:
        """Return factors of your own for a log at scale 1; none, unless a subclass has some."""
        return ()

    def solve(
        self,
        log: Log,
        start: Start | None = None,
        on_round: Callable[[], None] | None = None,
        factors: OwnFactors | None = None,
    ) -> BatchResult:
        """Search the optimum, from odometry alone or from an online map.

        `start` is by default `batch.start` of the settings. `on_round` is called after each round. `factors`
        are GTSAM factors of your own, by default those of the method `factors`: on the poses of cycles
        (`graph.variables:pose_key`, `Pose2`) and on the calibrations, as `BatchResult.values` has them.
        Curves get new knots during the search, so factors on control points come from a function instead. It
        is called with the present state whenever the curves are new, and `boundaries`, `control_points` and
        `control_keys` of that are as those of a `FixedLagMapper`. Factors are linearized at every step, their
        errors by GTSAM count in its cost, and `graph` has them. SettingsError for other keys or a factor that
        depends on nothing, or if the start needs an online mapper and there is none; SolveError if the log
        does not determine an optimum.
        """
        settings = self.settings.with_kind(log.sensor.kind)
        factors = self.factors(log.at_scale_one()) if factors is None else factors
        if not callable(factors):
            factors = tuple(factors)
            calibrations = [CALIBRATION_KEY, *([SENSOR_KEY] if settings.calibration.sensor else [])]
            known = np.append(calibrations, pose_keys(np.arange(len(log.cycles))))
            expected = f"poses, x0 to x{len(log.cycles) - 1}, and of the calibrations"
            check_keys(factors, known, f"{expected}, as a function makes those on control points")
        return solved(partial(self._solve, settings, start, on_round, factors), log)

    def _solve(
        self,
        settings: MapperSettings,
        start: Start | None,
        on_round: Callable[[], None] | None,
        factors: OwnFactors,
        log: Log,
    ) -> BatchResult:
        """Judge the log, search the optimum from odometry or an online map, and simplify its curves."""
        watch, noise = Stopwatch(), known_noise(self.odometry_sigma)
        start, judged = start or settings.batch.start, judge_log(log, noise, own_settings(settings))
        watch.lap("integrate")

        def optimizer_with(revisits: Sequence[Revisit]) -> Optimizer:
            """Make an optimizer with detections of its own, independent of other searches."""
            detections = DetectionTable.of(judged.cycles, twists=judged.chain.twists)
            system = BatchSystem(detections, [judged.chain], [judged.settings], revisits, own=factors)
            return Optimizer(system, on_round=on_round)

        begun, online = None, None
        revisits = () if start == "online" else find_revisits(judged)
        if start != "online":
            begun = find_closed_optimum(optimizer_with(revisits))
        if begun is None and start == "odometry":
            optimizer = optimizer_with(())
            begun = Found(optimizer, *optimizer.find(start_odometry(optimizer.system)))
        if begun is None:
            if self.online is None:
                raise SettingsError("start online: expected an online mapper, found none")
            watch.lap("optimum")
            mapper = self.online(settings, noise)
            state, online = start_online(log, mapper, judged.settings)
            watch.lap("start")
            if start == "auto" and not revisits:
                begun = find_closed_optimum(optimizer_with(mapper.closed_by))
            if begun is None:
                optimizer = optimizer_with(mapper.revisits)
                begun = Found(optimizer, *optimizer.find(state))
        found, known = with_wider_priors(begun)
        watch.lap("optimum")
        seen = OrangeDetections.of(judged.orange, twists=judged.chain.twists)
        seen.place(0, found.at.state.poses)
        own = judged.settings
        orange = orange_cones(seen, found.at.state.variables.sensor, own.growth, own.spline.sigma_shape)
        drives = [(settings_dict(settings), judged.noise)]
        return replace(results_of(found, known, drives, orange, watch)[0], online=online)


def find_closed_optimum(optimizer: Optimizer) -> Found | None:
    """Search the optimum from odometry and revisits.

    None without revisits, if the search fails, or with evidence against the map.
    """
    system = optimizer.system
    if not system.revisits:
        return None
    try:
        found = Found(optimizer, *optimizer.find(start_odometry(system)))
    except SolveError:
        return None
    against = evidence_against(system, found.at, found.at.state.splines, system.detections)
    return None if against else found


def with_wider_priors(found: Found) -> tuple[Found, FactoredSystem]:
    """Search the optimum again while it contradicts the prior of a calibration; return it and `known_of`."""
    system, state, widened = found.system, found.at.state, False
    known = known_of(system, found.at)
    for drive, settings in enumerate(system.priors):
        keys = state.calibration_keys(drive)
        variance = np.diag(known.covariance(keys))
        wider = with_inflated_priors(state.variables.of(keys), variance, settings)
        if wider != settings:
            system.widen_priors(drive, wider)
            widened = True
    if not widened:
        return found, known
    return with_wider_priors(Found(found.optimizer, *found.optimizer.find(state)))


# --- the parts of a result -------------------------------------------------------------------------------


def results_of(
    found: Found,
    known: FactoredSystem,
    drives: Sequence[tuple[dict[str, Any], RunNoise | None]],
    orange: Mapping[int, PointBoundary],
    watch: Stopwatch,
) -> list[BatchResult]:
    """Simplify the curves of an optimum, and return the result of each drive, given its settings and noise.

    All have the same map, and the wall times of all drives together. `known` is that of `known_of`.
    """
    state, system, settings = found.at.state, found.system, found.system.settings
    size = settings.odometry.sigma_size
    joint = with_size(known.covariance(state.map_keys), state.map_points.ravel(), size)
    watch.lap("covariance")
    few = simplified(state, system.detections, settings)
    joint = few.change @ joint @ few.change.T
    watch.lap("simplify")
    boundaries, counts = dict[int, SplineBoundary](), {LEFT: 0, RIGHT: 0}
    for label, boundary in few.state.boundaries.items():
        block, counts[label] = map_block(few.state, label), boundary.size
        sigma = np.repeat(few.scatter.of_control_points(label, boundary), 2)
        has_cones = state.closed and not settings.of_lines
        u = few.scatter.places[label] if has_cones else np.zeros(0)
        cones = np.column_stack([u, np.full(len(u), settings.spline.sigma_shape)])
        covariance = joint[block, block] + np.diag(sigma**2)
        boundaries[label] = SplineBoundary(few.state.spline(label), covariance, cones=cones)
    track = Map(state.closed, boundaries, joint_covariance(joint, boundaries), points=dict(orange))
    results, parts = list[BatchResult](), state.drives.parts(len(state.poses))
    for drive, ((entries, noise), part) in enumerate(zip(drives, parts, strict=True)):
        poses, detections, chain = state.poses[part].copy(), few.detections, system.chains[drive]
        # count laps from the start of the drive
        driven = compose(inverse(frame_of_drive(chain, poses)), poses) if drive > 0 else poses
        used, offered = (
            np.bincount(cycles, minlength=part.stop)[part].tolist()
            for cycles in (detections.cycle[detections.used], detections.cycle)
        )
        counter, share = LapCounter(), sum(watch.laps.values()) / len(parts) / len(chain)
        sizes = counts[LEFT], counts[RIGHT]
        records = tuple(
            CycleRecord(k, t, share, *sizes, used[k], counter.update(driven[k]), offered=offered[k])
            for k, t in enumerate(chain.stamps.tolist())
        )
        keys, own = state.calibration_keys(drive), detections.of_drive(drive)
        covariance = known.covariance(np.append(pose_key(part.stop - 1), keys))
        vehicle = vehicle_of(poses[-1], state.variables.of(keys), covariance, size)
        result = BatchResult(
            estimator=NAME,
            settings=entries,
            map=track,
            scatter=few.scatter,
            trajectory_t=chain.stamps,
            trajectory=poses,
            cycles=records,
            laps=counter.completed,
            converged=found.convergence.converged,
            cost=found.convergence.cost,
            convergence=found.convergence,
            map_covariance=joint,
            calibration=vehicle.calibration,
            noise=noise,
            vehicle=vehicle,
            online=None,
            seconds=watch.laps,
            system=system,
            optimum=found.at,
            objection=unmapped(replace(own, cycle=own.cycle - part.start), poses),
            drive=drive,
        )
        results.append(result)
    return results


def known_of(system: BatchSystem, at: Evaluation) -> FactoredSystem:
    """Factorize the system of the map, the calibrations and each last pose; other poses are eliminated."""
    keys, state = at.state.variables.layout.keys, at.state
    last = [pose_key(part.stop - 1) for part in state.drives.parts(len(state.poses))]
    kept = Layout(keys[~are_poses(keys) | np.isin(keys, last)])
    return FactoredSystem(kept, cholesky(eliminated_system(system.linear_graph(at), kept)[0]))


def frame_of_drive(chain: LogOdometry, poses: Array) -> Array:
    """Pose (3,) of the vehicle at the first stamp of a drive, given the poses (P, 3) of its cycles."""
    return compose(poses[0], inverse(chain.first))
