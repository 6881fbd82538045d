"""The whole log's least-squares problem: its cost at a state, and its linear factors there."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.noise import huber_loss, huber_weights
from pathspace_graph.factors.projection import ProjectionRows, project
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.elimination import Elimination, linear_graph, map_held, owners
from pathspace_graph.graph.keys import are_poses, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.measurements import Chain
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from .gauge import CurveGauge, curve_gauge

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Kernel:
    """Robust loss of a whitened residual: Huber's, constant beyond a gate."""

    gate: float
    """Beyond it a reading isn't used, and its loss is that at the gate."""
    huber: float
    """Beyond it the loss grows linearly only."""

    def loss(self, whitened: Array) -> Array:
        """`rho(z)` (m,), Huber's alone: the gate is what decides which rows are used."""
        return huber_loss(whitened, self.huber)

    def weights(self, whitened: Array) -> Array:
        """`rho'(z) / z` (m,)."""
        return huber_weights(whitened, self.huber)

    @property
    def ceiling(self) -> float:
        """Loss of a reading that isn't used."""
        return float(self.loss(np.array([self.gate]))[0])


@dataclass(frozen=True)
class Biweight(Kernel):
    """Tukey's `rho(z) = g^2 / 6 (1 - (1 - z^2 / g^2)^3)`, constant beyond the gate g.

    A reading at the gate has no weight, so that one more or less of them moves nothing, as it would with
    Huber's loss and a hard gate.
    """

    huber: float = np.inf
    """Not used."""

    def loss(self, whitened: Array) -> Array:
        """`rho(z)` (m,)."""
        return np.asarray(self.gate**2 / 6.0 * (1.0 - self._inner(whitened) ** 3))

    def weights(self, whitened: Array) -> Array:
        """`(1 - z^2 / g^2)^2` (m,)."""
        return np.asarray(self._inner(whitened) ** 2)

    def _inner(self, whitened: Array) -> Array:
        return np.maximum(1.0 - (whitened / self.gate) ** 2, 0.0)


@dataclass(frozen=True, eq=False)
class Projected:
    """The readings in use on one boundary, at a state."""

    rows: IntArray
    """(m,) readings."""
    foot: FootPoints
    """Their foot points."""
    projection: ProjectionRows
    """Their residuals and derivatives."""
    sigma: Array
    """(m,) held for a round, m."""

    @property
    def whitened(self) -> Array:
        """(m,) residuals in sigmas."""
        return np.asarray(self.projection.residual / self.sigma)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The problem at one state."""

    state: State
    """Where."""
    projected: dict[int, Projected]
    """Of each boundary."""
    odometry: tuple[Array, Array]
    """What `Chain.terms` gives."""
    cost: float
    """Half the sum of squares, robust losses in place of the readings' own."""


class BatchSystem:
    """`min 1/2 |odometry|^2 + sum rho(readings) + 1/2 |spacing, smoothness, calibration, first pose|^2`."""

    def __init__(
        self, detections: DetectionTable, chain: Chain, settings: MapperSettings, kernel: Kernel
    ) -> None:
        self.detections = detections
        self.chain = chain
        self.settings = settings
        self.kernel = kernel
        self.gauges: dict[int, CurveGauge] = {}
        """What holds each curve where readings don't."""
        self._sigma = np.ones(len(detections))

    def begin(self, state: State) -> None:
        """The curves' own gauges, where control points are now: to be called when knots change."""
        sigma = self.settings.batch.sigma_slide
        self.gauges = {label: curve_gauge(state, label, sigma) for label in state.boundaries}

    # --- cost --------------------------------------------------------------------------------------------

    def evaluate(self, state: State, hold: bool = False) -> Evaluation:
        """Everything at a state; foot points are refined from where the readings have them.

        `hold`: from now on each reading's sigma across its curve is what it is here. How it turns is in no
        derivative.
        """
        projected = {label: self._project(state, label, hold) for label in state.boundaries}
        odometry = self.chain.terms(state.poses, state.calibration)
        cost = self._detections_cost(projected) + 0.5 * float((odometry[0] ** 2).sum())
        cost += sum(
            self.gauges[label].cost(state.control_points(label), state.poses) for label in state.boundaries
        )
        cost += self.chain.prior_cost(state.poses[0], state.calibration)
        return Evaluation(state, projected, odometry, cost)

    def _project(self, state: State, label: int, hold: bool) -> Projected:
        detections = self.detections
        rows = detections.used_on(label)
        poses = state.variables.poses_at(detections.cycle[rows])
        points = to_map(detections.point[rows], poses)
        foot = state.boundaries[label].refine(state.control_points(label), points, detections.u[rows])
        sigma_model = self.settings.spline.sigma_model
        projection = project(points, detections.covariance[rows], poses, foot, sigma_model)
        if hold:
            self._sigma[rows] = projection.sigma
        return Projected(rows, foot, projection, self._sigma[rows])

    def _detections_cost(self, projected: dict[int, Projected]) -> float:
        used = sum(int(p.foot.interior.sum()) for p in projected.values())
        losses = sum(float(self.kernel.loss(p.whitened[p.foot.interior]).sum()) for p in projected.values())
        return losses + self.kernel.ceiling * (len(self.detections) - used)

    # --- linear factors ----------------------------------------------------------------------------------

    def rows(self, at: Evaluation) -> list[Rows]:
        """Every whitened row at a state: Gauss-Newton's, readings weighted as their loss has it."""
        state = at.state
        groups = self.chain.rows(at.odometry, state.poses[0], state.calibration)
        for label, gauge in self.gauges.items():
            points = state.control_points(label)
            groups += [self.detection_rows(at, label), gauge.beside(points, state.poses)]
            groups += [gauge.smooth(points), gauge.anchor()]
        return groups

    def detection_rows(self, at: Evaluation, label: int) -> Rows:
        """The readings in use on a boundary, on the control points of their span and their pose."""
        p, state = at.projected[label], at.state
        cycle, scale = self.detections.cycle[p.rows], self.scale(p)
        control = state.keys(label)[state.boundaries[label].columns(p.foot.span)]
        by_control = p.projection.by_control.reshape(len(cycle), 2 * control.shape[1])
        return Rows(
            keys=np.column_stack([control, pose_keys(cycle)]),
            jacobian=np.column_stack([by_control, p.projection.by_pose]) * scale[:, None],
            residual=p.projection.residual * scale,
            owner=owners(cycle, label),
        )

    def scale(self, projected: Projected) -> Array:
        """(m,) what a reading's row is multiplied by, 1/m: zero beside the ends of a curve."""
        weights = self.kernel.weights(projected.whitened)
        return np.asarray(np.sqrt(weights) * projected.foot.interior / projected.sigma)

    def linear_graph(self, at: Evaluation) -> gtsam.GaussianFactorGraph:
        """All of it, whose solution is the change from the state."""
        return linear_graph(self.rows(at), at.state.variables)

    def eliminated(self, at: Evaluation) -> Elimination:
        """The same, with the poses eliminated."""
        return Elimination(self.linear_graph(at), at.state.variables.layout)

    def poses_alone(self, at: Evaluation) -> Array:
        """(3 P,) the step of the poses beside a map and a calibration that are held."""
        keys = at.state.variables.keys
        graph = linear_graph(map_held(self.rows(at)), at.state.variables)
        return Elimination(graph, Layout(keys[are_poses(keys)])).beside(np.zeros(0))


def moved(state: State, step: Array) -> State:
    """The state after a step (n,) of its last variables."""
    following = state.copy()
    following.variables.values[len(following.variables.values) - len(step) :] += step
    return following
