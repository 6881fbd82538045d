"""Levenberg-Marquardt on the whole log, and the rounds about it that refresh what it holds fixed."""

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

CURVE_SAMPLES = 2
"""Points in each knot interval at which the movement of a curve is looked at."""


@dataclass(frozen=True)
class Movement:
    """How far a state has moved."""

    curve: float
    """Largest movement of a curve across itself, m."""
    pose: float
    """Largest movement of a pose: the larger of m and rad."""


@dataclass(frozen=True, eq=False)
class Convergence:
    """How an optimization ended."""

    converged: bool
    """Whether nothing changed any more."""
    reason: str
    """Why it stopped."""
    rounds: int
    """Times that foot points, gates and weights were refreshed."""
    steps: int
    """Levenberg-Marquardt steps, rejected ones included."""
    cost: float
    """Half the sum of squares with robust losses, at the end."""
    gradient: float
    """Norm of the gradient there, each entry in units of its own sigma."""


@dataclass(frozen=True)
class Schedule:
    """How far an optimization goes."""

    gate: float
    """First gate, sigmas."""
    rounds: int
    """Most rounds."""
    tolerance: float = 1.0
    """Multiplies every tolerance of the settings."""


class Optimizer:
    """Takes a state down to the optimum."""

    def __init__(self, system: BatchSystem, settings: BatchSettings) -> None:
        self.system = system
        self.settings = settings
        self.steps = 0
        """Steps tried so far."""
        self._damping = settings.damping
        self._change: Array | None = None
        """What the step before moved the map by."""

    def run(
        self, state: State, schedule: Schedule, on_round: Callable[[], None] | None = None
    ) -> tuple[Evaluation, Convergence]:
        """Rounds until nothing changes, the gate graduated from the schedule's to the settings' own."""
        system, gate = self.system, schedule.gate
        system.begin(state)
        locate_poses(state)
        self._change = None
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
            still = self._still(_movement(before, state), abs(cost_before - cost), cost, schedule.tolerance)
            if strict and still:
                return at, self._report(at, number, "nothing changes any more", True)
            gate *= self.settings.gate_factor
        assert at is not None
        return at, self._report(at, schedule.rounds, "no round left", False)

    def _refreshed(self, state: State, gate: float, strict: bool) -> Evaluation:
        """The problem with the stations, the readings in use and their sigmas of a new round."""
        system = self.system
        if not strict:
            locate_poses(state)
        associate(state, system.detections, system.settings, gate, strict)
        return system.evaluate(state, hold=True)

    def hold_map(self, state: State, steps: int, gate: float) -> State:
        """Poses alone, the map and the calibration held."""
        self.system.begin(state)
        for _ in range(steps):
            state = moved(state, self.system.poses_alone(self._refreshed(state, gate, False)))
        return state

    def _still(self, movement: Movement, gain: float, cost: float, tolerance: float) -> bool:
        settings = self.settings
        curve, pose = tolerance * settings.tolerance_curve, tolerance * settings.tolerance_pose
        still = movement.curve <= curve and movement.pose <= pose
        return still and gain <= tolerance * settings.tolerance_cost * cost

    def _step(self, at: Evaluation) -> Evaluation:
        """The next state that is better, damped as much as it takes; the same where none is enough."""
        settings = self.settings
        self._accept(at)
        problem = self.system.eliminated(at)
        unit = damped(problem.map)
        while self._damping <= settings.damping_most:
            self.steps += 1
            trial = self._trial(at, problem, self._damping * unit)
            if trial is not None:
                self._damping = max(settings.damping_down * self._damping, settings.damping_least)
                self._accept(trial)
                return trial
            self._damping *= settings.damping_up
        self._damping = settings.damping
        return at

    def _trial(self, at: Evaluation, problem: Elimination, damping: Array) -> Evaluation | None:
        """The state after a step, if it is better."""
        try:
            step = problem.step(damping)
        except SingularSystemError:
            return None
        trial = self.system.evaluate(moved(at.state, step))
        if trial.cost > at.cost:
            return None
        before, self._change = self._change, step[: problem.map.size]
        length = 1.0 if before is None else whole_way(self._change, before, self.settings)
        if length > 1.0:
            farther = self.system.evaluate(moved(at.state, length * step))
            trial = min(trial, farther, key=lambda evaluation: evaluation.cost)
        return trial

    def _accept(self, at: Evaluation) -> None:
        """Foot points are refined from where they are now."""
        for projected in at.projected.values():
            self.system.detections.refine(projected.rows, projected.foot.u)

    def _report(self, at: Evaluation, rounds: int, reason: str, converged: bool) -> Convergence:
        gradient = gradient_norm(self.system.rows(at), at.state.variables.layout)
        return Convergence(converged, reason, rounds, self.steps, at.cost, gradient)


def whole_way(step: Array, before: Array, settings: BatchSettings) -> float:
    """How many times so long a step (n,) is to go where each is a share r of the one before: 1 / (1 - r).

    Aitken's process for vectors, r by least squares; 1 where r isn't between the settings' bounds. Robust
    weights, held sigmas and foot points on a curve that bends leave Gauss-Newton converging linearly, slowest
    where few readings hold the curve.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if settings.share_least < share < settings.share_most else 1.0


def damped(layout: Layout) -> Array:
    """(n,) a unit of damping: ones of the control points, zeros of the calibration."""
    unit = np.ones(layout.size)
    unit[layout.block(CALIBRATION_LETTER)] = 0.0
    return unit


def gradient_norm(groups: Sequence[Rows], layout: Layout) -> float:
    """Norm of `J' r`, each entry in units of its own sigma: divided by the root of that of `diag(J' J)`."""
    groups = [rows for rows in groups if len(rows)]
    columns = np.concatenate([rows.columns(layout).ravel() for rows in groups])
    slopes = np.concatenate([(rows.jacobian * rows.residual[:, None]).ravel() for rows in groups])
    squares = np.concatenate([rows.jacobian.ravel() ** 2 for rows in groups])
    gradient, information = (np.bincount(columns, terms, layout.size) for terms in (slopes, squares))
    return float(np.linalg.norm(gradient / np.sqrt(information)))


def _movement(before: State, after: State) -> Movement:
    """Of curves on the same knots: along itself a curve doesn't move."""
    curve = 0.0
    for label, boundary in after.boundaries.items():
        count = max(int(CURVE_SAMPLES * boundary.size), 2)
        u = np.linspace(boundary.tables.low, boundary.tables.high, count)
        tangent = boundary.evaluate(after.control_points(label), u, 1)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        normal /= np.maximum(np.hypot(*normal.T), np.finfo(float).tiny)[:, None]
        points = (boundary.evaluate(s.control_points(label), u) for s in (before, after))
        offset = next(points) - next(points)
        curve = max(curve, float(np.abs((offset * normal).sum(axis=1)).max()))
    pose = float(np.abs(after.poses - before.poses).max()) if len(after.poses) else 0.0
    return Movement(curve, pose)
