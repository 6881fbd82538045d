"""The offline batch: every pose, every detection and both curves of a log in one least-squares problem."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import gtsam
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, solving
from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.front_end.front_end import JudgedLog, judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system
from pathspace_graph.graph.gaussian import FactoredSystem, cholesky
from pathspace_graph.graph.keys import are_poses, pose_key
from pathspace_graph.graph.variables import Layout
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary, joint_covariance
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult, VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.laps import LapCounter
from pathspace_graph.lengths import POSE, scaled
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.motion import doubted, known_noise
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.tentative import OrangeCones, Sighting
from pathspace_graph.run import Stopwatch, settings_dict
from pathspace_graph.scale.door import log_at_scale
from pathspace_graph.settings.batch import Start
from pathspace_graph.settings.mapper import MapperSettings

from .closure import evidence, is_true_closure
from .cones import cone_counts
from .dead_reckoning import start_odometry
from .knots import reknot
from .nonlinear_graph import nonlinear_graph
from .optimizer import Convergence, Optimizer, Schedule
from .recurrence import find_recurrence
from .simplification import Scatter, map_block, scatter_of_cones, simplify
from .start import CurveMapper, start_online
from .system import BatchSystem, Biweight, Evaluation

Array = NDArray[np.float64]

NAME = "spline"
"""This is the name of the estimator on the command line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult(BatchRun):
    """Holds the result of a batch optimization, how it ended, and its uncertainty."""

    LENGTHS: ClassVar = RunResult.LENGTHS | {"map_covariance": 2, "scatter": 0, "online": 0}

    convergence: Convergence
    """This is how the optimization ended."""
    map_covariance: Array
    """This is the joint covariance (2m, 2m) of the control points of both boundaries, left first, in m^2. It
    comes from the measurements alone: the scatter of the cones isn't added."""
    scatter: Scatter
    """This is how far cones lie from the map's curves, which have too few control points to follow them."""
    calibration: Array
    """This is the calibration (2,): scale error of the speeds [-], bias of the yaw rate [rad/s]."""
    online: RunResult | None
    """This is the online run that the batch began with, if it did."""
    seconds: dict[str, float] = field(default_factory=dict)
    """This is the wall time of each stage (s)."""
    system: BatchSystem
    """This is the problem that was solved, on curves with about one knot for each cone."""
    optimum: Evaluation
    """This is the problem at the optimum."""

    @cached_property
    def pose_covariances(self) -> Array:
        """Returns the marginal covariance (n, 3, 3) of each pose (x, y, theta), map frame.

        It is computed when it is first asked for.
        """
        with threadpool_limits(limits=1):
            weights = self.scale ** np.array(POSE, float)
            return np.outer(weights, weights) * self.system.eliminated(self.optimum).pose_marginals

    @cached_property
    def vehicle_state(self) -> VehicleState:
        """Returns the last pose and the calibration, with their joint covariance.

        It is computed when it is first asked for.
        """
        variables, last = self.optimum.state.variables, pose_key(len(self.trajectory) - 1)
        with threadpool_limits(limits=1):
            keys = variables.layout.keys
            kept = Layout(keys[~are_poses(keys) | (keys == last)])
            information, _ = eliminated_system(self.system.linear_graph(self.optimum), kept)
            system = FactoredSystem(kept, cholesky(information))
            covariance = system.covariance(np.append(last, variables.calibration_keys))
        pose = self.optimum.state.poses[-1]
        return scaled(VehicleState.split(pose, variables.calibrations, covariance), self.scale)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Returns the whole problem at the optimum as GTSAM's nonlinear factors (see `nonlinear_graph`).

        Its lengths are over the scale.
        """
        return nonlinear_graph(self.system, self.optimum)

    def values(self) -> gtsam.Values:
        """Returns the optimum: control points l_j and r_j, calibration b_0, poses x_k.

        Its lengths are over the scale.
        """
        variables = self.optimum.state.variables
        return variables.gtsam_values(variables.keys)


@log_at_scale
class BatchMapper:
    """A batch mapper maps a whole log at once."""

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        """Keeps the settings, and the standard deviation (3,) of a measured twist (m/s, m/s, rad/s).

        `online` makes the online mapper whose map the optimization begins with. A start from odometry needs
        none.
        """
        self.settings = settings or MapperSettings()
        self.online = online
        self.noise = known_noise(odometry_sigma)

    def solve(
        self, log: Log, start: Start | None = None, on_round: Callable[[], None] | None = None
    ) -> BatchResult:
        """Returns the optimum, which is searched from an online map or from odometry alone.

        By default `batch.start` decides. `on_round` is called after each round. SettingsError if there is no
        online mapper to begin with, and SolveError where the log leaves no way to an optimum.
        """
        with threadpool_limits(limits=1), solving("the batch"):
            return self._solve(log, start or self.settings.batch.start, on_round)

    def _solve(self, log: Log, start: Start, on_round: Callable[[], None] | None) -> BatchResult:
        settings, batch, watch = own_settings(self.settings), self.settings.batch, Stopwatch()
        judged = judge_log(log, self.noise, settings)
        settings = judged.settings
        chain, detections = judged.chain, DetectionTable.of(judged.cycles, twists=judged.chain.twists)
        system = BatchSystem(detections, chain, settings, Biweight(batch.loose_gate))
        optimizer = Optimizer(system, batch)
        watch.lap("integrate")
        if start == "odometry":
            online = None
            at, convergence = find_optimum_from_odometry(optimizer, settings, on_round)
        else:
            state, online = self._start_online(log)
            watch.lap("start")
            at, convergence = find_optimum(optimizer, state, settings, on_round)
        at, convergence = _with_doubt(optimizer, at, convergence, settings, on_round)
        watch.lap("optimum")
        joint = system.eliminated(at).joint(at.state.map_keys)
        watch.lap("covariance")
        detections = deepcopy(detections)  # the result's problem keeps its own associations
        state, joint = simplify(at.state, joint, detections, settings)
        scatter = scatter_of_cones(state, detections, settings)
        watch.lap("simplify")
        records, laps = _records(state, detections, chain, sum(watch.laps.values()))
        return BatchResult(
            estimator=NAME,
            settings=settings_dict(self.settings),
            map=replace(_map(state, joint, scatter), points=_orange(judged, at.state, settings)),
            scatter=scatter,
            trajectory_t=chain.stamps,
            trajectory=at.state.poses.copy(),
            cycles=records,
            laps=laps,
            converged=convergence.converged,
            cost=convergence.cost,
            convergence=convergence,
            map_covariance=joint,
            calibration=at.state.calibration.copy(),
            noise=judged.noise,
            online=online,
            seconds=watch.laps,
            system=system,
            optimum=at,
        )

    def _start_online(self, log: Log) -> tuple[State, RunResult]:
        """Returns the start from an online run of the log, and the run."""
        if self.online is None:
            raise SettingsError("start online: expected an online mapper to begin with, found none")
        return start_online(log, self.online(replace(self.settings, scale=1.0), self.noise))


def _with_doubt(
    optimizer: Optimizer,
    at: Evaluation,
    convergence: Convergence,
    settings: MapperSettings,
    on_round: Callable[[], None] | None,
) -> tuple[Evaluation, Convergence]:
    """Returns the optimum, searched again while it contradicts the prior of a calibration."""
    system, variables = optimizer.system, at.state.variables
    variance = np.diag(system.eliminated(at).joint(variables.calibration_keys))
    believed = doubted(variables.calibrations, variance, settings)
    if believed == settings:
        return at, convergence
    system.settings = believed
    system.chain = replace(system.chain, calibration_sigma=np.array(believed.odometry.sigmas_calibration))
    at, convergence = find_optimum(optimizer, at.state, believed, on_round)
    return _with_doubt(optimizer, at, convergence, believed, on_round)


def find_optimum_from_odometry(
    optimizer: Optimizer, settings: MapperSettings, on_round: Callable[[], None] | None = None
) -> tuple[Evaluation, Convergence]:
    """Returns the optimum whose search begins at odometry alone.

    Where the path recurs, the loop is closed, and it stays closed if the detections are for it.
    """
    chain, detections = optimizer.system.chain, optimizer.system.detections
    recurrence = find_recurrence(chain.dead_reckoned(np.zeros(CALIBRATION_SIZE)), settings)
    state = start_odometry(chain, detections, settings, recurrence)
    at, convergence = find_optimum(optimizer, state, settings, on_round)
    if not state.closed or is_true_closure(evidence(at, detections, settings), settings):
        return at, convergence
    state = start_odometry(chain, detections, settings, recurrence.denied())
    return find_optimum(optimizer, state, settings, on_round)


def find_optimum(
    optimizer: Optimizer,
    state: State,
    settings: MapperSettings,
    on_round: Callable[[], None] | None = None,
) -> tuple[Evaluation, Convergence]:
    """Returns the optimum on curves with about one knot for each cone, which meet the cones.

    The poses are first aligned beside the map of the start. The optimum is searched again if the number of
    cones has changed: then one was missing or was a duplicate.
    """
    batch, detections = settings.batch, optimizer.system.detections
    state = optimizer.align_poses(state, batch.pose_steps, batch.loose_gate)
    rough = Schedule(batch.loose_gate, batch.rough_rounds, batch.rough_tolerance)
    at, _ = optimizer.run(reknot(state, detections, settings, dense=True), rough, on_round)
    fine = Schedule(batch.gate, batch.max_rounds)
    for _ in range(batch.knot_passes):
        cones = cone_counts(at.state, detections, settings)
        at, convergence = optimizer.run(reknot(at.state, detections, settings, dense=True), fine, on_round)
        if cone_counts(at.state, detections, settings) == cones:
            break
    return at, convergence


def own_settings(settings: MapperSettings) -> MapperSettings:
    """Returns the settings with the batch's own values in the groups that it shares with online mapping."""
    batch = settings.batch
    return replace(
        settings,
        spline=replace(settings.spline, sigma_model=batch.sigma_model),
        gauge=replace(settings.gauge, sigma_smoothness=batch.sigma_smoothness),
    )


