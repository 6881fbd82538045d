"""Every pose of a log and every landmark as one least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.noise import huber_loss
from pathspace_graph.graph.elimination import Elimination, linear_graph, owners
from pathspace_graph.graph.keys import indices
from pathspace_graph.graph.rows import Rows
from pathspace_graph.labels import RIGHT
from pathspace_graph.mapping.measurements import Chain
from pathspace_graph.settings.mapper import MapperSettings

from .landmark_map import landmark_rows
from .state import LandmarkDetections, LandmarkState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LandmarkSystem:
    """`min 1/2 |odometry|^2 + sum rho(readings of landmarks) + 1/2 |calibration, first pose|^2`.

    The associations are held: a reading of no landmark costs nothing.
    """

    detections: LandmarkDetections
    """Of the whole log."""
    chain: Chain
    """Its odometry."""
    settings: MapperSettings

    def cost(self, state: LandmarkState) -> float:
        """Half the sum of squares at a state, Huber's loss in place of the readings' own."""
        poses, calibration = state.variables.poses, state.variables.calibration
        residual, _ = self.chain.terms(poses, calibration)
        losses = huber_loss(self._detection_rows(state, np.inf).residual, self.settings.gate.huber)
        cost = 0.5 * (residual**2).sum() + losses.sum() + self.chain.prior_cost(poses[0], calibration)
        return float(cost)

    def rows(self, state: LandmarkState) -> list[Rows]:
        """Gauss-Newton's rows at a state, each of a reading's rows weighted as Huber's loss has it."""
        poses, calibration = state.variables.poses, state.variables.calibration
        rows = self.chain.rows(self.chain.terms(poses, calibration), poses[0], calibration)
        return [*rows, self._detection_rows(state, self.settings.gate.huber)]

    def eliminated(self, state: LandmarkState) -> Elimination:
        """The system that they make, with the poses eliminated."""
        return Elimination(linear_graph(self.rows(state), state.variables), state.variables.layout)

    def _detection_rows(self, state: LandmarkState, huber: float) -> Rows:
        """The readings in use, whitened; a factor takes those of some poses on one side of the track."""
        rows = landmark_rows(state, self.detections, np.flatnonzero(self.detections.used), huber)
        labels = state.labels[state.positions(indices(rows.keys[:, 1]))]
        return replace(rows, owner=owners(rows.owner, labels == RIGHT))

    def settle(self, state: LandmarkState) -> None:
        """Move a state to the optimum, the associations held: Levenberg-Marquardt that damps the map."""
        settings, variables, cost = self.settings.batch, state.variables, self.cost(state)
        damping = settings.damping
        for _ in range(settings.max_rounds):
            problem, before = self.eliminated(state), variables.values
            variables.values = before + problem.step(damping * np.diagonal(problem.information))
            gain = cost - self.cost(state)
            if gain < 0.0:
                variables.values, damping = before, settings.damping_up * damping
                if damping > settings.damping_most:
                    break
                continue
            cost, damping = cost - gain, max(settings.damping_down * damping, settings.damping_least)
            if gain <= self.settings.landmark.tolerance * cost:
                break
