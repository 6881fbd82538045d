"""A user's own GTSAM factors on poses, control points and the calibration, such as GNSS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError

from .gaussian import graph_of, jacobian_factor, normal_equations, square_root_form
from .keys import POSE, are_poses, name, sizes
from .variables import Layout, Variables, rotation_blocks

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _UserFactor:
    """Holds a factor and its keys."""

    factor: gtsam.NonlinearFactor
    """This is the factor as the user gave it."""
    keys: IntArray
    """These are its keys (k,)."""

    @property
    def holds_pose(self) -> bool:
        """Returns whether the factor is a function of a pose."""
        return bool(are_poses(self.keys).any())

    def holds_any(self, keys: IntArray) -> bool:
        """Returns whether the factor is a function of any of these variables."""
        return bool(np.isin(self.keys, keys).any())


class UserFactors:
    """Holds the user's factors, which stay nonlinear until one of their variables is eliminated."""

    def __init__(self) -> None:
        self._active: list[_UserFactor] = []
        self._inactive: list[_UserFactor] = []
        self.given = False
        """The flag is set once the user has given any factor, which may be absolute."""

    def add(self, factors: Sequence[gtsam.NonlinearFactor]) -> bool:
        """Adds factors that `check_factors` lets pass, and returns whether any of them holds a pose."""
        new = [_UserFactor(factor, np.array(list(factor.keys()), np.intp)) for factor in factors]
        self._active += new
        self.given |= len(new) > 0
        return any(one.holds_pose for one in new)

    @property
    def keys(self) -> IntArray:
        """Returns the keys (k,) of all active factors; a key may occur several times."""
        return np.concatenate([np.zeros(0, np.intp), *(one.keys for one in self._active)])

    @property
    def count(self) -> int:
        """Returns the number of all factors, active or not."""
        return len(self._active) + len(self._inactive)

    @property
    def factors(self) -> list[gtsam.NonlinearFactor]:
        """Returns all active factors."""
        return [one.factor for one in self._active]

    def linearized(self, variables: Variables, whole: bool = False) -> list[gtsam.GaussianFactor]:
        """Returns the active factors, and the inactive ones too if `whole`, linearized at the values."""
        return _linear(self._active + self._inactive if whole else self._active, variables)

    def remove(self, keys: IntArray, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Removes every factor that holds one of these variables (k,), and returns them linearized."""
        removed, self._active = self._split(lambda one: one.holds_any(keys))
        return _linear(removed, variables)

    def deactivate(self, keys: IntArray, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Deactivates factors on one of the map points (k,) and on no pose, and returns them linearized."""
        inactive, self._active = self._split(lambda one: one.holds_any(keys) and not one.holds_pose)
        self._inactive += inactive
        return _linear(inactive, variables)

    def reactivate(self) -> None:
        """Makes all inactive factors active again."""
        self._active, self._inactive = self._active + self._inactive, []

    def _split(self, condition: Callable[[_UserFactor], bool]) -> tuple[list[_UserFactor], list[_UserFactor]]:
        """Returns the active factors that meet a condition, and the others."""
        meets = [condition(one) for one in self._active]
        chosen = [one for one, met in zip(self._active, meets, strict=True) if met]
        return chosen, [one for one, met in zip(self._active, meets, strict=True) if not met]


def check_factors(
    factors: Sequence[gtsam.NonlinearFactor],
    known: Callable[[int], bool],
    expected: str,
    values: Callable[[IntArray], gtsam.Values],
) -> None:
    """Raises a SettingsError for the first factor that is not one, or whose keys or numbers cannot be used.

    Each key must be known; `expected` is part of the message. Each factor is linearized at the values of its
    keys, and must give finite numbers.
    """
    for row, factor in enumerate(factors):
        if not isinstance(factor, gtsam.NonlinearFactor):
            raise _unusable(row, "a gtsam.NonlinearFactor", type(factor).__name__)
        keys = list(factor.keys())
        unknown = [key for key in keys if not known(key)]
        if unknown:
            raise _unusable(row, f"keys of {expected}", name(unknown[0]))
        try:
            linear = factor.linearize(values(np.array(keys, np.intp)))
        except Exception as error:  # whatever a user's own function raises, or GTSAM where types differ
            raise _unusable(row, "a factor that can be linearized", error) from error
        if linear is not None and not all(np.isfinite(part).all() for part in linear.jacobian()):
            raise _unusable(row, "finite numbers", "others where it is linearized")


def _unusable(row: int, expected: str, found: object) -> SettingsError:
    return SettingsError(f"factors, row {row}: expected {expected}, found {found}")


def _linear(factors: Sequence[_UserFactor], variables: Variables) -> list[gtsam.GaussianFactor]:
    """Returns linearized factors; a factor that is not active in GTSAM's sense gives none."""
    return [linear for linear in (_linearized(one, variables) for one in factors) if linear is not None]


def _linearized(one: _UserFactor, variables: Variables) -> gtsam.GaussianFactor | None:
    """Returns `1/2 |A d - b|^2` with d = value - reference.

    The tangent of `gtsam.Pose2` is in the frame of the pose, and our unknowns are in the map frame. So with R
    the rotation of the pose, `A_xy` becomes `A_xy R'`.
    """
    linear = one.factor.linearize(variables.gtsam_values(one.keys))
    if linear is None:
        return None
    keys = np.array(list(linear.keys()), np.intp)
    matrix, right = linear.jacobian()
    A, b = np.array(matrix, float), np.array(right, float).ravel()
    A = A @ _rotations(keys, variables).T
    return jacobian_factor(keys, A, b + A @ variables.change(variables.layout.entries(keys)))


def as_nonlinear(factor: gtsam.GaussianFactor, variables: Variables) -> gtsam.LinearContainerFactor:
    """Returns a linear factor on our unknowns as a factor of a nonlinear graph, about the variables' values.

    This is the inverse of the linearization of a user's factor: `A_xy R` on each pose, and `b - A d_now`.
    """
    layout = Layout(np.sort(np.array(list(factor.keys()), np.intp)))
    information, vector = normal_equations(graph_of(factor), layout)
    turn = _rotations(layout.keys, variables)
    negative_gradient = vector - information @ variables.change(variables.layout.entries(layout.keys))
    root, right = square_root_form(turn.T @ information @ turn, turn.T @ negative_gradient)
    linear = jacobian_factor(layout.keys, root, right)
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(linear), variables.gtsam_values(layout.keys))


def _rotations(keys: IntArray, variables: Variables) -> Array:
    """Returns the rotation (n, n), on keys (k,), of poses' x and y from their own frames to the map frame."""
    widths, poses = sizes(keys), are_poses(keys)
    starts = np.cumsum(widths) - widths
    headings = variables.of(keys[poses])[POSE - 1 :: POSE]
    return rotation_blocks(int(widths.sum()), starts[poses], headings)