def _map(state: State, joint: Array, scatter: Scatter) -> Map:
    """Returns the curves with their covariance, to which the scatter of the cones is added."""
    boundaries = {}
    for label, boundary in state.boundaries.items():
        block = map_block(state, label)
        sigma = np.repeat(scatter.sigma(label, boundary.abscissae), 2)
        covariance = joint[block, block] + np.diag(sigma**2)
        boundaries[label] = SplineBoundary(state.spline(label), covariance)
    return Map(state.closed, boundaries, joint_covariance(joint, boundaries))


def _orange(judged: JudgedLog, state: State, settings: MapperSettings) -> dict[int, PointBoundary]:
    """Returns the orange cones by label, as the poses place them."""
    cones, twists = OrangeCones(settings.growth, settings.spline.sigma_shape), judged.chain.twists
    for k, detections in enumerate(judged.orange):
        cones.add(Sighting(k, state.poses[k], twists[k], detections), state.variables.sensor)
    return cones.points()


def _records(
    state: State, detections: DetectionTable, chain: LogOdometry, seconds: float
) -> tuple[tuple[CycleRecord, ...], int]:
    """Returns a record of each cycle, with its share of the seconds, and the number of complete laps."""
    left, right = (state.boundaries[b].size if b in state.boundaries else 0 for b in (LEFT, RIGHT))
    used = np.bincount(detections.cycle[detections.used], minlength=len(chain)).tolist()
    offered = np.bincount(detections.cycle, minlength=len(chain)).tolist()
    counter, share = LapCounter(), seconds / len(chain)
    records = tuple(
        CycleRecord(k, t, share, left, right, used[k], counter.update(state.poses[k]), offered=offered[k])
        for k, t in enumerate(chain.stamps.tolist())
    )
    return records, counter.completed
