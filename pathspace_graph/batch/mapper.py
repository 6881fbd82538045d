"""The offline batch: every pose, every detection and both curves of a log in one least-squares problem."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Final

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, solving
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.front_end.front_end import JudgedLog, judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system
from pathspace_graph.graph.gaussian import FactoredSystem, cholesky
from pathspace_graph.graph.variables import Layout, are_poses, pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary, joint_covariance
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult, VehicleState
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.laps import LapCounter
from pathspace_graph.lengths import POSE
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.motion import doubted, known_noise
from pathspace_graph.mapping.revisit import Revisit
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.tentative import OrangeCones, Sighting
from pathspace_graph.run import Stopwatch, settings_dict
from pathspace_graph.scale import log_at_scale
from pathspace_graph.settings.batch import Start
from pathspace_graph.settings.mapper import MapperSettings

from .lap import evidence, is_true_closure
from .nonlinear_graph import nonlinear_graph
from .optimizer import LOOSE_GATE, Convergence, Optimizer
from .simplification import Scatter, map_block, scatter_of_cones, simplify
from .start import CurveMapper, find_recurrence, start_odometry, start_online
from .system import BatchSystem, Biweight, Evaluation, own_settings

NAME: Final = "spline"
"""Name of the estimator on the command line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult(BatchRun):
    """The result of a batch optimization, how it ended, and its uncertainty."""

    LENGTHS: ClassVar = RunResult.LENGTHS | {"map_covariance": 2, "scatter": 0, "online": 0}

    convergence: Convergence
    map_covariance: Array
    """Joint covariance (2m, 2m) of the control points of both boundaries, left first, in m^2. It comes from
    the measurements alone: the scatter of the cones isn't added."""
    scatter: Scatter
    """Distance of the cones from the map's curves, which have too few control points to follow them."""
    calibration: Array
    """Calibration (2,): scale error of the speeds [-], bias of the yaw rate [rad/s]."""
    online: RunResult | None
    """Online run that the batch began with, if it did."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage (s)."""
    system: BatchSystem
    """Problem that was solved, on curves with about one knot for each cone."""
    optimum: Evaluation

    @cached_property
    def pose_covariances(self) -> Array:
        """Return the marginal covariance (n, 3, 3) of each pose (x, y, theta), map frame, computed once."""
        with threadpool_limits(limits=1):
            weights = self.scale ** np.array(POSE, float)
            return np.outer(weights, weights) * self.system.eliminated(self.optimum).pose_marginals

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the whole problem at the optimum by `nonlinear_graph`; its lengths are over the scale."""
        return nonlinear_graph(self.system, self.optimum)

    def values(self) -> gtsam.Values:
        """Return the optimum over the scale: control points l_j and r_j, calibration b_0, poses x_k."""
        variables = self.optimum.state.variables
        return variables.gtsam_values(variables.keys)


@log_at_scale
class BatchMapper:
    """Mapper of a whole log at once."""

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        online: Callable[[MapperSettings, KnownNoise], CurveMapper] | None = None,
    ) -> None:
        """Keep the settings, and the standard deviation (3,) of a measured twist (m/s, m/s, rad/s).

        `online` makes the online mapper whose map the optimization begins with, if not at odometry.
        """
        self.settings = settings or MapperSettings()
        self.online = online
        self.noise = known_noise(odometry_sigma)

    def solve(
        self, log: Log, start: Start | None = None, on_round: Callable[[], None] | None = None
    ) -> BatchResult:
        """Return the optimum, which is searched from an online map or from odometry alone.

        By default `batch.start` decides. `on_round` is called after each round. SettingsError if there is no
        online mapper to begin with, and SolveError where the log leaves no way to an optimum.
        """
        with threadpool_limits(limits=1), solving("the batch"):
            return self._solve(log, start or self.settings.batch.start, on_round)

    def _solve(self, log: Log, start: Start, on_round: Callable[[], None] | None) -> BatchResult:
        watch = Stopwatch()
        judged = judge_log(log, self.noise, own_settings(self.settings))
        settings = judged.settings
        chain, detections = judged.chain, DetectionTable.of(judged.cycles, twists=judged.chain.twists)
        system = BatchSystem(detections, chain, settings, Biweight(LOOSE_GATE))
        optimizer = Optimizer(system, on_round=on_round)
        watch.lap("integrate")
        if start == "odometry":
            online = None
            at, convergence = find_optimum_from_odometry(optimizer)
        else:
            state, online, system.revisits = self._start_online(log)
            watch.lap("start")
            at, convergence = optimizer.find(state)
        at, convergence = _with_doubt(optimizer, at, convergence)
        watch.lap("optimum")
        joint, vehicle = system.eliminated(at).joint(at.state.map_keys), _vehicle(system, at)
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
            vehicle=vehicle,
            online=online,
            seconds=watch.laps,
            system=system,
            optimum=at,
        )

    def _start_online(self, log: Log) -> tuple[State, RunResult, tuple[Revisit, ...]]:
        if self.online is None:
            raise SettingsError("start online: expected an online mapper to begin with, found none")
        mapper = self.online(replace(self.settings, scale=1.0), self.noise)
        return *start_online(log, mapper), mapper.revisits


def _vehicle(system: BatchSystem, at: Evaluation) -> VehicleState:
    """Return the last pose and the calibration, with their joint covariance."""
    variables, last = at.state.variables, pose_key(len(at.state.poses) - 1)
    keys = variables.layout.keys
    kept = Layout(keys[~are_poses(keys) | (keys == last)])
    information, _ = eliminated_system(system.linear_graph(at), kept)
    covariance = FactoredSystem(kept, cholesky(information)).covariance(
        np.append(last, variables.calibration_keys)
    )
    return VehicleState.split(at.state.poses[-1], variables.calibrations, covariance)


def find_optimum_from_odometry(optimizer: Optimizer) -> tuple[Evaluation, Convergence]:
    """Return the optimum whose search begins at odometry alone.

    Where the path recurs, the loop is closed, and it stays closed if the detections are for it.
    """
    system = optimizer.system
    chain, detections, settings = system.chain, system.detections, system.settings
    recurrence = find_recurrence(chain.dead_reckoned(np.zeros(CALIBRATION_SIZE)), settings)
    state = start_odometry(chain, detections, settings, recurrence)
    at, convergence = optimizer.find(state)
    if not state.closed or is_true_closure(evidence(at, detections, settings), settings):
        return at, convergence
    return optimizer.find(start_odometry(chain, detections, settings, recurrence.denied()))


def _with_doubt(
    optimizer: Optimizer, at: Evaluation, convergence: Convergence
) -> tuple[Evaluation, Convergence]:
    """Return the optimum, searched again while it contradicts the prior of a calibration."""
    system, variables = optimizer.system, at.state.variables
    variance = np.diag(system.eliminated(at).joint(variables.calibration_keys))
    believed = doubted(variables.calibrations, variance, system.settings)
    if believed == system.settings:
        return at, convergence
    system.settings = believed
    system.chain = replace(system.chain, calibration_sigma=np.array(believed.odometry.sigmas_calibration))
    return _with_doubt(optimizer, *optimizer.find(at.state))


def _map(state: State, joint: Array, scatter: Scatter) -> Map:
    """Return the curves with their covariance, to which the scatter of the cones is added."""
    boundaries = {}
    for label, boundary in state.boundaries.items():
        block = map_block(state, label)
        sigma = np.repeat(scatter.sigma(label, boundary.abscissae), 2)
        covariance = joint[block, block] + np.diag(sigma**2)
        boundaries[label] = SplineBoundary(state.spline(label), covariance)
    return Map(state.closed, boundaries, joint_covariance(joint, boundaries))


def _orange(judged: JudgedLog, state: State, settings: MapperSettings) -> dict[int, PointBoundary]:
    cones, twists = OrangeCones(settings.growth, settings.spline.sigma_shape), judged.chain.twists
    for k, detections in enumerate(judged.orange):
        cones.add(Sighting(k, state.poses[k], twists[k], detections), state.variables.sensor)
    return cones.points()


def _records(
    state: State, detections: DetectionTable, chain: LogOdometry, seconds: float
) -> tuple[tuple[CycleRecord, ...], int]:
    """Return a record of each cycle, with its share of the seconds, and the number of complete laps."""
    left, right = (state.boundaries[b].size if b in state.boundaries else 0 for b in (LEFT, RIGHT))
    used = np.bincount(detections.cycle[detections.used], minlength=len(chain)).tolist()
    offered = np.bincount(detections.cycle, minlength=len(chain)).tolist()
    counter, share = LapCounter(), seconds / len(chain)
    records = tuple(
        CycleRecord(k, t, share, left, right, used[k], counter.update(state.poses[k]), offered=offered[k])
        for k, t in enumerate(chain.stamps.tolist())
    )
    return records, counter.completed
