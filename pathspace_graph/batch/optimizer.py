"""Levenberg-Marquardt on a whole log, in rounds that refresh foot points, gates and weights."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.elimination import Damping, Elimination, linear_graph
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.state import State

from .association import associate, cone_counts, locate_poses
from .simplification import reknot
from .system import LOOSE_GATE, BatchSystem, Biweight, Evaluation, moved

STATION_PASSES: Final = 2  # times that detections are matched with the cones of a closed optimum
GATE_FACTOR: Final = 0.7  # factor of the gate from each round to the next, down to `batch.gate`
SEARCH: Final = 20  # rounds in which associations are found anew
SETTLE_FEET: Final = 8  # most refinements of the foot points before a step
POSE_STEPS: Final = 3  # Gauss-Newton steps of the poses alone at first, while the map of the start is held
ROUGH_TOLERANCE: Final = 40.0  # factor of the tolerances in the first optimization
TOLERANCE_COST: Final = 1e-5  # most |cost_before - cost_after| over a round at convergence, over the cost
TOLERANCE_CURVE: Final = 2e-3  # largest move of a curve across itself in a round then, as seen from poses (m)
TOLERANCE_DECREASE: Final = 5e-3  # most decrease of the cost by an undamped step then; one sigma has 1/2
CURVE_SAMPLES: Final = 2  # points in each knot interval at which the movement of a curve is measured
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
    """Norm `sqrt(g' H^-1 g)` of the gradient g at the end, with H the information of all variables: the
    distance of the linear problem's optimum in joint sigmas. A slow common motion of the whole map counts as
    much in it as that of a control point."""


@dataclass(frozen=True)
class Effort:
    """Length of the search for the optimum of a log."""

    rough_rounds: int = 24  # most rounds of the first optimization, on knots that follow the start
    rounds: int = 80  # most rounds of a later one; one that uses them all is reported as not converged
    knot_passes: int = 2  # most later ones; there is more than one only if the number of cones has changed
    tolerance: float = 1.0  # factor of every tolerance


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
        """Return the optimum on curves with about one knot for each cone, which meet the cones."""
        detections, settings, effort = self.system.detections, self.system.settings, self.effort
        first_gate = self.settings.gate if self.system.revisits else LOOSE_GATE
        state = self.align_poses(state, POSE_STEPS, first_gate)
        state = reknot(state, detections, settings, dense=True)
        at, _ = self.run(state, first_gate, effort.rough_rounds, rough=True)
        for _ in range(effort.knot_passes):
            cones = cone_counts(at.state, detections, settings)
            state = reknot(at.state, detections, settings, dense=True)
            at, convergence = self.run(state, self.settings.gate, effort.rounds)
            if cone_counts(at.state, detections, settings) == cones:
                break
        curves = at.state.boundaries.values()
        if settings.stations and curves and all(boundary.periodic for boundary in curves):
            for _ in range(STATION_PASSES):
                at, convergence = self.run(at.state, self.settings.gate, effort.rounds, stations=True)
        return at, convergence

    def align_poses(self, state: State, steps: int, gate: float) -> State:
        """Return the state after Gauss-Newton steps of the poses alone, beside its map and calibration."""
        self.system.begin(state)
        for _ in range(steps):
            locate_poses(state)
            state = moved(state, self.system.poses_alone(self._refreshed(state, gate, False)))
        return state

    def run(
        self, state: State, gate: float, rounds: int, rough: bool = False, stations: bool = False
    ) -> tuple[Evaluation, Convergence]:
        """Optimize in rounds until nothing changes, and return the problem there.

        Each round takes one step. The gate (sigmas) shrinks to that of the settings (graduated robust
        weights), and only then may it end. After `SEARCH` rounds, or half of them, associations and sigmas
        stay: where two rows are near, some would change for ever. The end of a `rough` one isn't measured.
        With `stations`, cones of closed curves hold the detections along them.
        """
        system = self.system
        locate_poses(state)
        system.begin(state, stations)
        self._last_step, tolerance = None, (ROUGH_TOLERANCE if rough else 1.0) * self.effort.tolerance
        cost, done, searched, search = np.inf, 0, 0, max(min(SEARCH, rounds // 2), 1)
        while done < rounds:
            done, gate = done + 1, max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            system.kernel = Biweight(gate)
            held, searched = searched >= search, searched + strict
            if not strict and done > 1:
                locate_poses(state)
            before = self._refreshed(state, gate, strict, held)
            at = self._step(before)
            state, gain, cost = at.state, abs(cost - at.cost), at.cost
            if self._on_round is not None:
                self._on_round()
            still = strict and gain <= tolerance * TOLERANCE_COST * cost
            if still and self._movement(before.state, state) <= tolerance * TOLERANCE_CURVE:
                at = self._refreshed(state, gate, strict, held)
                decrease = 0.0 if rough else self.predicted_decrease(at)
                if decrease <= tolerance * TOLERANCE_DECREASE:
                    converged, reason = True, "nothing changes any more"
                    break
            gate *= GATE_FACTOR
        else:
            converged, reason = False, "no round left"
            decrease = 0.0 if rough else self.predicted_decrease(at)
        norm = float(np.sqrt(2.0 * max(decrease, 0.0)))
        return at, Convergence(converged, reason, done, self.steps, at.cost, norm)

    def _refreshed(self, state: State, gate: float, strict: bool, held: bool = False) -> Evaluation:
        """Return the problem of a new round, with the associations and sigmas of the last one if `held`.

        Its foot points have arrived: else the cost would change without a step.
        """
        system = self.system
        system.detections.correct(state.variables.sensor)
        if not held:
            associate(state, system.detections, system.settings, gate, strict)
        at = system.evaluate(state, hold=not held)
        for _ in range(SETTLE_FEET):
            self._keep_foot_points(at)
            before, at = at, system.evaluate(state, hold=not held)
            if abs(before.cost - at.cost) <= self.effort.tolerance * TOLERANCE_COST * at.cost:
                break
        return at

    def _keep_foot_points(self, at: Evaluation) -> None:
        """Let later evaluations refine the foot points from where they are now."""
        self.system.detections.refine(at.across.rows, at.u)

    def _movement(self, before: State, after: State) -> float:
        """Return how far a curve has moved across itself (m), as the poses beside it see it."""
        farthest = 0.0
        for label, gauge in self.system.gauges.items():
            boundary, points = before.boundaries[label], before.control_points(label)
            offset = gauge.carried(points, before.poses, after.poses) - after.control_points(label)
            u = np.linspace(boundary.tables.low, boundary.tables.high, CURVE_SAMPLES * boundary.size)
            normal = after.spline(label).normal_unit(u)
            across = (boundary.evaluate(offset, u) * normal).sum(axis=1)
            farthest = max(farthest, float(np.abs(across).max()))
        return farthest

    def predicted_decrease(self, at: Evaluation) -> float:
        """Return `1/2 g' H^-1 g`, with gradient g and information H: the linear gain of an undamped step.

        A step of one sigma in any direction has 1/2, however far it leads in metres.
        """
        problem, layout = self.system.eliminated(at), at.state.variables.layout
        step = problem.step(np.zeros(problem.map.size))
        return -0.5 * float(gradient(self.system.rows(at), layout) @ step)

    def _step(self, at: Evaluation) -> Evaluation:
        """Return the problem after the least damped step that makes the cost smaller, or the same one."""
        self._keep_foot_points(at)
        rows = self.system.rows(at)
        while not self.damping.exhausted:
            self.steps += 1
            trial = self._trial(at, rows)
            if trial is not None:
                self.damping.lower()
                self._keep_foot_points(trial)
                return trial
            self.damping.grow()
        self.damping.reset()
        return at

    def _trial(self, at: Evaluation, rows: Sequence[Rows]) -> Evaluation | None:
        """Return the problem after a damped step, or None if the cost has grown."""
        state, system = at.state, self.system
        damped = [*rows, *system.damping(state, self.damping.weight)]
        try:
            problem = Elimination(linear_graph(damped, state.variables), state.variables.layout)
            step = problem.step(np.zeros(problem.map.size))
        except SingularSystemError:
            return None
        trial = system.evaluate(system.retract(state, step))
        if trial.cost > at.cost:
            return None
        before, self._last_step = self._last_step, step[: problem.map.size]
        factor = 1.0 if before is None else extrapolation_factor(self._last_step, before)
        if factor == 1.0:
            return trial
        other = system.evaluate(system.retract(state, factor * step))
        return min(trial, other, key=lambda evaluation: evaluation.cost)


def extrapolation_factor(step: Array, before: Array) -> float:
    """Return `1 / (1 - r)`: how much longer a step (n,) is made, r being its share of the step before.

    Aitken's process for vectors, with r by least squares, and 1 where |r| isn't between `CREEP_SHARES`.
    Robust weights, held sigmas and foot points on a bend let Gauss-Newton converge only linearly: it creeps
    (r > 0), or oscillates (r < 0), where a shorter step ends it.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if CREEP_SHARES[0] < abs(share) < CREEP_SHARES[1] else 1.0


def gradient(groups: Sequence[Rows], layout: Layout) -> Array:
    """Return the gradient `J' r` (n,) of all rows, by the columns of the layout."""
    groups = [rows for rows in groups if len(rows)]
    columns = np.concatenate([rows.columns(layout).ravel() for rows in groups])
    slopes = np.concatenate([(rows.jacobian * rows.residual[:, None]).ravel() for rows in groups])
    return np.asarray(np.bincount(columns, slopes, layout.size), np.float64)
