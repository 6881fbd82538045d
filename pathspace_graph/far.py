"""The far part of the map: control points that nothing in the window touches, conditional on the near ones.

`p(near, far) = p(near) p(far | near)`: what the window measures changes the near part only, and the far part
follows through its conditional when it is asked for. That is exact, and a cycle costs no more on a longer
track. It is one path of a Bayes tree (Kaess et al. 2012), or a compressed filter (Guivant and Nebot 2001).

A conditional needs the oldest pose of the window as it was when the far part left, since what the two know of
each other they know through it. That pose, its *anchor*, stays in the system until the next part leaves with
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from .window import POSE, Prior, cholesky

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Parting:
    """What is to leave a prior, and how its entries are called in x."""

    frontal: IntArray
    """(f,) entries of the prior: control points, and the old anchor where it has left the window."""
    stays: IntArray
    """(s,) the others: near control points, calibration, and last the new anchor."""
    columns: IntArray
    """(k,) columns of x of the control points among the frontals, and of the separator but its anchor."""
    frontals: int
    """How many of them are frontal."""
    left: int | None
    """Cycle of the old anchor, where it is among the frontals."""
    anchor: int
    """Cycle of the new one."""
    hessian: Array
    """(f + s, f + s) the weak priors that leave with it, in the order frontal, stays, ..."""
    descent: Array
    """... and their negative gradient at the prior's point."""


@dataclass(frozen=True, eq=False)
class Conditional:
    """`p(frontal | separator)`: `L' df + W ds = y`, both from the point it was linearized at."""

    parting: Parting
    """Whose it is."""
    at: slice
    """Where the parting's columns are among all, which are kept up to date where x grows (`Far.columns`)."""
    point: Array
    """(f + s,) frontals and separator as they were."""
    lower: Array
    """(f, f) L."""
    coupling: Array
    """(f, s) W."""
    right: Array
    """(f,) y."""

    def order(self, columns: IntArray, begin: Mapping[int, int], otherwise: int) -> IntArray:
        """(f + s,) columns of frontals and separator, where each anchor begins given by its cycle."""
        k, pose = self.parting.frontals, np.arange(POSE)
        left = [] if self.parting.left is None else [begin[self.parting.left] + pose]
        anchor = begin.get(self.parting.anchor, otherwise) + pose
        return np.concatenate([columns[:k], *left, columns[k:], anchor])

    @property
    def root(self) -> Array:
        """(f, f + s) [L' W]."""
        return np.concatenate([self.lower.T, self.coupling], axis=1)

    def frontal_mean(self, separator: Array) -> Array:
        """(f,) of the frontals, given the separator's (s,)."""
        f = len(self.right)
        right = self.right - self.coupling @ (separator - self.point[f:])
        step, _ = lapack.dtrtrs(self.lower, right, lower=1, trans=1)
        return np.asarray(self.point[:f] + step)


class Far:
    """All conditionals; each hangs on what left after it, and the last one on the system."""

    def __init__(self) -> None:
        self.parts: list[Conditional] = []
        """The first to leave first."""
        self._columns: IntArray = np.zeros(0, np.intp)

    @property
    def anchor(self) -> int | None:
        """Cycle of the pose that the last part hangs on."""
        return self.parts[-1].parting.anchor if self.parts else None

    def shift(self, column: int, count: int) -> None:
        """So many new entries of x at a column."""
        self._columns += count * (self._columns >= column)

    def columns(self, part: Conditional) -> IntArray:
        """Columns of x of a part's frontal control points, and of its separator but the anchor: a view."""
        return self._columns[part.at]

    def push(self, prior: Prior, parting: Parting) -> Prior:
        """A part leaves; gives the prior on what stays, in its order."""
        order, f = np.concatenate([parting.frontal, parting.stays]), len(parting.frontal)
        information = prior.information[np.ix_(order, order)] + parting.hessian
        gradient, point = prior.gradient[order] + parting.descent, prior.point[order]
        lower = np.tril(cholesky(information[:f, :f]))
        half, _ = lapack.dtrtrs(lower, np.column_stack([information[:f, f:], gradient[:f]]), lower=1)
        w, y = np.ascontiguousarray(half[:, :-1]), half[:, -1]
        at = slice(len(self._columns), len(self._columns) + len(parting.columns))
        self._columns = np.concatenate([self._columns, parting.columns])
        self.parts.append(Conditional(parting, at, point, lower, w, y))
        return Prior(information[f:, f:] - w.T @ w, gradient[f:] - y @ w, point[f:])

    def refresh(self, x: Array, anchor: Array) -> dict[int, Array]:
        """Bring the far entries of x up to date, given the last part's anchor (3,); all anchors by cycle."""
        anchors = {self.parts[-1].parting.anchor: anchor} if self.parts else {}
        for part in reversed(self.parts):
            parting, k, columns = part.parting, part.parting.frontals, self.columns(part)
            frontal = part.frontal_mean(np.concatenate([x[columns[k:]], anchors[parting.anchor]]))
            x[columns[:k]] = frontal[:k]
            if parting.left is not None:
                anchors[parting.left] = frontal[k:]
        return anchors

    def joined(
        self, prior: Prior, near: IntArray, x: Array, lead: int, anchors: Mapping[int, Array]
    ) -> Prior:
        """The prior as if nothing had left, at x and `anchors` (see `refresh`).

        `near`: columns of x of the given prior's entries before its poses, of which the first one is the last
        part's anchor. Before `lead` x has no poses. The anchors that left the window long ago come there.
        """
        left = [part.parting.left for part in self.parts if part.parting.left is not None]
        begin = {cycle: lead + POSE * i for i, cycle in enumerate(left)}
        tail, poses = len(prior.point) - len(near), lead + POSE * len(left)
        point = np.concatenate([x[:lead], *(anchors[cycle] for cycle in left), x[lead : lead + tail]])
        information, descent = np.zeros((len(point), len(point))), np.zeros(len(point))
        own = np.concatenate([near, poses + np.arange(tail)])
        information[np.ix_(own, own)] += prior.information
        descent[own] += prior.descent_at(point[own])
        for part in self.parts:
            columns = part.order(self.columns(part), begin, poses)
            root, moved = part.root, point[columns] - part.point
            information[np.ix_(columns, columns)] += root.T @ root - part.parting.hessian
            descent[columns] += root.T @ (part.right - root @ moved)
            descent[columns] -= part.parting.descent - part.parting.hessian @ moved
        return Prior(information, descent, point)
