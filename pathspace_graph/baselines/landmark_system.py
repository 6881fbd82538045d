"""The least-squares problem of landmarks over a whole drive, with known associations.

With oracle associations it is the limit of accuracy of a log. There are no outliers then, and no robust
weights.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.batch.association import insert_drive
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import KnownNoise, huber_loss
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.front_end.front_end import is_orange, judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry, half_square
from pathspace_graph.graph.elimination import Damping, Elimination, linear_graph, marginal_before, owners
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import indices
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import BOUNDARIES, RIGHT
from pathspace_graph.settings.mapper import MapperSettings

from .landmark_map import LandmarkDetections, LandmarkState, landmark_rows

MAX_STEPS: Final = 80  # largest number of steps
GAIN_TOLERANCE: Final = 1e-6  # largest relative gain of the last step


@dataclass(frozen=True, eq=False)
class LandmarkSystem:
    """Minimizes `1/2 |odometry|^2 + sum rho(associated detections) + 1/2 |calibration, first pose|^2`."""

    detections: LandmarkDetections
    chain: LogOdometry
    settings: MapperSettings
    noise: RunNoise

    @classmethod
    def of_log(cls, log: Log, settings: MapperSettings, noise: KnownNoise) -> "LandmarkSystem":
        """Set up the problem of a log without associations; `noise` is known before the drive."""
        judged = judge_log(log, noise, settings)
        detections = LandmarkDetections.of(judged.cycles, twists=judged.chain.twists)
        return cls(detections, judged.chain, judged.settings, judged.noise)

    def cost(self, state: LandmarkState) -> float:
        """Half the sum of squares at a state, with Huber's loss of the detections."""
        *drive, detections = self.rows(state, np.inf)
        return half_square(drive) + float(huber_loss(detections.residual, self.settings.gate.huber).sum())

    def rows(self, state: LandmarkState, huber: float) -> list[Rows]:
        """All rows, those of the detections last, weighted by a Huber threshold (sigmas)."""
        rows = landmark_rows(state, self.detections, np.flatnonzero(self.detections.used), huber)
        labels = state.labels[state.positions(indices(rows.keys[:, -1]))]
        seen = replace(rows, owner=owners(rows.owner, labels == RIGHT))
        return [*self.chain.rows_at(state.variables, self.settings.calibration), seen]

    def eliminated(self, state: LandmarkState) -> Elimination:
        graph = linear_graph(self.rows(state, self.settings.gate.huber), state.variables)
        return Elimination(graph, state.variables.layout)

    def optimize(self, state: LandmarkState) -> None:
        """Optimize a state by Levenberg-Marquardt with fixed associations; only the map is damped."""
        variables, cost, damping = state.variables, self.cost(state), Damping()
        for _ in range(MAX_STEPS):
            problem, before = self.eliminated(state), variables.values
            variables.values = before + problem.step(damping.weight * np.diagonal(problem.information))
            gain = cost - self.cost(state)
            if gain < 0.0:
                variables.values = before
                damping.grow()
            else:
                cost -= gain
                damping.lower()
            if damping.exhausted or 0.0 <= gain <= GAIN_TOLERANCE * cost:
                break
        self.detections.correct(variables.sensor)

    def marginal(self, state: LandmarkState, first: int) -> tuple[IntArray, Array, Array]:
        """Return the Gaussian of poses before a cycle on calibrations, landmarks and its pose.

        It is given by keys, mean (n,) and information (n, n).
        """
        rows = self.rows(state, self.settings.gate.huber)
        layout, information, vector = marginal_before(rows, state.variables, first)
        here = state.variables.values[state.variables.layout.entries(layout.keys)]
        return layout.keys, here + np.linalg.solve(information, vector), information


def solve_landmarks(
    log: Log, associations: IntArray, settings: MapperSettings | None = None
) -> tuple[LandmarkSystem, LandmarkState]:
    """Minimize all squared Mahalanobis distances over poses, calibration and landmarks, without robust loss.

    associations (R,) are the landmark numbers of all detections in file order. Negative ones and orange cones
    are left out.
    """
    associations = associations[~np.concatenate([is_orange(cycle) for cycle in log.cycles])]
    settings = settings or MapperSettings()
    settings = replace(settings, gate=replace(settings.gate, huber=np.inf))
    drift = np.zeros(3) if log.odometry_drift is None else log.odometry_drift
    system = LandmarkSystem.of_log(log, settings, KnownNoise(log.odometry_sigma, drift=drift))
    state = start_oracle(system, associations)
    system.optimize(state)
    return system, state


def start_oracle(system: LandmarkSystem, associations: IntArray) -> LandmarkState:
    """Associate the system's detections with landmarks (R,); return the state by dead reckoning."""
    detections, rows = system.detections, np.flatnonzero(associations >= 0)
    numbers, first, landmark = np.unique(associations[rows], return_index=True, return_inverse=True)
    detections.take(rows, numbers[landmark])
    calibration = np.array(system.settings.calibrations)
    poses = system.chain.dead_reckoned(calibration[:CALIBRATION_SIZE])
    points = to_map(detections.point[rows[first]], poses[detections.cycle[rows[first]]])
    votes = np.zeros((len(numbers), 3), np.intp)  # left, right, unknown
    np.add.at(votes, (landmark, detections.label[rows]), 1)
    state = LandmarkState()
    state.add(points, votes.argmax(axis=1), numbers.astype(np.intp))
    state.votes = votes[:, : len(BOUNDARIES)]
    insert_drive(state.variables, calibration, poses)
    return state
