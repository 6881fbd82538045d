"""A drive with linear measurements only, so that a window and a batch have the same estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import IntegratedOdometry
from pathspace_graph.graph.inactive import InactiveMap
from pathspace_graph.graph.rows import OdometryChain, Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POSE,
    Variables,
    control_keys,
    pose_key,
    pose_keys,
)
from pathspace_graph.graph.window import SmootherSettings

from .graph import columns_of, dense_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POINTS = 12
"""This is the number of map points; pose k sees some of those near point k."""
SIGMA_START = np.array([0.5, 0.4, 0.3])
NOTHING = np.zeros(0, np.intp)


class LinearTrack:
    """Holds map points in a row, measurements `J x - z` of each cycle, and weak priors of its new points."""

    def __init__(self, seed: int) -> None:
        self.variables = Variables()
        self.reached_inactive = False
        self.inactive: IntArray = NOTHING
        self.seed = seed

    def changed(self) -> IntArray:
        return NOTHING

    def measured(self, cycle: int) -> tuple[IntArray, Array, Array]:
        """Returns the keys (m, 3) of the rows of a cycle, J (m, 7) and z (m,)."""
        rng = np.random.default_rng((self.seed, cycle))
        first = np.minimum(cycle + rng.integers(0, 2, 6), POINTS - 2)
        keys = [np.full(6, pose_key(cycle)), control_keys(0, first), control_keys(0, first + 1)]
        return np.stack(keys, axis=1), rng.normal(size=(6, POSE + 4)) * 2.0, rng.normal(size=6) * 5.0

    def rows(self, cycles: IntArray) -> list[Rows]:
        return [
            self._at_values(*one, k) for k in cycles.tolist() for one in (self.measured(k), *self.placed(k))
        ]

    def _at_values(self, keys: IntArray, J: Array, z: Array, owner: int) -> Rows:
        values = np.array([self.variables.of(one) for one in keys])
        return Rows(keys, J, (J * values).sum(axis=1) - z, np.full(len(keys), owner, np.intp))

    def correct(self) -> None:
        """Does nothing: these measurements have no sensor."""

    def linearized(self, cycles: IntArray) -> None:
        pass

    def placed(self, cycle: int) -> list[tuple[IntArray, Array, Array]]:
        """Returns keys, J and z of the weak priors of the points that a cycle is the first to see.

        They are `(c_j - (4, 5)) / 9`, and `(c_j - c_{j-1} - (1, 2)) / 3` of neighbours.
        """
        first, last = (0, 2) if cycle == 0 else (cycle + 2, min(cycle + 2, POINTS - 1))
        between, rows = np.kron(np.array([-1.0, 1.0]), np.eye(2)) / 3.0, []
        for j in range(first, last + 1):
            own, before = control_keys(0, np.array([[j]])), control_keys(0, np.array([[j - 1, j]]))
            rows.append((np.repeat(own, 2, axis=0), np.eye(2) / 9.0, np.array([4.0, 5.0]) / 9.0))
            if j:
                rows.append((np.repeat(before, 2, axis=0), between, np.array([1.0, 2.0]) / 3.0))
        return rows

    def activate_all(self) -> None:
        self.inactive = NOTHING

    def drop_cycle(self, cycle: int) -> None:
        pass


class LinearOdometry(OdometryChain):
    """Odometry with the linear residual `W_k (x_{k+1} - x_k - delta_k + G_k b)`."""

    def rows(self, variables: Variables, cycles: IntArray) -> list[Rows]:
        slots = cycles - variables.first_cycle
        return [self._row(variables, int(slot)) for slot in slots[slots < len(self)]]

    def _row(self, variables: Variables, slot: int) -> Rows:
        cycle, G, W = variables.first_cycle + slot, self.by_calibration[slot], self.whiteners[slot]
        key = np.array([CALIBRATION_KEY, pose_key(cycle), pose_key(cycle + 1)])
        J = W @ np.concatenate([G, -np.eye(POSE), np.eye(POSE)], axis=1)
        residual = J @ variables.of(key) - W @ self.deltas[slot]
        return Rows(np.tile(key, (POSE, 1)), J, residual, np.full(POSE, cycle, np.intp))


@dataclass(eq=False)
class LinearDrive:
    """Holds a window on a drive, and all measurements of the drive."""

    lag: int
    """The window has one pose more than this."""
    seed: int = 0
    tolerance: float = 1e-9
    """Factors are linearized again after a change larger than this."""
    means: tuple[float, float] = (0.0, 0.0)
    """Prior means of the calibration."""
    sigmas: tuple[float, float] = (0.3, 0.5)
    """Prior standard deviations of the calibration."""
    odometry: list[IntegratedOdometry] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = SmootherSettings(
            lag=float(self.lag),
            tolerances=(self.tolerance, self.tolerance),
            sigmas_calibrations=self.sigmas,
            calibrations=self.means,
        )
        self.track = LinearTrack(self.seed)
        self.smoother = FixedLagSmoother(settings, self.track)
        self.smoother.inactive = InactiveMap()  # these rows change under a rigid motion of all variables
        self.smoother.window.odometry = LinearOdometry()
        self.rng = np.random.default_rng(self.seed + 100)
        self.start = self.rng.normal(size=POSE)

    @property
    def cycles(self) -> int:
        return self.smoother.next_cycle

    def drive(self, cycles: int) -> None:
        """Drives some cycles: a pose, the points that it is the first to see, a step, marginalization."""
        for _ in range(cycles):
            self.predict()
            self.smoother.step()
            self.smoother.marginalize()

    def predict(self) -> None:
        k, smoother = self.cycles, self.smoother
        if k == 0:
            smoother.add_first_pose(0.0, self.start.copy(), np.diag(SIGMA_START**2))
            self.see(np.arange(3))
            return
        W = np.triu(self.rng.normal(size=(POSE, POSE))) + 3.0 * np.eye(POSE)
        covariance = np.linalg.inv(W.T @ W)
        G = self.rng.normal(size=(POSE, 2))
        step = IntegratedOdometry(self.rng.normal(size=POSE), covariance, G, W)
        self.odometry.append(step)
        smoother.add_pose(float(k), smoother.variables.poses[-1] + self.rng.normal(size=POSE), step)
        if k + 2 < POINTS:
            self.see(np.array([k + 2]))

    def see(self, numbers: IntArray) -> None:
        """Inserts new map points at random places."""
        points = self.rng.normal(size=(len(numbers), 2)) * 7.0
        self.smoother.variables.insert(control_keys(0, numbers), points.ravel())

    def deactivate(self, before: int) -> None:
        """Deactivates map points below a number, which no pose of the window may see."""
        keys = np.setdiff1d(control_keys(0, np.arange(before)), self.track.inactive)
        self.smoother.deactivate(keys)
        self.track.inactive = np.union1d(self.track.inactive, keys)

    # --- the batch ---------------------------------------------------------------------------------------

    @property
    def keys(self) -> IntArray:
        """Returns the keys of the calibration, all points seen so far, and all poses of the drive."""
        points = control_keys(0, np.arange(min(self.cycles + 2, POINTS)))
        return np.concatenate([[CALIBRATION_KEY], points, pose_keys(np.arange(self.cycles))])

    def batch(self) -> tuple[Array, Array]:
        """Returns `J'J` and `J'z` of all measurements, on the columns of all keys."""
        keys = self.keys
        sigmas = np.array(self.sigmas)
        matrices = [_scattered([CALIBRATION_KEY], np.diag(1.0 / sigmas), keys)]
        right = [self.means / sigmas]
        matrices.append(_scattered([pose_key(0)], np.diag(1.0 / SIGMA_START), keys))
        right.append(self.start / SIGMA_START)
        for k in range(self.cycles):
            for own, J, z in (self.track.measured(k), *self.track.placed(k)):
                matrices.append(dense_rows([Rows(own, J, z, np.zeros(len(z), np.intp))], keys)[0])
                right.append(z)
        for k, step in enumerate(self.odometry):
            J = step.whitener @ np.concatenate(
                [step.calibration_jacobian, -np.eye(POSE), np.eye(POSE)], axis=1
            )
            matrices.append(_scattered([CALIBRATION_KEY, pose_key(k), pose_key(k + 1)], J, keys))
            right.append(step.whitener @ step.delta)
        J, z = np.concatenate(matrices), np.concatenate(right)
        return J.T @ J, J.T @ z

    def mean(self, keys: IntArray) -> Array:
        """Returns the batch estimate of some keys."""
        return np.linalg.solve(*self.batch())[columns_of(keys, self.keys)]

    def covariance(self, keys: IntArray) -> Array:
        """Returns the joint covariance of some keys in the batch."""
        entries = columns_of(keys, self.keys)
        return np.linalg.inv(self.batch()[0])[np.ix_(entries, entries)]


def _scattered(keys: Sequence[int], J: Array, among: IntArray) -> Array:
    matrix = np.zeros((len(J), len(columns_of(among, among))))
    matrix[:, columns_of(np.array(keys), among)] = J
    return matrix
