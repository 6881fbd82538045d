"""The window's linear algebra: whitened rows, a Gaussian prior, a dense solve and the Schur complement.

What is solved for is one vector `[control points | calibration | poses, oldest first]`. Everything in it is
additive: a pose is (x, y, theta) in the map frame with theta unwrapped. The prior stands on a leading block
of it, so that the oldest pose, which comes right after the map, leaves by a Schur complement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from .errors import PathspaceError

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POSE = 3
"""Size of a pose in the state."""
NEGLIGIBLE = 1e-6
"""Information (1/m^2) that is as good as none, and keeps a pivot from being zero."""


class SingularSystemError(PathspaceError):
    """The window's normal equations are not positive definite: nothing holds some entry of the state."""


@dataclass(frozen=True)
class Rows:
    """Whitened linear rows `J[i] . dx[columns[i]] + r[i]`, of equally many columns each."""

    columns: IntArray
    """(m, k) columns of the state."""
    jacobian: Array
    """(m, k) whitened derivatives."""
    residual: Array
    """(m,) whitened residuals at the linearization point."""

    def at(self, position: IntArray) -> Rows:
        """The rows on other columns: `position` (n,) says where each has gone."""
        return Rows(position[self.columns], self.jacobian, self.residual)

    def split(self, low: int, high: int) -> tuple[Rows, Rows]:
        """The rows that touch a column in [low, high), and the others."""
        touches = np.asarray(((self.columns >= low) & (self.columns < high)).any(axis=1))
        return self._take(touches), self._take(~touches) if touches.any() else self

    def _take(self, rows: NDArray[np.bool_]) -> Rows:
        return Rows(self.columns[rows], self.jacobian[rows], self.residual[rows])

    def without(self, low: int, high: int) -> Rows:
        """The rows, none of which touches [low, high), where those columns are taken out of the state."""
        moved = self.columns - (high - low) * (self.columns >= high)
        return Rows(moved, self.jacobian, self.residual)

    @property
    def reach(self) -> int:
        """One past the last column that any row touches."""
        return int(self.columns.max(initial=-1)) + 1


@dataclass
class Prior:
    """`1/2 (x - x0)' L (x - x0) - g' (x - x0)` on the leading block of the state."""

    information: Array
    """(q, q) L."""
    gradient: Array
    """(q,) g."""
    point: Array
    """(q,) x0, where it was linearized."""

    def descent_at(self, state: Array) -> Array:
        """The negative gradient `g - L (x - x0)` at the state's leading block."""
        return self.gradient - self.information @ (state[: len(self.point)] - self.point)

    def widen(self, at: int, values: Array) -> None:
        """Make room for new state entries at index `at`, of which the prior knows nothing."""
        count = len(values)
        q = len(self.point)
        information = np.zeros((q + count, q + count))
        information[:at, :at] = self.information[:at, :at]
        information[:at, at + count :] = self.information[:at, at:]
        information[at + count :, :at] = self.information[at:, :at]
        information[at + count :, at + count :] = self.information[at:, at:]
        self.information = information
        self.gradient = np.insert(self.gradient, at, np.zeros(count))
        self.point = np.insert(self.point, at, values)

    def forget(self, entries: IntArray) -> None:
        """Know nothing of some entries (k,) any more, and of the others no less than before."""
        rest = np.setdiff1d(np.arange(len(self.point)), entries)
        kept, gradient = marginal(self.information, self.gradient, entries, rest)
        self.information = np.zeros_like(self.information)
        self.information[np.ix_(rest, rest)] = kept
        self.gradient = np.zeros_like(self.gradient)
        self.gradient[rest] = gradient


def accumulate(groups: Sequence[Rows], size: int) -> tuple[Array, Array]:
    """Normal equations `H = sum J'J` (size, size) and `-gradient = -sum J'r` (size,) of all rows."""
    groups = [g for g in groups if len(g.residual)]
    if not groups:
        return np.zeros((size, size)), np.zeros(size)
    places, products, columns, terms = zip(*(_products(g, size) for g in groups), strict=True)
    half = _sums(np.concatenate(places), np.concatenate(products), size * size).reshape(size, size)
    return half + half.T, _sums(np.concatenate(columns), np.concatenate(terms), size)


def _products(rows: Rows, size: int) -> tuple[IntArray, Array, IntArray, Array]:
    """What rows add to half of H, `H/2 + H/2' = H`: flat places and terms; and to the descent, the same."""
    i, j, share = _pairs(rows.columns.shape[1])
    columns, jacobian = np.ascontiguousarray(rows.columns.T), np.ascontiguousarray(rows.jacobian.T)
    places = columns.take(i, axis=0) * size
    places += columns.take(j, axis=0)
    products = jacobian.take(i, axis=0)
    products *= jacobian.take(j, axis=0)
    products *= share
    return places.ravel(), products.ravel(), columns.ravel(), (jacobian * -rows.residual).ravel()


@cache
def _pairs(k: int) -> tuple[IntArray, IntArray, Array]:
    """Every pair (k (k + 1) / 2,) of k columns once, and its share (..., 1): half of one with itself."""
    i, j = np.triu_indices(k)
    return i, j, np.where(i == j, 0.5, 1.0)[:, None]


def _sums(index: IntArray, terms: Array, size: int) -> Array:
    """(size,) sum of the terms of each index."""
    return np.asarray(np.bincount(index, terms, size), np.float64)


def cholesky(hessian: Array, overwrite: bool = False) -> Array:
    """Lower factor `L L' = H`, its upper triangle not cleared; SingularSystemError where there is none.

    `overwrite`: it may take the place of a row-major H.
    """
    factor, info = lapack.dpotrf(hessian.T, lower=1, clean=0, overwrite_a=overwrite)
    if info != 0:
        raise SingularSystemError(f"expected a positive definite system, found pivot {info} not positive")
    return np.asarray(factor)


def solve(factor: Array, descent: Array) -> Array:
    """`H^-1 b` from the lower factor."""
    step, _ = lapack.dpotrs(factor, descent, lower=1)
    return np.asarray(step)


def schur_leave(hessian: Array, descent: Array, low: int, high: int) -> tuple[Array, Array]:
    """Without the entries [low, high): `H_bb - H_ba H_aa^-1 H_ab` and `g_b - H_ba H_aa^-1 g_a`.

    By the root `W = L_a^-1 H_ab`, so that it stays symmetric: `H_bb - W' W`.
    """
    half = cholesky(hessian[low:high, low:high])
    coupling = np.column_stack([without(hessian[low:high], low, high, 1), descent[low:high]])
    root, _ = lapack.dtrtrs(half, coupling, lower=1)
    w, g = np.ascontiguousarray(root[:, :-1]), root[:, -1]
    information = without(without(hessian, low, high, 0), low, high, 1)
    information -= w.T @ w
    return information, without(descent, low, high, 0) - g @ w


def marginal(information: Array, gradient: Array, gone: IntArray, rest: IntArray) -> tuple[Array, Array]:
    """What a prior says of the entries `rest`; of the others, `gone`, it may know a part only."""
    order = np.append(gone, rest)
    hessian, descent = information[np.ix_(order, order)], gradient[order]
    hessian[np.arange(len(gone)), np.arange(len(gone))] += NEGLIGIBLE
    return schur_leave(hessian, descent, 0, len(gone))


def without(values: Array, low: int, high: int, axis: int) -> Array:
    """A copy of an array without [low, high) of an axis."""
    parts = [values[:low], values[high:]] if axis == 0 else [values[:, :low], values[:, high:]]
    return np.concatenate(parts, axis=axis)
