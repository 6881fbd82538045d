"""Levenberg-Marquardt on a whole log, in rounds that refresh foot points, gates and weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.log_odometry import half_square
from pathspace_graph.graph.elimination import Damping, Elimination, linear_graph
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.state import State

from .association import associate, locate_poses
from .simplification import reknot
from .system import LOOSE_GATE, BatchSystem, Biweight, Evaluation, moved

GATE_FACTOR: Final = 0.7  # factor of the gate from each round to the next, down to `batch.gate`
CHANGED_SHARE: Final = 1e-3  # largest share of detections that change in the last round of associations
POSE_STEPS: Final = 1  # Gauss-Newton steps of the poses alone at first, while the map of the start is held
TOLERANCE_DECREASE: Final = 0.05  # most decrease of the cost that the last step predicts; one sigma has 1/2
ROUGH_TOLERANCE: Final = 100.0  # its factor before the last optimization, on knots or stations that change
CREEP_SHARES: Final = (0.3, 0.97)  # of a step in the one before, between which it is extrapolated


@dataclass(frozen=True, eq=False)
class Convergence:
    """End of an optimization."""

    converged: bool  # whether nothing changed any more
    reason: str
    rounds: int  # times that foot points, gates and weights were refreshed
    steps: int  # Levenberg-Marquardt steps, including rejected ones
    cost: float  # half the sum of squares with robust losses at the end
    gradient: float
    """Norm `sqrt(g' H^-1 g)` of the gradient g, with H the information of all variables: the length of the
    last step in joint sigmas, or of the next one where it did not converge. A slow common motion of the whole
    map counts as much in it as that of a control point."""


@dataclass(frozen=True)
class Effort:
    """Length of the search for the optimum of a log."""

    rough_rounds: int = 24  # most rounds of the first optimization, on knots that follow the start
    rounds: int = 80  # most rounds of a later one; one that uses them all is reported as not converged
    tolerance: float = 1.0  # factor of the tolerance


class Optimizer:
    """Levenberg-Marquardt from a state to the minimum; `on_round` is called after each round."""

    def __init__(
        self, system: BatchSystem, effort: Effort | None = None, on_round: Callable[[], None] | None = None
    ) -> None:
        self.system, self.settings = system, system.settings.batch
        self.effort, self.damping, self._on_round = effort or Effort(), Damping(), on_round
        self.steps = 0  # steps that were tried
        self._last_step: Array | None = None  # of the map and the calibration

    def find(self, state: State) -> tuple[Evaluation, Convergence]:
        """Return the optimum on curves with about one knot for each cone, which meet the cones.

        Where the curves are closed, their cones hold the detections along them.
        """
        detections, settings, rounds = self.system.detections, self.system.settings, self.effort.rounds
        gate = self.settings.gate
        first_gate = gate if self.system.revisits else LOOSE_GATE
        state = self.align_poses(state, POSE_STEPS, first_gate)
        state = reknot(state, detections, settings, dense=True)
        at, _ = self.run(state, first_gate, self.effort.rough_rounds, rough=True)
        state = reknot(at.state, detections, settings, dense=True)
        curves = [*state.boundaries.values()]
        if not (settings.stations and curves and all(curve.periodic for curve in curves)):
            return self.run(state, gate, rounds)
        for stations in (False, True):
            at, _ = self.run(state, gate, rounds, rough=True, stations=stations)
            state = at.state
        return self.run(state, gate, rounds, stations=True)  # more detections are of one cone beside it

    def align_poses(self, state: State, steps: int, gate: float) -> State:
        """Return the state after Gauss-Newton steps of the poses alone, beside its map and calibration."""
        self.system.begin(state)
        for _ in range(steps):
            locate_poses(state)
            at, _ = self._refreshed(state, gate, False)
            state = moved(state, self.system.poses_alone(at))
        return state

    def run(
        self, state: State, gate: float, rounds: int, rough: bool = False, stations: bool = False
    ) -> tuple[Evaluation, Convergence]:
        """Optimize in rounds until a step is short, and return the problem after it.

        Each round takes one step. The gate (sigmas) shrinks to that of the settings (graduated robust
        weights), and only then may it end. Once hardly any association changes, all of them and the sigmas
        stay: where two rows are near, some would change for ever. A `rough` one ends sooner. With `stations`,
        cones of closed curves hold the detections along them.
        """
        system, tolerance = self.system, TOLERANCE_DECREASE * self.effort.tolerance
        tolerance *= ROUGH_TOLERANCE if rough else 1.0
        locate_poses(state)
        system.begin(state, stations)
        self._last_step, searching, converged, done = None, True, False, 0
        while not converged and done < rounds:
            done, gate = done + 1, max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            if searching:
                if not strict and done > 1:
                    locate_poses(state)
                at, changed = self._refreshed(state, gate, strict)
                settled = changed <= CHANGED_SHARE * len(system.detections) or done > rounds // 2
                searching = not (strict and settled)
            at, decrease = self._step(at, tolerance)
            state = at.state
            if self._on_round is not None:
                self._on_round()
            converged = not searching and decrease <= tolerance
            gate *= GATE_FACTOR
        reason = "nothing changes any more" if converged else "no round left"
        decrease = decrease if converged else self._undamped_decrease(at)
        norm = float(np.sqrt(2.0 * max(decrease, 0.0)))
        return at, Convergence(converged, reason, done, self.steps, at.cost, norm)

    def _refreshed(self, state: State, gate: float, strict: bool) -> tuple[Evaluation, int]:
        """Return the problem with new associations and sigmas, and how many of the associations are new.

        Its foot points have arrived: else the cost would change without a step.
        """
        system, detections = self.system, self.system.detections
        before = np.where(detections.used, detections.boundary, UNKNOWN)
        system.kernel = Biweight(gate)
        detections.correct(state.variables.sensor)
        associate(state, detections, system.settings, gate, strict)
        system.settle(state)
        changed = np.where(detections.used, detections.boundary, UNKNOWN) != before
        return system.evaluate(state, hold=True), int(changed.sum())

    def _keep_foot_points(self, at: Evaluation) -> None:
        """Let later evaluations refine the foot points from where they are now."""
        self.system.detections.refine(at.across.rows, at.u)

    def _step(self, at: Evaluation, tolerance: float) -> tuple[Evaluation, float]:
        """Return the problem after the least damped step that makes the cost smaller, or the same one.

        The other is the decrease that the step predicts; none within the tolerance is tried again.
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

    def _undamped_decrease(self, at: Evaluation) -> float:
        problem = self.system.eliminated(at)
        step = problem.step(np.zeros(problem.map.size))
        return predicted_decrease(self.system.rows(at), at.state.variables.layout, step)

    def _trial(self, at: Evaluation, rows: Sequence[Rows]) -> tuple[Evaluation | None, float]:
        """Return the problem after a damped step, None if the cost has grown, and the predicted decrease."""
        state, system = at.state, self.system
        damped = [*rows, *system.damping(state, self.damping.weight)]
        try:
            problem = Elimination(linear_graph(damped, state.variables), state.variables.layout)
            step = problem.step(np.zeros(problem.map.size))
        except SingularSystemError:
            return None, np.inf
        decrease = np.inf
        if self.damping.is_light:  # a step is short as well where the damping holds it
            decrease = predicted_decrease(rows, state.variables.layout, step)
        trial = system.evaluate(system.retract(state, step))
        if trial.cost > at.cost:
            return None, decrease
        before, self._last_step = self._last_step, step[: problem.map.size]
        factor = 1.0 if before is None else extrapolation_factor(self._last_step, before)
        if factor == 1.0:
            return trial, decrease
        other = system.evaluate(system.retract(state, factor * step))
        return min(trial, other, key=lambda evaluation: evaluation.cost), decrease


def extrapolation_factor(step: Array, before: Array) -> float:
    """Return `1 / (1 - r)`: how much longer a step (n,) is made, r being its share of the step before.

    Aitken's process for vectors, with r by least squares, and 1 where |r| isn't between `CREEP_SHARES`.
    Robust weights, held sigmas and foot points on a bend let Gauss-Newton converge only linearly: it creeps
    (r > 0), or oscillates (r < 0), where a shorter step ends it.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if CREEP_SHARES[0] < abs(share) < CREEP_SHARES[1] else 1.0


def predicted_decrease(groups: Sequence[Rows], layout: Layout, step: Array) -> float:
    """Return `1/2 |r|^2 - 1/2 |J d + r|^2` of all rows after a step d (n,): the gain of the linear problem.

    An undamped step has `1/2 g' H^-1 g`, with gradient g and information H: 1/2 where it is one sigma long.
    """
    after = (kernels.moved_residual(layout, rows, -step) for rows in groups if len(rows))
    return half_square(groups) - sum(0.5 * float(residual @ residual) for residual in after)
