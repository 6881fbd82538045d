"""Every pose of a log and every landmark as one least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.factors.noise import huber_loss
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry, sensor_prior, sensor_prior_cost
from pathspace_graph.graph.elimination import Elimination, linear_graph, owners
from pathspace_graph.graph.keys import indices, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import RIGHT
from pathspace_graph.settings.mapper import MapperSettings

from .landmark_map import landmark_rows
from .state import LandmarkDetections, LandmarkState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LandmarkSystem:
    """Minimizes `1/2 |odometry|^2 + sum rho(associated detections) + 1/2 |calibration, first pose|^2`.

    The associations are constant, and a detection without a landmark costs nothing.
    """

    detections: LandmarkDetections
    """These are the detections of the whole log."""
    chain: LogOdometry
    """This is the odometry of the whole log."""
    settings: MapperSettings
    noise: RunNoise
    """This noise is used."""

    @classmethod
    def of_log(cls, log: Log, settings: MapperSettings, noise: KnownNoise) -> LandmarkSystem:
        """Returns the problem of a log without any association; `noise` is what is known before."""
        judged = judge_log(log, noise, settings)
        twists = judged.chain.twists
        return cls(
            LandmarkDetections.of(judged.cycles, twists=twists), judged.chain, judged.settings, judged.noise
        )

    def believing(self, settings: MapperSettings) -> LandmarkSystem:
        """Returns the same problem with the priors of the calibrations that other settings have."""
        sigma = np.array(settings.odometry.sigmas_calibration)
        return replace(self, settings=settings, chain=replace(self.chain, calibration_sigma=sigma))

    def cost(self, state: LandmarkState) -> float:
        """Returns half the sum of squares at a state, with Huber's loss of the detections."""
        poses, calibration = state.variables.poses, state.variables.calibration
        residual, _ = self.chain.terms(poses, calibration)
        losses = huber_loss(self._detection_rows(state, np.inf).residual, self.settings.gate.huber)
        cost = 0.5 * (residual**2).sum() + losses.sum() + self.chain.prior_cost(poses[0], calibration)
        return float(cost) + sensor_prior_cost(state.variables, self.settings.calibration)

    def rows(self, state: LandmarkState) -> list[Rows]:
        """Returns the Gauss-Newton rows at a state, where each row of a detection has its Huber weight."""
        poses, calibration = state.variables.poses, state.variables.calibration
        rows = self.chain.rows(self.chain.terms(poses, calibration), poses[0], calibration)
        rows += sensor_prior(state.variables, self.settings.calibration)
        return [*rows, self._detection_rows(state, self.settings.gate.huber)]

    def eliminated(self, state: LandmarkState) -> Elimination:
        """Returns the linear problem at a state, with the poses eliminated."""
        return Elimination(linear_graph(self.rows(state), state.variables), state.variables.layout)

    def _detection_rows(self, state: LandmarkState, huber: float) -> Rows:
        """Returns the whitened rows; a factor owns those of a few poses on one side of the track."""
        rows = landmark_rows(state, self.detections, np.flatnonzero(self.detections.used), huber)
        labels = state.labels[state.positions(indices(rows.keys[:, -1]))]
        return replace(rows, owner=owners(rows.owner, labels == RIGHT))

    def optimize(self, state: LandmarkState) -> None:
        """Moves a state to the optimum by Levenberg-Marquardt; the associations stay, the map is damped."""
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
        self.detections.correct(variables.sensor)


def insert_drive(state: LandmarkState, calibration: Array, poses: Array) -> None:
    """Makes the calibration, (2,) or (7,), and the poses (P, 3) of the whole log variables of a state."""
    state.variables.insert_calibrations(calibration)
    state.variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
