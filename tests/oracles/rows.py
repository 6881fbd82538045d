"""Layouts of variables, rows on them, and links of the inactive map in numpy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.graph.inactive import Link
from pathspace_graph.graph.relative import by_frame_of, from_frame, rotations, to_frame
from pathspace_graph.graph.rows import Parts, Rows, among, stacked_rows
from pathspace_graph.graph.variables import INDEX_BITS, NO_KEYS, POSE, UNKNOWN, Layout


def laid_out(
    keys: IntArray, sensor_key: int, first_pose: int, sizes: tuple[int, int, int], bounds: IntArray
) -> tuple[IntArray, IntArray, int, list[int]]:
    """Return the widths (k,) and the first columns (k,) of variables, and their number of columns."""
    point, sensor, pose = sizes
    senses = (keys >= sensor_key) & (keys < sensor_key + (1 << INDEX_BITS))
    widths = np.where(keys >= first_pose, pose, np.where(senses, sensor, point))
    ends = np.append(0, widths.cumsum())
    return widths, ends[:-1], int(ends[-1]), ends[keys.searchsorted(bounds)].tolist()


def spread(starts: IntArray, widths: IntArray) -> IntArray:
    """Return the columns (n,) of blocks (k,) with these first columns and widths, one after the other."""
    ends = np.cumsum(widths)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(starts - (ends - widths), widths) + np.arange(total)


def columns_of(layout: Layout, rows: Rows) -> IntArray:
    """Return `Rows.columns`."""
    if len(rows) == 0:
        return np.zeros(rows.jacobian.shape, np.intp)
    key, entry = _pattern(rows.widths)
    begin = layout.columns(rows.keys)[:, key]
    return np.where(begin == UNKNOWN, UNKNOWN, begin + entry)


def _known_columns(layout: Layout, rows: Rows) -> IntArray:
    """Return `columns_of`; ValueError where a key is UNKNOWN."""
    columns = columns_of(layout, rows)
    if (columns == UNKNOWN).any():
        raise ValueError("expected rows on known variables, found others")
    return columns


def _pattern(widths: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    """Return which of a row's keys each derivative (n,) is by, and which entry of its variable."""
    return np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(width) for width in widths])


def moved_residual(layout: Layout, rows: Rows, change: Array) -> Array:
    """Return `r - J c` (m,) with c the change (n,) of a layout's variables; ValueError for rows on others."""
    return np.asarray(rows.residual - (rows.jacobian * change[_known_columns(layout, rows)]).sum(axis=1))


def blocks_of(layout: Layout, groups: Sequence[Rows]) -> list[tuple[int, IntArray, Array]]:
    """Return each owner, ascending, with places (h,) of its rows' variables and `[J -r]` (m, n + 1)."""
    owners = np.unique(np.concatenate([NO_KEYS, *(rows.owner for rows in groups)])).tolist()
    own = {owner: [rows.where(rows.owner == owner) for rows in groups if len(rows)] for owner in owners}
    return [(owner, *_block(layout, [rows for rows in own[owner] if len(rows)])) for owner in owners]


def _block(layout: Layout, groups: Sequence[Rows]) -> tuple[IntArray, Array]:
    sought = np.concatenate([NO_KEYS, *(rows.keys.ravel() for rows in groups)])
    held = np.flatnonzero(among(layout.keys, np.sort(sought)))
    part, end = Layout(layout.keys[held]), 0
    block = np.zeros((sum(map(len, groups)), part.size + 1), order="F")
    for rows in groups:
        begin, end = end, end + len(rows)
        block[np.arange(begin, end)[:, None], _known_columns(part, rows)] = rows.jacobian
        block[begin:end, -1] = -rows.residual
    return held, block


