"""Levenberg-Marquardt on a whole log, in rounds that refresh foot points, gates and weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.graph.keys import CALIBRATION_LETTER
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import BatchSettings

from .association import associate, locate_poses
from .system import BatchSystem, Biweight, Evaluation, moved

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Movement:
    """Holds how far a state has moved."""

    curve: float
    """This is the largest movement of a curve across itself (m)."""
    pose: float
    """This is the largest movement of a pose (m or rad, whichever is larger)."""


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
    """This is the norm of the gradient at the end, each entry in units of its own sigma."""


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
        may the optimization end. Each round takes one step.
        """
        system, gate = self.system, schedule.gate
        system.begin(state)
        locate_poses(state, self.settings.association)
        self._last_step = None
        at: Evaluation | None = None
        cost = np.inf
        for number in range(1, schedule.rounds + 1):
            gate = max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            system.kernel = Biweight(gate)
            before, cost_before = state, cost
            at = self._step(self._refreshed(state, gate, strict))
            state, cost = at.state, at.cost
            if on_round is not None:
                on_round()
            movement, gain = self._movement(before, state), abs(cost_before - cost)
            if strict and self._is_still(movement, gain, cost, schedule.tolerance):
                return at, self._report(at, number, "nothing changes any more", True)
            gate *= self.settings.gate_factor
        assert at is not None
        return at, self._report(at, schedule.rounds, "no round left", False)

    def align_poses(self, state: State, steps: int, gate: float) -> State:
        """Returns the state after Gauss-Newton steps of the poses alone, beside its map and calibration."""
        self.system.begin(state)
        for _ in range(steps):
            state = moved(state, self.system.poses_alone(self._refreshed(state, gate, False)))
        return state

    def _refreshed(self, state: State, gate: float, strict: bool) -> Evaluation:
        """Returns the problem of a new round: with new places of the poses, associations and sigmas."""
        system = self.system
        if not strict:
            locate_poses(state, self.settings.association)
        associate(state, system.detections, system.settings, gate, strict)
        if strict and system.settings.place.use == "cones":
            system.place(state)
        return system.evaluate(state, hold=True)

    def _is_still(self, movement: Movement, gain: float, cost: float, tolerance: float) -> bool:
        """Returns whether a round has changed neither the curves nor the poses nor the cost."""
        settings = self.settings
        curve, pose = tolerance * settings.tolerance_curve, tolerance * settings.tolerance_pose
        still = movement.curve <= curve and movement.pose <= pose
        return still and gain <= tolerance * settings.tolerance_cost * cost

    def _movement(self, before: State, after: State) -> Movement:
        """Returns how far a state has moved; that of a curve along itself doesn't count."""
        curve = 0.0
        for label, boundary in after.boundaries.items():
            count = max(int(self.settings.curve_samples * boundary.size), 2)
            u = np.linspace(boundary.tables.low, boundary.tables.high, count)
            tangent = boundary.evaluate(after.control_points(label), u, 1)
            normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
            normal /= np.maximum(np.hypot(*normal.T), np.finfo(float).tiny)[:, None]
            points = (boundary.evaluate(s.control_points(label), u) for s in (before, after))
            offset = next(points) - next(points)
            curve = max(curve, float(np.abs((offset * normal).sum(axis=1)).max()))
        pose = float(np.abs(after.poses - before.poses).max()) if len(after.poses) else 0.0
        return Movement(curve, pose)

    def _report(self, at: Evaluation, rounds: int, reason: str, converged: bool) -> Convergence:
        gradient = gradient_norm(self.system.rows(at), at.state.variables.layout)
        return Convergence(converged, reason, rounds, self.steps, at.cost, gradient)

    # --- steps -------------------------------------------------------------------------------------------

    def _step(self, at: Evaluation) -> Evaluation:
        """Returns the problem after a step that makes the cost smaller, or the same one if there is none.

        The damping grows until such a step is found.
        """
        settings = self.settings
        self._keep_foot_points(at)
        problem = self.system.eliminated(at)
        unit = unit_damping(problem.map)
        while self._damping <= settings.damping_most:
            self.steps += 1
            trial = self._trial(at, problem, self._damping * unit)
            if trial is not None:
                self._damping = max(settings.damping_down * self._damping, settings.damping_least)
                self._keep_foot_points(trial)
                return trial
            self._damping *= settings.damping_up
        self._damping = settings.damping
        return at

    def _trial(self, at: Evaluation, problem: Elimination, damping: Array) -> Evaluation | None:
        """Returns the problem after a step with the damping (n,), or None if the cost has grown."""
        try:
            step = problem.step(damping)
        except SingularSystemError:
            return None
        trial = self.system.evaluate(moved(at.state, step))
        if trial.cost > at.cost:
            return None
        before, self._last_step = self._last_step, step[: problem.map.size]
        factor = 1.0 if before is None else extrapolation_factor(self._last_step, before, self.settings)
        if factor > 1.0:
            farther = self.system.evaluate(moved(at.state, factor * step))
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


def unit_damping(layout: Layout) -> Array:
    """Returns a unit of damping (n,): ones for the control points, zeros for the calibration."""
    unit = np.ones(layout.size)
    unit[layout.block(CALIBRATION_LETTER)] = 0.0
    return unit


def gradient_norm(groups: Sequence[Rows], layout: Layout) -> float:
    """Returns the norm of `J' r`, each entry divided by the square root of that of `diag(J' J)`."""
    groups = [rows for rows in groups if len(rows)]
    columns = np.concatenate([rows.columns(layout).ravel() for rows in groups])
    slopes = np.concatenate([(rows.jacobian * rows.residual[:, None]).ravel() for rows in groups])
    squares = np.concatenate([rows.jacobian.ravel() ** 2 for rows in groups])
    gradient, information = (np.bincount(columns, terms, layout.size) for terms in (slopes, squares))
    return float(np.linalg.norm(gradient / np.sqrt(information)))
