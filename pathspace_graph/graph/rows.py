"""Whitened linear rows on keys, and the GTSAM factors that are made of them.

The residual functions give whitened rows of a whole window at once. The binding's constructors take at most
three keys and one factor at a time. So the rows of all factors are written into one buffer, and each factor
is made of a view of it by way of a Gaussian conditional, which is a Jacobian factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import accumulate

import gtsam
import numpy as np
from numpy.typing import NDArray

from .keys import names, sizes
from .variables import UNKNOWN, Layout, Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Rows:
    """Holds whitened linear rows `J_i . dx + r_i`, with dx the change from the linearization point.

    All rows of a group have the same number of keys, with the same letters in the same order. No row has a
    key twice.
    """

    keys: IntArray
    """These are the keys (m, k) of each row's variables."""
    jacobian: Array
    """These are the whitened derivatives (m, n) by the entries of the variables, one key after the other."""
    residual: Array
    """These are the whitened residuals (m,) at the linearization point."""
    owner: IntArray
    """Each row (m,) belongs to the factor with this number; numbers are close together, as cycles are."""

    def __len__(self) -> int:
        return len(self.residual)

    def where(self, chosen: NDArray[np.bool_] | IntArray) -> Rows:
        """Returns some of the rows."""
        return Rows(self.keys[chosen], self.jacobian[chosen], self.residual[chosen], self.owner[chosen])

    @property
    def pattern(self) -> tuple[IntArray, IntArray]:
        """Returns which of a row's keys each derivative (n,) is by, and which entry of its variable."""
        return _pattern(tuple(sizes(self.keys[0]).tolist()))

    def columns(self, layout: Layout) -> IntArray:
        """Returns the column (m, n) of each derivative, which is UNKNOWN where a key is not in the layout."""
        key, entry = self.pattern
        starts = layout.columns(self.keys)[:, key]
        return np.where(starts == UNKNOWN, UNKNOWN, starts + entry)


@cache
def _pattern(widths: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    return np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(width) for width in widths])


@dataclass(frozen=True, eq=False)
class LinearFactor:
    """Holds a Jacobian factor and its keys."""

    keys: frozenset[int]
    """These are the keys of the factor."""
    linear: gtsam.GaussianConditional
    """This is the factor as GTSAM takes it."""


def jacobian_factors(groups: Sequence[Rows], variables: Variables) -> dict[int, LinearFactor]:
    """Returns a factor `1/2 |A d - b|^2` by owner, with d = value - reference, `A = J` and `b = J d_now - r`.

    The rows must have been linearized at the variables' values, d_now from the reference.
    """
    groups = [rows for rows in groups if len(rows)]
    if not groups:
        return {}
    blocks = _FactorBlocks(groups, variables.layout)
    buffer = blocks.write(groups, variables)
    return {owner: blocks.factor(f, buffer) for f, owner in enumerate(blocks.owners)}


class _FactorBlocks:
    """Says where each derivative goes in the buffer of all factors, each of which is stored by columns."""

    def __init__(self, groups: Sequence[Rows], layout: Layout) -> None:
        owner = np.concatenate([rows.owner for rows in groups])
        lowest = int(owner.min())
        present = np.bincount(owner - lowest) > 0
        owners = present.nonzero()[0]
        self.owners: list[int] = (lowest + owners).tolist()
        member = (present.cumsum() - 1)[owner - lowest]
        ends = [*accumulate(len(rows) for rows in groups)]
        self.slices = [slice(end - len(rows), end) for end, rows in zip(ends, groups, strict=True)]
        places = [_places(rows.keys, layout) for rows in groups]
        held = np.zeros(len(layout.keys), bool)
        for place in places:
            held[place] = True
        number, self.held = held.cumsum() - 1, held.nonzero()[0]  # factors hold few keys of a large map
        self.member, self.places = member, [number[place] for place in places]
        touched = np.zeros((len(owners), len(self.held)), bool)
        for place, own in zip(self.places, self.slices, strict=True):
            touched[member[own, None], place] = True
        widths = layout.widths[self.held]
        ending = (touched * widths).cumsum(axis=1)
        self.begin = ending - widths  # the column of each key in the factors that hold it
        self.width, self.height = ending[:, -1] + 1, np.bincount(member)
        self.size = self.height * self.width
        self.offset = self.size.cumsum() - self.size
        order = member.argsort(kind="stable")
        first = self.height.cumsum() - self.height
        self.row = np.empty(len(member), np.intp)
        self.row[order] = np.arange(len(member)) - first[member[order]]
        factor, key = touched.nonzero()
        self._bounds = factor.searchsorted(np.arange(len(owners) + 1)).tolist()
        self._keys, self._widths = layout.keys[self.held[key]].tolist(), widths[key].tolist()
        ends = [*accumulate(self.size.tolist(), initial=0)]
        self._blocks = list(zip(ends[:-1], ends[1:], self.height.tolist(), strict=True))

    def write(self, groups: Sequence[Rows], variables: Variables) -> Array:
        """Returns the buffer with the blocks `[A b]` of all factors."""
        buffer = np.zeros(int(self.size.sum()))
        change, starts = variables.values - variables.reference, variables.layout.starts[self.held]
        for rows, place, own in zip(groups, self.places, self.slices, strict=True):
            (key, entry), member = rows.pattern, self.member[own]
            height, first = self.height[member], self.offset[member] + self.row[own]
            columns = self.begin[member[:, None], place][:, key] + entry
            columns *= height[:, None]
            columns += first[:, None]
            buffer[columns] = rows.jacobian
            moved = change.take(starts.take(place)[:, key] + entry)
            moved *= rows.jacobian
            buffer[first + (self.width[member] - 1) * height] = moved.sum(axis=1) - rows.residual
        return buffer

    def factor(self, f: int, buffer: Array) -> LinearFactor:
        """Returns the factor of one owner."""
        own, (begin, end, height) = slice(self._bounds[f], self._bounds[f + 1]), self._blocks[f]
        keys, block = self._keys[own], buffer[begin:end].reshape((height, -1), order="F")
        matrix = gtsam.VerticalBlockMatrix([*self._widths[own], 1], block, False)
        return LinearFactor(frozenset(keys), gtsam.GaussianConditional(keys, 1, matrix))


def _places(keys: IntArray, layout: Layout) -> IntArray:
    """Returns the index of each key in a layout; ValueError where the layout does not hold it."""
    places = layout.keys.searchsorted(keys)
    known = layout.keys.take(places, mode="clip") == keys
    if not known.all():
        raise ValueError(f"expected rows on known variables, found {names(keys[~known])}")
    return places


def stacked_factor(groups: Sequence[Rows], variables: Variables) -> list[gtsam.GaussianConditional]:
    """Returns a list of one factor that holds all rows, or an empty list where there are no rows."""
    stacked = [Rows(r.keys, r.jacobian, r.residual, np.zeros(len(r), np.intp)) for r in groups]
    return [factor.linear for factor in jacobian_factors(stacked, variables).values()]
