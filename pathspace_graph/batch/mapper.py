"""The offline batch: every pose, every reading and both curves of a log, in one least-squares problem."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.laps import LapCounter
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.measurements import Chain, collect_detections, integrate_log
from pathspace_graph.mapping.state import State
from pathspace_graph.run import Stopwatch, settings_dict
from pathspace_graph.settings.mapper import ODOMETRY_SIGMA, MapperSettings

from .cones import cone_counts
from .dead_reckoning import start_odometry
from .knots import map_block, reknot, simplified
from .nonlinear_graph import nonlinear_graph
from .optimizer import Convergence, Optimizer, Schedule
from .scatter import Scatter, scatter_of_cones
from .start import CurveMapper, start_online
from .system import BatchSystem, Biweight, Evaluation

Array = NDArray[np.float64]
Start = Literal["online", "odometry"]

NAME = "spline"
"""What the command line calls this estimator."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchResult(BatchRun):
    """What the batch optimization gives: a run's result, how it ended, and how sure it is."""

    convergence: Convergence
    """Whether and how it converged."""
    map_covariance: Array
    """(2m, 2m) m^2, joint covariance of both boundaries' control points, left first: what the readings say,
    without the cones' scatter."""
    scatter: Scatter
    """How far cones stand off the curves: what no curve of that size follows."""
    calibration: Array
    """(2,) scale error of the speeds, bias of the yaw rate (rad/s)."""
    online: RunResult | None
    """The online run that it began at, where it did."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage."""
    system: BatchSystem
    """The problem that was solved, on curves of nearly a knot for each cone."""
    optimum: Evaluation
    """The same where it ended."""

    @cached_property
    def pose_covariances(self) -> Array:
        """(n, 3, 3) marginal covariance of each pose (x, y, theta), map frame; found when first asked for."""
        with threadpool_limits(limits=1):
            return self.system.eliminated(self.optimum).pose_marginals

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The whole problem at the optimum as GTSAM's own nonlinear factors (see `nonlinear_graph`)."""
        return nonlinear_graph(self.system, self.optimum)

    def values(self) -> gtsam.Values:
        """The optimum: control points l_j and r_j, calibration b_0, poses x_k."""
        variables = self.optimum.state.variables
        return variables.gtsam_values(variables.keys)


class BatchMapper:
    """Maps a whole log at once. `odometry_sigma` (3,): standard deviation of a twist (m/s, m/s, rad/s).

    `online` makes the online mapper whose map the optimization begins with. A start from odometry needs none.
    """

    def __init__(
        self,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | None = None,
        online: Callable[[MapperSettings, Array], CurveMapper] | None = None,
    ) -> None:
        self.settings = settings or MapperSettings()
        self.online = online
        self.odometry_sigma = np.array(ODOMETRY_SIGMA if odometry_sigma is None else odometry_sigma, float)

    def solve(
        self, log: Log, start: Start = "online", on_round: Callable[[], None] | None = None
    ) -> BatchResult:
        """The optimum from an online run's map, or from odometry alone."""
        with threadpool_limits(limits=1):
            return self._solve(log, start, on_round)

    def _solve(self, log: Log, start: Start, on_round: Callable[[], None] | None) -> BatchResult:
        settings, batch, watch = own_settings(self.settings), self.settings.batch, Stopwatch()
        if start == "online" and self.online is None:
            raise SettingsError("start online: expected an online mapper to begin with, found none")
        chain = integrate_log(log, self.odometry_sigma, settings.odometry)
        detections = collect_detections(log)
        system = BatchSystem(detections, chain, settings, Biweight(batch.loose_gate))
        optimizer = Optimizer(system, batch)
        watch.lap("integrate")
        online = None
        if start == "online" and self.online is not None:
            state, online = start_online(log, self.online(self.settings, self.odometry_sigma))
        else:
            state = start_odometry(chain, detections, settings)
        watch.lap("start")
        state = optimizer.hold_map(state, batch.pose_steps, batch.loose_gate)
        watch.lap("poses")
        at, convergence = _optimum(optimizer, state, detections, settings, on_round)
        watch.lap("optimum")
        joint = system.eliminated(at).joint(at.state.map_keys)
        watch.lap("covariance")
        detections = deepcopy(detections)  # those of the problem stay as they were solved for
        state, joint = simplified(at.state, joint, detections, settings)
        scatter = scatter_of_cones(state, detections, settings)
        watch.lap("simplify")
        return BatchResult(
            estimator=NAME,
            settings=settings_dict(self.settings),
            map=_map(state, joint, scatter),
            scatter=scatter,
            trajectory_t=chain.stamps,
            trajectory=at.state.poses.copy(),
            cycles=_records(state, detections, chain, sum(watch.laps.values())),
            laps=_completed(at.state.poses),
            converged=convergence.converged,
            convergence=convergence,
            map_covariance=joint,
            calibration=at.state.calibration.copy(),
            online=online,
            seconds=watch.laps,
            system=system,
            optimum=at,
        )


def _optimum(
    optimizer: Optimizer,
    state: State,
    detections: DetectionTable,
    settings: MapperSettings,
    on_round: Callable[[], None] | None,
) -> tuple[Evaluation, Convergence]:
    """The optimum on curves of nearly a knot for each cone, which meet them all.

    Chosen anew where a cone was missing or put down twice.
    """
    batch = settings.batch
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
    """The settings with the batch's own in place of what they stand for online."""
    batch = settings.batch
    return replace(
        settings,
        spline=replace(settings.spline, sigma_model=batch.sigma_model),
        gauge=replace(settings.gauge, sigma_smoothness=batch.sigma_smoothness),
    )


def _map(state: State, joint: Array, scatter: Scatter) -> Map:
    """The curves with their joint covariance, to which the cones' scatter is added."""
    closed = any(boundary.periodic for boundary in state.boundaries.values())
    boundaries = {}
    for label, boundary in state.boundaries.items():
        block = map_block(state, label)
        spline = boundary.spline(state.control_points(label).copy())
        sigma = np.repeat(scatter.sigma(label, boundary.abscissae), 2)
        covariance = joint[block, block] + np.diag(sigma**2)
        boundaries[label] = SplineBoundary(spline, covariance)
    return Map(closed, boundaries)


def _records(
    state: State, detections: DetectionTable, chain: Chain, seconds: float
) -> tuple[CycleRecord, ...]:
    """A record of each cycle: its share of the time, its readings in use, its lap."""
    left, right = (state.boundaries[b].size if b in state.boundaries else 0 for b in (LEFT, RIGHT))
    used = np.bincount(detections.cycle[detections.used], minlength=len(chain))
    counter = LapCounter()
    return tuple(
        CycleRecord(
            k, float(t), seconds / len(chain), left, right, int(used[k]), counter.update(state.poses[k])
        )
        for k, t in enumerate(chain.stamps)
    )


def _completed(poses: Array) -> int:
    """Complete laps, one that ends just short of the line included."""
    counter = LapCounter()
    for pose in poses:
        counter.update(pose)
    return counter.completed
