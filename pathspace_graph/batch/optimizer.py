"""Levenberg-Marquardt on a whole log, in rounds that refresh foot points, gates and weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.log_odometry import half_square
from pathspace_graph.graph.elimination import Damping, linear_graph, solution
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.state import State

from .association import locate_poses
from .simplification import reknot
from .system import LOOSE_GATE, BatchSystem, Evaluation, moved

GATE_FACTOR: Final = 0.7  # factor of the gate from each round to the next, down to `batch.gate`
CHANGED_SHARE: Final = 1e-3  # largest share of detections that change in the last round of associations
TOLERANCE_DECREASE: Final = 0.05  # largest predicted decrease of the cost in the last step; one sigma is 1/2
ROUGH_TOLERANCE: Final = 100.0  # factor of the tolerance while knots or stations still change
CREEP_SHARES: Final = (0.3, 0.97)  # ratio of a step to the last one between which it is extrapolated


@dataclass(frozen=True, eq=False)
class Convergence:
    """End of an optimization."""

    converged: bool
    reason: str
    rounds: int  # number of refreshes of foot points, gates and weights
    steps: int  # Levenberg-Marquardt steps, including rejected ones
    cost: float  # half the sum of squares with robust losses at the end
    gradient: float
    """Norm `sqrt(g' H^-1 g)` of the gradient g, with the information H of all variables: the length of the
    last step in joint sigmas, or of the next one without convergence. A slow motion of the whole map counts
    as much as the motion of one control point."""


@dataclass(frozen=True)
class Effort:
    """Limits of the search for the optimum of a log."""

    rough_rounds: int = 24  # largest number of rounds of the first optimization, on the knots of the start
    rounds: int = 80  # largest number of rounds of later ones; all used means not converged
    tolerance: float = 1.0  # factor of the tolerance


@dataclass(frozen=True)
class Stage:
    """Part of a search: what changes before it, and what ends it."""

    gate: float  # gate of the first round (sigmas); it shrinks to `batch.gate`
    rounds: int  # largest number of rounds
    tolerance: float = 1.0  # factor of the tolerance
    refit: bool = False  # whether curves are first fitted again through their cones
    stations: bool = False  # whether detections are matched to the cones of closed curves


class Optimizer:
    """Levenberg-Marquardt from a state to the minimum; `on_round` is called after each round."""

    def __init__(
        self, system: BatchSystem, effort: Effort | None = None, on_round: Callable[[], None] | None = None
    ) -> None:
        self.system, self.settings = system, system.settings.batch
        self.effort, self.damping, self._on_round = effort or Effort(), Damping(), on_round
        self.steps = 0  # number of steps tried
        self._last_step: Array | None = None  # last step of the map and the calibration

    def find(self, state: State) -> tuple[Evaluation, Convergence]:
        """Find the optimum on curves with about one knot for each cone, which meet the cones."""
        first, *others = self.schedule(state)
        at, convergence = self.run(self.align_poses(state, first.gate), first)
        for stage in others:
            at, convergence = self.run(at.state, stage)
        return at, convergence

    def schedule(self, state: State) -> list[Stage]:
        """Stages of the search; on closed curves, stations constrain the detections along them at the end."""
        gate, rounds, rough = self.settings.gate, self.effort.rounds, self.effort.tolerance * ROUGH_TOLERANCE
        first_gate = gate if self.system.revisits else LOOSE_GATE
        first = Stage(first_gate, self.effort.rough_rounds, rough, refit=True)
        curves = state.boundaries.values()
        closed = bool(curves) and all(curve.periodic for curve in curves)
        stations = self.system.settings.stations and closed
        return [first, Stage(gate, rounds, self.effort.tolerance, refit=True, stations=stations)]

    def align_poses(self, state: State, gate: float) -> State:
        """Take one Gauss-Newton step of the poses alone, with fixed map and calibration."""
        self.system.begin(state)
        locate_poses(state)
        self.system.associate(state, gate, strict=False)
        return moved(state, self.system.poses_alone(self.system.evaluate(state, hold=True)))

    def run(self, state: State, stage: Stage) -> tuple[Evaluation, Convergence]:
        """Optimize in rounds until a step is short, and return the problem after it.

        Each round takes one step. The gate (sigmas) shrinks to that of the settings (graduated
        non-convexity), and the search ends only afterwards. When hardly any association changes, all of them
        and the sigmas are fixed: between two near rows, some would change forever.
        """
        system, gate, rounds = self.system, stage.gate, stage.rounds
        tolerance = TOLERANCE_DECREASE * stage.tolerance
        if stage.refit:
            state = reknot(state, system.detections, system.settings)
        locate_poses(state)
        system.begin(state, stage.stations)
        self._last_step, searching, converged, done = None, True, False, 0
        while not converged and done < rounds:
            done, gate = done + 1, max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            if searching:
                if not strict and done > 1:
                    locate_poses(state)
                changed = system.associate(state, gate, strict)
                at = system.evaluate(state, hold=True)
                settled = changed <= CHANGED_SHARE * len(system.detections) or done > rounds // 2
                searching = not (strict and settled)
            at, decrease = self._step(at, tolerance)
            state = at.state
            if self._on_round is not None:
                self._on_round()
            converged = not searching and decrease <= tolerance
            gate *= GATE_FACTOR
        reason = "nothing changes any more" if converged else "no round left"
        if not converged:
            rows, variables = system.rows(at), at.state.variables
            undamped = solution(linear_graph(rows, variables), variables.layout)
            decrease = predicted_decrease(rows, variables.layout, undamped)
        norm = float(np.sqrt(2.0 * max(decrease, 0.0)))
        return at, Convergence(converged, reason, done, self.steps, at.cost, norm)

    def _keep_foot_points(self, at: Evaluation) -> None:
        """Let later evaluations refine the foot points from their present places."""
        self.system.detections.refine(at.across.rows, at.u)

    def _step(self, at: Evaluation, tolerance: float) -> tuple[Evaluation, float]:
        """Take the least damped step that decreases the cost; without one, the problem does not change.

        Return the problem and the predicted decrease. A step within the tolerance is not tried again.
        """
        self._keep_foot_points(at)
        rows = self.system.rows(at)
        decrease = np.inf
        while not self.damping.exhausted:
            self.steps += 1
            trial, decrease = self._trial(at, rows)
            if trial is not None:
                self.damping.lower()
                self._keep_foot_points(trial)
                return trial, decrease
            if decrease <= tolerance:
                return at, decrease
            self.damping.grow()
        self.damping.reset()
        return at, decrease

    def _trial(self, at: Evaluation, rows: Sequence[Rows]) -> tuple[Evaluation | None, float]:
        """Return the problem after a damped step, None if the cost has grown, and the predicted decrease."""
        state, system, layout = at.state, self.system, at.state.variables.layout
        damped = [*rows, *system.damping(state, self.damping.weight)]
        try:
            step = solution(linear_graph(damped, state.variables), layout)
        except SingularSystemError:
            return None, np.inf
        decrease = np.inf
        if self.damping.is_light:  # a strongly damped step is short without convergence
            decrease = predicted_decrease(rows, layout, step)
        trial = system.evaluate(system.retract(state, step))
        if trial.cost > at.cost:
            return None, decrease
        before, self._last_step = self._last_step, step[: layout.size - state.poses.size]
        factor = 1.0 if before is None else extrapolation_factor(self._last_step, before)
        if factor == 1.0:
            return trial, decrease
        other = system.evaluate(system.retract(state, factor * step))
        return min(trial, other, key=lambda evaluation: evaluation.cost), decrease


def extrapolation_factor(step: Array, before: Array) -> float:
    """Factor `1 / (1 - r)` of a step (n,), where r is its ratio to the step before (Aitken's process).

    r is found by least squares. The factor is 1 if |r| is not between `CREEP_SHARES`. Robust weights, fixed
    sigmas and foot points on a bend make Gauss-Newton converge only linearly: it creeps (r > 0), or
    oscillates (r < 0) and a shorter step ends it.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if CREEP_SHARES[0] < abs(share) < CREEP_SHARES[1] else 1.0


def predicted_decrease(groups: Sequence[Rows], layout: Layout, step: Array) -> float:
    """Decrease `1/2 |r|^2 - 1/2 |J d + r|^2` of all rows by a step d (n,), for the linear problem.

    For an undamped step it is `1/2 g' H^-1 g`, with gradient g and information H: 1/2 for a step of one
    sigma.
    """
    after = (kernels.moved_residual(layout, rows, -step) for rows in groups if len(rows))
    return half_square(groups) - sum(0.5 * float(residual @ residual) for residual in after)
