"""Random linear problems on keys, as dense matrices and as graphs of the engine."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors._kernels import RowStore
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, Layout, Variables, control_keys, pose_keys

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

LEFT_KEYS, RIGHT_KEYS, POSE_KEYS = (
    control_keys(0, np.arange(4)),
    control_keys(1, np.arange(3)),
    pose_keys(np.arange(5, 9)),
)
MAP_KEYS = np.concatenate([LEFT_KEYS, RIGHT_KEYS])
KEYS = np.concatenate([[CALIBRATION_KEY], MAP_KEYS, POSE_KEYS])
"""The keys of the calibration, seven control points and four poses are ascending."""


def rows_in(*stores: RowStore) -> list[Rows]:
    """Returns the rows of stores, a group for each widths of variables."""
    return [Rows(*parts) for store in stores for parts in store.parts()]


def width(key: int) -> int:
    """Returns the number of entries of a key's variable, independently of the engine."""
    return {"x": 3, "c": 5}.get(chr(key >> 56), 2)


def columns_of(keys: IntArray, among: IntArray) -> IntArray:
    """Returns the columns of some keys (k,) in a layout of keys `among`, independently of the engine."""
    widths = [width(int(key)) for key in among]
    starts = dict(zip(among.tolist(), np.cumsum(widths) - widths, strict=True))
    return np.concatenate([starts[int(key)] + np.arange(width(int(key))) for key in keys])


def random_variables(rng: np.random.Generator, keys: IntArray = KEYS) -> Variables:
    """Returns values that differ from their references."""
    variables = Variables()
    variables.insert(keys, rng.normal(size=Layout(keys).size))
    variables.values += rng.normal(size=len(variables.values))
    return variables


def random_rows(rng: np.random.Generator, sets: list[IntArray], count: int, owners: int) -> Rows:
    """Returns rows, each on one key of each set, owned by one of a few cycles."""
    keys = np.stack([rng.choice(one, count) for one in sets], axis=1)
    size = sum(width(int(one[0])) for one in sets)
    owner = 40 + rng.integers(0, owners, count)
    return Rows(keys, rng.normal(size=(count, size)), rng.normal(size=count), owner)


def random_groups(rng: np.random.Generator, owners: int = 4) -> list[Rows]:
    """Returns detections of three control points, odometry with calibration, spacings, and an empty group."""
    detections = random_rows(rng, [POSE_KEYS, LEFT_KEYS[:2], LEFT_KEYS[2:], RIGHT_KEYS], 60, owners)
    odometry = random_rows(rng, [KEYS[:1], POSE_KEYS[:2], POSE_KEYS[2:]], 30, owners)
    spacing = random_rows(rng, [RIGHT_KEYS[:1], RIGHT_KEYS[1:]], 5, owners)
    nothing = Rows(np.zeros((0, 2), np.intp), np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.intp))
    return [detections, nothing, odometry, spacing]


def dense_rows(groups: list[Rows], keys: IntArray) -> tuple[Array, Array, IntArray]:
    """Returns J (m, n), r (m,) and the owner (m,) of all rows, on all columns of the keys."""
    size = sum(width(int(key)) for key in keys)
    matrices = []
    for rows in groups:
        J = np.zeros((len(rows), size))
        for i in range(len(rows)):
            J[i, columns_of(rows.keys[i], keys)] = rows.jacobian[i]
        matrices.append(J)
    residual = np.concatenate([rows.residual for rows in groups])
    return np.concatenate(matrices), residual, np.concatenate([rows.owner for rows in groups])


def random_factor(
    rng: np.random.Generator, keys: IntArray, rows: int | None = None
) -> tuple[gtsam.GaussianConditional, Array, Array]:
    """Returns a factor on keys with its A and b; without `rows` it has more rows than columns."""
    size = sum(width(int(key)) for key in keys)
    rows = size + 2 if rows is None else rows
    A, b = rng.normal(size=(rows, size)), rng.normal(size=rows)
    return jacobian_factor(keys, A, b), A, b


def random_graph(
    rng: np.random.Generator, sets: list[IntArray], keys: IntArray = KEYS, rows: int | None = None
) -> tuple[gtsam.GaussianFactorGraph, Array, Array]:
    """Returns a factor on each set of keys, and the dense `A'A` and `A'b` on the columns of all keys."""
    size = sum(width(int(key)) for key in keys)
    hessian, vector, factors = np.zeros((size, size)), np.zeros(size), []
    for own in sets:
        factor, A, b = random_factor(rng, own, rows)
        at = columns_of(own, keys)
        hessian[np.ix_(at, at)] += A.T @ A
        vector[at] += A.T @ b
        factors.append(factor)
    return graph_of(*factors), hessian, vector


def schur(hessian: Array, vector: Array, gone: IntArray) -> tuple[Array, Array]:
    """Returns the information form of all other entries after `gone` (k,) are marginalized out."""
    stay = np.setdiff1d(np.arange(len(vector)), gone)
    covariance = np.linalg.inv(hessian)
    information = np.linalg.inv(covariance[np.ix_(stay, stay)])
    return information, information @ (covariance @ vector)[stay]


def pose_columns(keys: IntArray) -> list[tuple[int, int]]:
    """Returns the key and the first column of each pose among keys."""
    return [(int(key), int(columns_of(np.array([key]), keys)[0])) for key in keys if width(int(key)) == POSE]
