"""Every pose of a log and every landmark as one least-squares problem, and the covariance of all of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.arrowhead import Arrowhead, Reduced
from pathspace_graph.batch_data import Chain
from pathspace_graph.batch_kernel import Kernel
from pathspace_graph.batch_system import BatchSystem, Evaluation, moved
from pathspace_graph.factors.landmark import landmark_residuals, whiteners
from pathspace_graph.factors.projection import huber_weights
from pathspace_graph.settings import MapperSettings
from pathspace_graph.window import POSE, Rows, accumulate

from .landmark_association import PLANE
from .landmark_state import LandmarkReadings, LandmarkState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ReadingRows:
    """The readings in use, whitened and not weighted."""

    slot: IntArray
    """(m,) pose of each."""
    landmark: IntArray
    """(m,) landmark of each."""
    residual: Array
    """(m, 2)."""
    by_pose: Array
    """(m, 2, 3)."""
    by_landmark: Array
    """(m, 2, 2)."""


class LandmarkSystem(BatchSystem):
    """`min 1/2 |odometry|^2 + sum rho(readings of landmarks) + 1/2 |calibration, first pose|^2`.

    Odometry and priors are those of the batch over curves, of which there are none here.
    """

    readings: LandmarkReadings

    def __init__(self, readings: LandmarkReadings, chain: Chain, settings: MapperSettings) -> None:
        # the associations are held: a reading of no landmark costs nothing
        super().__init__(readings, chain, settings, Kernel(gate=0.0, huber=settings.gate.huber))

    def evaluate(self, state: LandmarkState) -> Evaluation:  # type: ignore[override]  # a state of landmarks
        """The cost at a state."""
        at = super().evaluate(state)
        losses = float(self.kernel.loss(self.rows(state).residual).sum())
        return replace(at, cost=at.cost + losses)

    def rows(self, state: LandmarkState) -> ReadingRows:
        """`W (R^T (l - t) - z)` of every reading in use."""
        used = np.flatnonzero(self.readings.used)
        slot, landmark = self.readings.slot[used], self.readings.landmark[used]
        r = landmark_residuals(state.poses[slot], state.landmarks[landmark], self.readings.point[used])
        w = whiteners(self.readings.covariance[used])
        whitened = np.einsum("mij,mj->mi", w, r.residual)
        return ReadingRows(slot, landmark, whitened, w @ r.by_pose, w @ r.by_landmark)

    def normal_equations(self, at: Evaluation) -> Arrowhead:
        """The Gauss-Newton system, each of a reading's rows weighted as Huber's loss has it."""
        assert isinstance(at.state, LandmarkState)
        system, rows = super().normal_equations(at), self.rows(at.state)
        count, n = len(self.chain), len(system.border)
        root = np.sqrt(huber_weights(rows.residual, self.kernel.huber))
        residual, by_pose = rows.residual * root, rows.by_pose * root[:, :, None]
        by_landmark = rows.by_landmark * root[:, :, None]
        gram, descent = np.swapaxes(by_pose, 1, 2) @ by_pose, np.einsum("mij,mi->mj", by_pose, residual)
        for i in range(POSE):
            for j in range(POSE):
                system.diagonal[:, i, j] += np.bincount(rows.slot, gram[:, i, j], count)
            system.descent_poses[i::POSE] -= np.bincount(rows.slot, descent[:, i], count)
        columns = PLANE * rows.landmark[:, None] + np.arange(PLANE)
        cross = np.swapaxes(by_pose, 1, 2) @ by_landmark
        at_pose = POSE * rows.slot[:, None] + np.arange(POSE)
        np.add.at(system.coupling, (at_pose[:, :, None], columns[:, None, :]), cross)
        flat = Rows(np.repeat(columns, PLANE, axis=0), by_landmark.reshape(-1, PLANE), residual.ravel())
        hessian, descent_border = accumulate([flat], n)
        system.border[:] += hessian
        system.descent_border[:] += descent_border
        return system

    def settle(self, state: LandmarkState) -> LandmarkState:
        """The optimum with the associations held, by Levenberg-Marquardt with the map damped."""
        settings, at = self.settings.batch, self.evaluate(state)
        damping = settings.damping
        for _ in range(settings.max_rounds):
            reduced = self.normal_equations(at).reduced()
            trial = self._trial(at, reduced, damping)
            if trial.cost > at.cost:
                damping *= settings.damping_up
                if damping > settings.damping_most:
                    break
                continue
            gain, at = at.cost - trial.cost, trial
            damping = max(settings.damping_down * damping, settings.damping_least)
            if gain <= self.settings.landmark.tolerance * at.cost:
                break
        assert isinstance(at.state, LandmarkState)
        return at.state

    def _trial(self, at: Evaluation, reduced: Reduced, damping: float) -> Evaluation:
        step = reduced.step(damping * np.diag(np.diagonal(reduced.border)))
        following = moved(at.state, *step)
        assert isinstance(following, LandmarkState)
        return self.evaluate(following)

    def covariance(self, state: LandmarkState) -> JointCovariance:
        """Of all poses and landmarks at a state."""
        reduced = self.normal_equations(self.evaluate(state)).reduced()
        return JointCovariance.of(reduced, len(state.labels))


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Blocks of the covariance of poses and landmarks together."""

    poses: Array
    """(P, 3, 3) of each pose."""
    landmarks: Array
    """(n, 2, n, 2) of all landmarks."""
    cross: Array
    """(P, 3, n, 2) between poses and landmarks."""

    @staticmethod
    def of(reduced: Reduced, count: int) -> JointCovariance:
        """From a reduced system of `count` landmarks."""
        border, size = reduced.border_covariance(), PLANE * count
        gain, _ = lapack.dtbtrs(reduced.chain, reduced.half[:, :-1], uplo="L", trans="T")
        cross = -(gain @ border[:, :size])
        landmarks = border[:size, :size].reshape(count, PLANE, count, PLANE)
        poses = reduced.pose_marginals()
        return JointCovariance(poses, landmarks, cross.reshape(len(poses), POSE, count, PLANE))

    def predicted(self, slot: IntArray, landmark: IntArray, by_pose: Array, by_landmark: Array) -> Array:
        """`H Sigma H'` (m, 2, 2) of what poses (m,) see of landmarks (m,), cross terms included."""
        turned = np.swapaxes(by_landmark, 1, 2)
        mixed = by_pose @ self.cross[slot, :, landmark] @ turned
        own = by_landmark @ self.landmarks[landmark, :, landmark] @ turned
        return np.asarray(
            by_pose @ self.poses[slot] @ np.swapaxes(by_pose, 1, 2) + mixed + np.swapaxes(mixed, 1, 2) + own
        )
