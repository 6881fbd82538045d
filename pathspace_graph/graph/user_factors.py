"""A user's own GTSAM factors on poses, control points and the calibration: GNSS, IMU, a surveyed point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import rotation

from .gaussian import graph_of, jacobian_factor, normal_equations, square_root_form
from .keys import POINT, POSE, are_poses, name, sizes
from .variables import Layout, Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Held:
    """A factor, and the keys that it is a function of."""

    factor: gtsam.NonlinearFactor
    keys: IntArray

    @property
    def on_poses(self) -> bool:
        return bool(are_poses(self.keys).any())

    def touches(self, keys: IntArray) -> bool:
        return bool(np.isin(self.keys, keys).any())


class UserFactors:
    """The user's factors, each nonlinear until one of its poses leaves, or its map points are replaced."""

    def __init__(self) -> None:
        self._held: list[_Held] = []
        self._aside: list[_Held] = []

    def add(
        self, factors: Sequence[gtsam.NonlinearFactor], known: Callable[[int], bool], expected: str
    ) -> bool:
        """Hold factors; SettingsError, and none held, where any has a key that is not known.

        Says whether any holds a pose.
        """
        held = [_Held(factor, np.array(list(factor.keys()), np.intp)) for factor in factors]
        for one in held:
            for key in one.keys.tolist():
                if not known(key):
                    raise SettingsError(f"factor on {name(key)}: expected keys of {expected}")
        self._held += held
        return any(one.on_poses for one in held)

    @property
    def keys(self) -> IntArray:
        """(k,) keys of all that are held, some twice."""
        return np.concatenate([np.zeros(0, np.intp), *(held.keys for held in self._held)])

    @property
    def factors(self) -> list[gtsam.NonlinearFactor]:
        """All that are held."""
        return [held.factor for held in self._held]

    def linearized(self, variables: Variables, whole: bool = False) -> list[gtsam.GaussianFactor]:
        """Every factor at the variables' values, those that were set aside too where `whole`."""
        return _linear(self._held + self._aside if whole else self._held, variables)

    def leave(self, keys: IntArray, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Variables (k,) leave, and with them every factor that holds one: these, linearized, as they go."""
        gone, self._held = self._parted(lambda held: held.touches(keys))
        return _linear(gone, variables)

    def set_aside(self, keys: IntArray, variables: Variables) -> list[gtsam.GaussianFactor]:
        """The factors that hold an inactive map point of (k,), and no pose, linearized until it returns."""
        aside, self._held = self._parted(lambda held: held.touches(keys) and not held.on_poses)
        self._aside += aside
        return _linear(aside, variables)

    def take_back(self) -> None:
        """Every map point is active again: what was set aside is held as before."""
        self._held, self._aside = self._held + self._aside, []

    def _parted(self, which: Callable[[_Held], bool]) -> tuple[list[_Held], list[_Held]]:
        """Those held that `which` is true of, and the others."""
        return [held for held in self._held if which(held)], [held for held in self._held if not which(held)]


def _linear(held: Sequence[_Held], variables: Variables) -> list[gtsam.GaussianFactor]:
    """Linear factors; one that GTSAM says is not active gives none."""
    return [linear for linear in (_linearized(one, variables) for one in held) if linear is not None]


def _linearized(held: _Held, variables: Variables) -> gtsam.GaussianFactor | None:
    """`1/2 |A d - b|^2`, d = value - reference.

    The tangent of `gtsam.Pose2` is in the frame of the pose, our unknowns are in the map frame: with R the
    pose's rotation, `A_xy` becomes `A_xy R'`.
    """
    linear = held.factor.linearize(variables.gtsam_values(held.keys))
    if linear is None:
        return None
    keys = np.array(list(linear.keys()), np.intp)
    matrix, right = linear.jacobian()
    A, b = np.array(matrix, float), np.array(right, float).ravel()
    A = A @ _turn(keys, variables).T
    return jacobian_factor(keys, A, b + A @ variables.change(variables.layout.entries(keys)))


def as_nonlinear(factor: gtsam.GaussianFactor, variables: Variables) -> gtsam.LinearContainerFactor:
    """A linear factor on our unknowns as one of a nonlinear graph, linearized at the variables' values.

    The inverse of what is done to a user's factor: `A_xy R` on each pose, and `b - A d_now`.
    """
    layout = Layout(np.sort(np.array(list(factor.keys()), np.intp)))
    information, vector = normal_equations(graph_of(factor), layout)
    turn = _turn(layout.keys, variables)
    negative_gradient = vector - information @ variables.change(variables.layout.entries(layout.keys))
    root, right = square_root_form(turn.T @ information @ turn, turn.T @ negative_gradient)
    linear = jacobian_factor(layout.keys, root, right)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(linear), variables.gtsam_values(layout.keys))


def _turn(keys: IntArray, variables: Variables) -> Array:
    """(n, n) block-diagonal over keys (k,): R(theta), vehicle to map frame, of each pose; else the
    identity."""
    starts = np.cumsum(sizes(keys)) - sizes(keys)
    turn = np.eye(int(sizes(keys).sum()))
    for i in np.flatnonzero(are_poses(keys)):
        xy = slice(int(starts[i]), int(starts[i]) + POINT)
        turn[xy, xy] = rotation(float(variables.of(keys[i : i + 1])[POSE - 1]))
    return turn
