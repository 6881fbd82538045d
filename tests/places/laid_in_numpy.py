"""Cones laid on earlier ones in numpy (`_kernels:laid`)."""

from __future__ import annotations

from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import left_of, rotation, wrap_angle

ConeArrays = tuple[Array, Array, IntArray]  # points (n, 2), covariances (n, 2, 2) and labels (n,)

GATES: Final = (4.0, 4.0, 2.0, 1.0, 1.0, 1.0)  # factors of the cap in the steps of the refinement
REGULAR: Final = (1e-2, 1e-2, 1.0)  # information added in a step, so that few cones still give one


def laid(
    seen: ConeArrays,
    known: ConeArrays,
    views: Array,
    centres: Array,
    means: Array,
    prior: Array,
    reach: tuple[float, float],
    limits: tuple[float, ...],
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the places where seen cones may lie, as `find` compares them.

    Each centre is tried, as few cones may have been met again, and then the poses that may cost least.
    """
    apart, places, pairs = limits[4], int(limits[5]), [*zip(centres, means, strict=True)]
    votes = [
        (*one, mean)
        for centre, mean in pairs
        for one in _starts(seen, known, centre, mean, prior, reach, limits)
    ]
    starts = [*pairs]
    starts += [(start, mean) for _, start, mean in sorted(votes, key=lambda one: -one[0])]
    tried, found = list[Array](), []
    for start, mean in starts:
        if len(tried) == len(means) - 1 + 3 * places:
            break
        off = [(np.hypot(*(start - other)[:2]), abs(start[2] - other[2])) for other in tried]
        if any(distance < apart and turn < 1.5 * limits[3] for distance, turn in off):
            continue
        tried.append(start)
        found.append(_refined(seen, known, views, start, mean, prior, limits))
    poses, information, squares, counts, away = (np.array(column) for column in zip(*found, strict=True))
    return poses, information, squares, counts, away


def _starts(
    seen: ConeArrays,
    known: ConeArrays,
    centre: Array,
    mean: Array,
    prior: Array,
    reach: tuple[float, float],
    limits: tuple[float, ...],
) -> list[tuple[float, Array]]:
    """Return scores and poses (3,) about a centre that may cost least.

    Each pair of cones votes for a cell and the eight around it, against the distance from the mean.
    """
    size, step, places, gain, failed = limits[2], limits[3], int(limits[5]), limits[6], limits[7]
    i, j = np.nonzero(seen[2][:, None] == known[2])
    half, turns = int(np.ceil(reach[0] / size)) + 1, int(np.ceil(reach[1] / step))
    starts = list[tuple[float, Array]]()
    for turn in range(-turns, turns + 1):
        heading = centre[2] + turn * step
        c, s = np.cos(heading), np.sin(heading)
        x, y = seen[0][i].T
        move = np.column_stack([c * x - s * y, s * x + c * y])
        cell = np.floor((known[0][j] - move - centre[:2]) / size + 0.5).astype(np.intp) + half
        cell = cell[((cell > 0) & (cell < 2 * half)).all(axis=1)]
        votes = np.zeros((2 * half + 1, 2 * half + 1), np.intp)
        for a in (-1, 0, 1):
            for b in (-1, 0, 1):
                np.add.at(votes, (cell[:, 0] + a, cell[:, 1] + b), 1)
        at = np.argwhere(votes)
        poses = centre + np.column_stack([(at - half) * size, np.full(len(at), turn * step)])
        off = poses - mean
        off[:, 2] = wrap_angle(off[:, 2])
        score = gain * votes[at[:, 0], at[:, 1]] - np.minimum(
            np.einsum("ka,ab,kb->k", off, prior, off), failed
        )
        best = np.argsort(-score, kind="stable")[:places]
        starts += zip(score[best].tolist(), poses[best], strict=True)
    return starts


def _refined(
    seen: ConeArrays,
    known: ConeArrays,
    views: Array,
    start: Array,
    mean: Array,
    prior: Array,
    limits: tuple[float, ...],
) -> tuple[Array, Array, float, float, float]:
    """Return a row of `laid` after Gauss-Newton steps from a pose (3,)."""
    sigma, gate, pose = limits[0], limits[1], start
    for factor in (*GATES, None):
        turn, limit = rotation(pose[2]), gate * (factor or 1.0)
        arm = seen[0] @ turn.T
        off = (arm + pose[:2])[:, None] - known[0]
        weight = np.linalg.inv((turn @ seen[1] @ turn.T)[:, None] + known[1] + sigma**2 * np.eye(2))
        square = np.einsum("mni,mnij,mnj->mn", off, weight, off)
        square[seen[2][:, None] != known[2]] = np.inf
        rows, j = np.arange(len(arm)), square.argmin(axis=1)
        square, on = square[rows, j], square[rows, j] < limit
        weight, off = weight[rows, j][on], off[rows, j][on]
        by = np.zeros((on.sum(), 2, 3))
        by[:, 0, 0] = by[:, 1, 1] = 1.0
        by[:, :, 2] = left_of(arm[on])
        if factor is None:
            break
        weight = weight * ((1.0 - square[on] / limit) ** 2)[:, None, None]
        hessian = np.einsum("mia,mij,mjb->ab", by, weight, by) + np.diag(REGULAR)
        pose = pose - np.linalg.solve(hessian, np.einsum("mia,mij,mj->a", by, weight, off))
    away = pose - mean
    away[2] = wrap_angle(away[2])
    asked = on | _in_view(arm + pose[:2], views)
    information = np.einsum("mia,mij,mjb->ab", by, weight, by)
    square = np.minimum(square[asked], gate)
    return pose, information, float(square.sum()), float(len(square)), float(away @ prior @ away)


def _in_view(points: Array, views: Array) -> BoolArray:
    """Return which of the points (m, 2) one of the views (k, 5) has within its range and bearing."""
    off = points[:, None] - views[:, :2]
    bearing = np.abs(wrap_angle(np.arctan2(off[:, :, 1], off[:, :, 0]) - views[:, 2]))
    in_view = (np.hypot(off[:, :, 0], off[:, :, 1]) < views[:, 3]) & (bearing < views[:, 4])
    return np.asarray(in_view.any(axis=1))
