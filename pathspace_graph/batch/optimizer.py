"""Levenberg-Marquardt on a whole log, in rounds that refresh foot points, gates and weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.gaussian import graph_of
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import BatchSettings

from .association import associate, locate_poses
from .system import BatchSystem, Biweight, Evaluation, moved

Array = NDArray[np.float64]

SEARCH: Final = 20
"""Associations are found anew in this number of rounds."""
SETTLE: Final = 8
"""Foot points are refined again at most this number of times before a step."""


@dataclass(frozen=True, eq=False)
class Convergence:
    """Holds how an optimization ended."""

    converged: bool
    """This is true where nothing changed any more."""
    reason: str
    """This is why the optimization stopped."""
    rounds: int
    """Foot points, gates and weights were refreshed this number of times."""
    steps: int
    """This is the number of Levenberg-Marquardt steps, including rejected ones."""
    cost: float
    """This is half the sum of squares with robust losses at the end."""
    gradient: float
    """This is the norm `sqrt(g' H^-1 g)` of the gradient g at the end, with H the information of all
    variables. It is the distance of the linear problem's optimum in joint sigmas. A slow common motion of the
    whole map counts as much in it as that of a control point."""


@dataclass(frozen=True)
class Schedule:
    """Says how an optimization goes on from round to round."""

    gate: float
    """The first round has this gate (sigmas)."""
    rounds: int
    """The optimization ends after this number of rounds at the latest."""
    tolerance: float = 1.0
    """Every tolerance of the settings is multiplied by this."""


class Optimizer:
    """An optimizer takes a state to the minimum of the problem."""

    def __init__(self, system: BatchSystem, settings: BatchSettings) -> None:
        self.system = system
        self.settings = settings
        self.steps = 0
        """This is the number of steps that were tried."""
        self._damping = settings.damping
        self._last_step: Array | None = None
        """This is the last step of the map and the calibration."""

    # --- rounds ------------------------------------------------------------------------------------------

    def run(
        self, state: State, schedule: Schedule, on_round: Callable[[], None] | None = None
    ) -> tuple[Evaluation, Convergence]:
        """Optimizes in rounds until nothing changes, and returns the problem there.

        The gate shrinks from the schedule's to that of the settings (graduated robust weights), and only then
        may the optimization end. Each round takes one step. After `SEARCH` rounds, or half of them,
        associations and sigmas stay as they are: where two rows are near, some would change for ever.
        """
        system, gate = self.system, schedule.gate
        locate_poses(state, self.settings.association)
        system.begin(state)
        self._last_step = None
        at: Evaluation | None = None
        cost, searched = np.inf, 0
        search = max(min(SEARCH, schedule.rounds // 2), 1)
        for number in range(1, schedule.rounds + 1):
            gate = max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            system.kernel = Biweight(gate)
            held, searched = searched >= search, searched + strict
            before = self._refreshed(state, gate, strict, held)
            at = self._step(before)
            state, gain, cost = at.state, abs(cost - at.cost), at.cost
            if on_round is not None:
                on_round()
            if strict and self._is_still(before, at, gain, schedule.tolerance):
                at = self._refreshed(state, gate, strict, held)
                decrease = self.predicted_decrease(at)
                if decrease <= schedule.tolerance * self.settings.tolerance_decrease:
                    return at, self._report(at, number, "nothing changes any more", decrease)
            gate *= self.settings.gate_factor
        assert at is not None
        return at, self._report(at, schedule.rounds, "no round left", self.predicted_decrease(at), False)

    def align_poses(self, state: State, steps: int, gate: float) -> State:
        """Returns the state after Gauss-Newton steps of the poses alone, beside its map and calibration."""
        self.system.begin(state)
        for _ in range(steps):
            state = moved(state, self.system.poses_alone(self._refreshed(state, gate, False)))
        return state

    def _refreshed(self, state: State, gate: float, strict: bool, held: bool = False) -> Evaluation:
        """Returns the problem of a new round: with new places of the poses, associations and sigmas.

        Associations and sigmas are those of the round before if `held`.
        """
        system = self.system
        if not strict:
            locate_poses(state, self.settings.association)
        system.detections.correct(state.variables.sensor)
        if not held:
            associate(state, system.detections, system.settings, gate, strict)
        return self._settled(state, held)

    def _settled(self, state: State, held: bool) -> Evaluation:
        """Returns the problem with foot points that stay where they are when they are refined again.

        Where one is still on its way along a tight bend, the cost changes without a step.
        """
        at = self.system.evaluate(state, hold=not held)
        for _ in range(SETTLE):
            self._keep_foot_points(at)
            before, at = at, self.system.evaluate(state, hold=not held)
            if abs(before.cost - at.cost) <= self.settings.tolerance_cost * at.cost:
                break
        return at

    def _is_still(self, before: Evaluation, after: Evaluation, gain: float, tolerance: float) -> bool:
        """Returns whether a round has changed neither the curves, as their poses see them, nor the cost."""
        settings = self.settings
        still = self._movement(before.state, after.state) <= tolerance * settings.tolerance_curve
        return still and gain <= tolerance * settings.tolerance_cost * after.cost

    def _movement(self, before: State, after: State) -> float:
        """Returns how far a curve has moved across itself (m), seen from the poses beside its control points.

        A motion along itself doesn't count, nor a motion of the curve with its poses: `predicted_decrease`
        judges the latter in sigmas, since the end of a long open road swings by metres within its own.
        """
        farthest = 0.0
        for label, gauge in self.system.gauges.items():
            boundary, points = before.boundaries[label], before.control_points(label)
            offset = gauge.carried(points, before.poses, after.poses) - after.control_points(label)
            count = max(int(self.settings.curve_samples * boundary.size), 2)
            u = np.linspace(boundary.tables.low, boundary.tables.high, count)
            normal = left_of(boundary.evaluate(after.control_points(label), u, 1))
            normal /= np.maximum(np.hypot(*normal.T), np.finfo(float).tiny)[:, None]
            across = (boundary.evaluate(offset, u) * normal).sum(axis=1)
            farthest = max(farthest, float(np.abs(across).max()))
        return farthest

    def predicted_decrease(self, at: Evaluation) -> float:
        """Returns by how much an undamped step would make the cost smaller, if the problem were linear.

        This is half of `g' H^-1 g`, with gradient g and information H: a step of one sigma in any direction
        has 1/2, however far it leads in metres.
        """
        problem, layout = self.system.eliminated(at), at.state.variables.layout
        step = problem.step(np.zeros(problem.map.size))
        return -0.5 * float(gradient(self.system.rows(at), layout) @ step)

    def _report(
        self, at: Evaluation, rounds: int, reason: str, decrease: float, converged: bool = True
    ) -> Convergence:
        norm = float(np.sqrt(2.0 * max(decrease, 0.0)))
        return Convergence(converged, reason, rounds, self.steps, at.cost, norm)

    # --- steps -------------------------------------------------------------------------------------------

    def _step(self, at: Evaluation) -> Evaluation:
        """Returns the problem after a step that makes the cost smaller, or the same one if there is none.

        The damping grows until such a step is found.
        """
        settings = self.settings
        self._keep_foot_points(at)
        graph = self.system.linear_graph(at)
        while self._damping <= settings.damping_most:
            self.steps += 1
            trial = self._trial(at, graph, self._damping)
            if trial is not None:
                self._damping = max(settings.damping_down * self._damping, settings.damping_least)
                self._keep_foot_points(trial)
                return trial
            self._damping *= settings.damping_up
        self._damping = settings.damping
        return at

    def _trial(self, at: Evaluation, graph: gtsam.GaussianFactorGraph, damping: float) -> Evaluation | None:
        """Returns the problem after a damped step (1/m^2), or None if the cost has grown."""
        state = at.state
        try:
            problem = Elimination(
                graph_of(graph, self.system.damping(state, damping)), state.variables.layout
            )
            step = problem.step(np.zeros(problem.map.size))
        except SingularSystemError:
            return None
        trial = self.system.evaluate(self.system.retract(state, step))
        if trial.cost > at.cost:
            return None
        before, self._last_step = self._last_step, step[: problem.map.size]
        factor = 1.0 if before is None else extrapolation_factor(self._last_step, before, self.settings)
        if factor > 1.0:
            farther = self.system.evaluate(self.system.retract(state, factor * step))
            trial = min(trial, farther, key=lambda evaluation: evaluation.cost)
        return trial

    def _keep_foot_points(self, at: Evaluation) -> None:
        """Lets later evaluations refine the foot points from where they are now."""
        for projected in at.projected.values():
            self.system.detections.refine(projected.rows, projected.foot.u)


def extrapolation_factor(step: Array, before: Array, settings: BatchSettings) -> float:
    """Returns `1 / (1 - r)`: how much longer a step (n,) is made, r being its share of the step before.

    This is Aitken's process for vectors, with r by least squares. The result is 1 where r isn't between the
    settings' bounds. Robust weights, held sigmas and foot points on a curve that bends let Gauss-Newton
    converge only linearly, slowest where few detections hold the curve.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if settings.share_least < share < settings.share_most else 1.0


def gradient(groups: Sequence[Rows], layout: Layout) -> Array:
    """Returns the gradient `J' r` (n,) of all rows, by the columns of the layout."""
    groups = [rows for rows in groups if len(rows)]
    columns = np.concatenate([rows.columns(layout).ravel() for rows in groups])
    slopes = np.concatenate([(rows.jacobian * rows.residual[:, None]).ravel() for rows in groups])
    return np.asarray(np.bincount(columns, slopes, layout.size), np.float64)