class RowStore:
    """The kernels' `RowStore` in numpy."""

    def __init__(self, groups: Sequence[Rows] = ()) -> None:
        self.groups = [*groups]  # one for each widths of variables, never empty

    def __bool__(self) -> bool:
        return bool(self.groups)

    def copy(self) -> RowStore:
        return RowStore(self.groups)

    def parts(self) -> list[Parts]:
        return [rows.parts for rows in self.groups]

    def owners(self) -> IntArray:
        return np.concatenate([NO_KEYS, *(rows.owner for rows in self.groups)])

    def holding(self, keys: IntArray) -> IntArray:
        held = (rows.owner[among(rows.keys, keys).any(axis=1)] for rows in self.groups)
        return np.concatenate([NO_KEYS, *held])

    def stale(self, owners: IntArray, keys: IntArray) -> BoolArray:
        return ~np.isin(owners, self.owners()) | np.isin(owners, self.holding(keys))

    def replace(self, owners: IntArray, fresh: Sequence[Rows], layout: Layout, change: Array) -> None:
        new = dict[tuple[int, ...], list[Rows]]()
        for rows in fresh:
            if len(rows):
                at_change = replace(rows, residual=moved_residual(layout, rows, change))
                new.setdefault(rows.widths, []).append(at_change)
        kept = {rows.widths: rows.where(~np.isin(rows.owner, owners)) for rows in self.groups}
        groups = []
        for widths in {**new, **kept}:
            groups.append(stacked_rows([*([kept[widths]] if widths in kept else []), *new.get(widths, [])]))
        self.groups = [rows for rows in groups if len(rows)]

    def drop(self, owners: IntArray) -> None:
        kept = [rows.where(~np.isin(rows.owner, owners)) for rows in self.groups]
        self.groups = [rows for rows in kept if len(rows)]

    def pop(self, owner: int, layout: Layout) -> tuple[IntArray, Array]:
        leaving = [rows.where(rows.owner == owner) for rows in self.groups]
        self.drop(np.array([owner]))
        return _block(layout, [rows for rows in leaving if len(rows)])


def summed(
    layout: Layout, factors: list[tuple[IntArray, Array]], stores: Sequence[Any], change: Array
) -> tuple[Array, Array]:
    """Return the lower triangle of H (n, n), by columns, and the negative gradient (n,), at `change` (n,)."""
    hessian, gradient = np.zeros((len(change), len(change)), order="F"), np.zeros(len(change))
    for keys, matrix in factors:
        entries = layout.entries(keys)
        hessian[np.ix_(entries, entries)] += matrix[:-1, :-1]
        gradient[entries] += matrix[:-1, -1] - matrix[:-1, :-1] @ change[entries]
    for rows in (Rows(*parts) for store in stores for parts in store.parts()):
        A = np.zeros((len(rows), len(gradient)))
        A[np.arange(len(rows))[:, None], _known_columns(layout, rows)] = rows.jacobian
        hessian += A.T @ A
        gradient -= (A @ change + rows.residual) @ A
    return hessian, gradient


def relative_block(
    root: Array, right: Array, local: Array, values: Array, change: Array, keys: Layout
) -> Array:
    """Return `[J | J d - r]` (r, q + 4), by columns, of a relative factor."""
    now, frame = values[:-POSE], values[-POSE:]
    by_all = np.hstack([rotations(keys, frame[2]).T, by_frame_of(now, frame, keys)])
    jacobian, residual = root @ by_all, root @ (to_frame(now, frame, keys) - local) - right
    return np.asfortranarray(np.column_stack([jacobian, jacobian @ change - residual]))


def link_means(
    values: Array, links: Sequence[Link], frames: IntArray, leaving: IntArray, others: IntArray
) -> Array:
    """Return all values (n,), with the inactive variables at their conditional means, newest link first."""
    values = values.copy()
    for link, frame, y, z in reversed([*_by_link(links, frames, leaving, others)]):
        pose = values[frame : frame + POSE]
        mean = link.gain @ to_frame(values[z], pose, link.others) + link.offset
        values[y] = from_frame(mean, pose, link.leaving)
    return values


def origin_by_active(
    values: Array, links: Sequence[Link], frames: IntArray, leaving: IntArray, others: IntArray, origin: int
) -> tuple[Array, Array]:
    """Return the derivative (3, n) of the origin's pose by the active variables, and its covariance."""
    by_all, covariance = np.zeros((POSE, len(values))), np.zeros((POSE, POSE))
    by_all[:, origin : origin + POSE] = np.eye(POSE)
    for link, frame, y, z in _by_link(links, frames, leaving, others):
        pose = values[frame : frame + POSE]
        by_mean = by_all[:, y] @ rotations(link.leaving, pose[2])
        by_noise, by_others = by_mean @ link.noise, by_mean @ link.gain
        by_all[:, y] = 0.0
        by_all[:, z] += by_others @ rotations(link.others, pose[2]).T
        by_all[:, frame : frame + POSE] += by_others @ by_frame_of(values[z], pose, link.others)
        by_all[:, frame : frame + POSE] -= by_mean @ by_frame_of(values[y], pose, link.leaving)
        covariance += by_noise @ by_noise.T
    return by_all, covariance


def _by_link(
    links: Sequence[Link], frames: IntArray, leaving: IntArray, others: IntArray
) -> Iterator[tuple[Link, int, IntArray, IntArray]]:
    ends = (
        np.cumsum([of.size for of in all_of])
        for all_of in zip(*((k.leaving, k.others) for k in links), strict=True)
    )
    columns = (np.split(all_of, end[:-1]) for all_of, end in zip((leaving, others), ends, strict=True))
    return zip(links, frames.tolist(), *columns, strict=True)
