"""A whole window as GTSAM linear algebra: finished rows on a flat state become Jacobian factors on keys."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
LinearRows = tuple[IntArray, Array, Array]
"""Whitened rows `J[i] . dx[columns[i]] + r[i]`: columns (m, k) of the state, J (m, k), r (m,)."""

BOUNDARY_SYMBOLS = ("l", "r")
"""Key letters of the control points, by boundary label (left, right)."""
POSE_SYMBOL = "x"
"""Key letter of the poses."""
CALIBRATION_KEY = gtsam.symbol("b", 0)
"""Key of the odometry's calibration."""
POSE_SIZE = 3
"""Size of a pose in the state."""
RANK_TOLERANCE = 1e-12
"""Information below this share of the largest eigenvalue is none."""


@dataclass(frozen=True, eq=False)
class WindowKeys:
    """Which key each entry of the state `[control points | calibration | poses, oldest first]` belongs to."""

    keys: tuple[int, ...]
    """(K,) GTSAM keys, in the state's order."""
    dims: IntArray
    """(K,) entries of each in the state: 2 a control point, 3 a pose."""
    headings: Array
    """(K,) theta of a pose where the rows were linearized, rad; zero for other keys."""


def window_keys(sizes: tuple[int, int], calibration: int, poses: Array, first_pose: int = 0) -> WindowKeys:
    """Keys of a state of `sizes` control points (left, right), `calibration` entries, and poses (P, 3).

    Control points are `l_j` and `r_j`, the calibration `b_0` (left out where it has no entries), poses `x_k`
    with k counted from `first_pose`, so that a pose keeps its key while older ones leave.
    """
    counted = zip(BOUNDARY_SYMBOLS, sizes, strict=True)
    control = [gtsam.symbol(letter, j) for letter, size in counted for j in range(size)]
    shared = [CALIBRATION_KEY] if calibration else []
    pose_keys = [gtsam.symbol(POSE_SYMBOL, first_pose + k) for k in range(len(poses))]
    dims = [2] * len(control) + [calibration] * len(shared) + [POSE_SIZE] * len(pose_keys)
    headings = np.concatenate([np.zeros(len(control) + len(shared)), poses[:, 2]])
    return WindowKeys((*control, *shared, *pose_keys), np.array(dims, np.intp), headings)


def jacobian_factor(keys: Sequence[int], dims: Sequence[int], A: Array, b: Array) -> gtsam.JacobianFactor:
    """`1/2 |A x - b|^2` over any number of keys, A (m, sum of dims) whitened, b (m,).

    The binding's own constructors stop at three keys; a Gaussian conditional has no such limit and is a
    Jacobian factor. Shapes are checked here, since the binding doesn't.
    """
    if len(keys) != len(dims) or len(set(keys)) != len(keys):
        raise ValueError(f"expected one size for each of {len(keys)} different keys, found {len(dims)}")
    if A.shape != (len(b), sum(dims)):
        raise ValueError(f"expected a matrix of shape {(len(b), sum(dims))}, found {A.shape}")
    blocks = np.empty((len(b), A.shape[1] + 1), order="F")
    blocks[:, :-1] = A
    blocks[:, -1] = b
    matrix = gtsam.VerticalBlockMatrix([*dims, 1], blocks, False)
    return gtsam.JacobianFactor(gtsam.GaussianConditional(list(keys), 1, matrix))


def linear_graph(groups: Iterable[LinearRows], window: WindowKeys) -> gtsam.GaussianFactorGraph:
    """The window's linear system `min sum |J dx + r|^2`, a factor for each set of keys in a group of rows.

    Pose columns come in as the state has them, (x, y, theta) in the map frame, and go out in GTSAM's tangent
    of Pose2 (`t += R v`, `theta += w`, to first order), as `retract` wants the solution.
    """
    graph = gtsam.GaussianFactorGraph()
    block_of = np.repeat(np.arange(len(window.keys)), window.dims)
    for columns, jacobian, residual in groups:
        touched = np.zeros((len(residual), len(window.keys)), dtype=bool)
        np.put_along_axis(touched, block_of[columns], True, axis=1)
        dense = _in_tangents(_scattered(columns, jacobian, len(block_of)), window)
        for rows in _rows_by_set(touched):
            blocks = np.flatnonzero(touched[rows[0]])
            A = dense[rows[:, None], np.flatnonzero(touched[rows[0], block_of])]
            keys = [window.keys[k] for k in blocks]
            graph.add(jacobian_factor(keys, window.dims[blocks].tolist(), A, -residual[rows]))
    return graph


def _scattered(columns: IntArray, jacobian: Array, size: int) -> Array:
    """Rows on the whole state (m, size); a column met twice in a row counts twice."""
    flat = np.arange(len(columns))[:, None] * size + columns
    dense = np.bincount(flat.ravel(), jacobian.ravel(), len(columns) * size)
    return np.asarray(dense.reshape(len(columns), size), dtype=np.float64)


def _in_tangents(dense: Array, window: WindowKeys) -> Array:
    """The same with pose columns by the pose's own axes: `dr/dv = dr/dt R`."""
    x = (np.cumsum(window.dims) - window.dims)[window.dims == POSE_SIZE]
    heading = window.headings[window.dims == POSE_SIZE]
    c, s = np.cos(heading), np.sin(heading)
    turned = dense.copy()
    turned[:, x] = dense[:, x] * c + dense[:, x + 1] * s
    turned[:, x + 1] = dense[:, x + 1] * c - dense[:, x] * s
    return turned


def _rows_by_set(touched: NDArray[np.bool_]) -> list[IntArray]:
    """Row numbers of each different row of `touched`."""
    if len(touched) == 0:
        return []
    _, member = np.unique(np.packbits(touched, axis=1), axis=0, return_inverse=True)
    order = np.argsort(member.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(member.ravel()[order])) + 1)


def rotation(theta: float) -> Array:
    """R(theta) (2, 2): vehicle to map frame."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def prior_rows(information: Array, descent: Array) -> LinearRows:
    """A prior `1/2 dx' L dx - g' dx` on the leading entries of the state as rows: `J'J = L`, `-J'r = g`.

    information L (q, q) positive semidefinite, descent g (q,) in its range. Directions without information
    have no row.
    """
    values, vectors = np.linalg.eigh(information)
    known = values > RANK_TOLERANCE * max(values.max(initial=0.0), 0.0)
    root = np.sqrt(values[known])
    jacobian = root[:, None] * vectors[:, known].T
    residual = -(vectors[:, known].T @ descent) / root
    return np.tile(np.arange(len(descent)), (len(root), 1)), jacobian, residual
