"""Conversion of GTSAM's linear factors to arrays and back, without loss of a bit."""

from collections.abc import Sequence

import gtsam
import numpy as np

from .arrays import Array, IntArray


def linear_factor(keys: IntArray, widths: IntArray, A: Array, b: Array) -> gtsam.GaussianConditional:
    """Build the factor `1/2 |A x - b|^2` on any number of keys (k,), with whitened A (m, n) and b (m,).

    The constructors of GTSAM's binding take at most three keys. A Gaussian conditional has no such limit, and
    is a Jacobian factor.
    """
    if len(A) != len(b):
        raise ValueError(f"expected a matrix of {len(b)} rows, found {A.shape}")
    return conditional_of(keys, widths, 1, np.concatenate([A, b[:, None]], axis=1))


def keys_of_factor(factor: gtsam.GaussianFactor | gtsam.NonlinearFactor) -> IntArray:
    """Return the keys (k,) of a factor in its own order."""
    return np.array(list(factor.keys()), np.intp)


def jacobian_matrix(factor: gtsam.JacobianFactor) -> Array:
    """Return `[A b]` (m, n + 1) of a factor or a conditional; ValueError where it has a noise model."""
    if factor.get_model() is not None:
        raise ValueError(f"expected whitened rows, found a {type(factor.get_model()).__name__} noise model")
    return np.array(factor.augmentedJacobian(), np.float64, order="F")


def jacobian_factor_of(keys: IntArray, widths: IntArray, matrix: Array) -> gtsam.JacobianFactor:
    """Build a factor with the rows `[A b]` (m, n + 1) on keys (k,) of variables with widths (k,)."""
    return gtsam.JacobianFactor(conditional_of(keys, widths, 1, matrix))


def frontals_of(conditional: gtsam.GaussianConditional, widths: Sequence[int]) -> int:
    """Return the number of frontal keys of a conditional, given the widths (k,) of all its variables."""
    size = conditional.R().shape[1]  # read the shape of the view only, not its entries
    return int(np.cumsum(widths).searchsorted(size)) + 1


def conditional_of(
    keys: IntArray, widths: IntArray, frontals: int, matrix: Array
) -> gtsam.GaussianConditional:
    """Build the conditional of the first `frontals` keys, with the rows `[A b]` (m, n + 1).

    ValueError if keys, widths and matrix do not match, which GTSAM does not check.
    """
    _check_keys(keys, widths)
    if not 1 <= frontals <= len(keys):
        raise ValueError(f"expected 1 to {len(keys)} frontal keys, found {frontals}")
    _check_matrix(matrix, int(widths.sum()) + 1)
    blocks = gtsam.VerticalBlockMatrix([*widths.tolist(), 1], np.asfortranarray(matrix), False)
    return gtsam.GaussianConditional(keys.tolist(), frontals, blocks)


def hessian_matrix(factor: gtsam.HessianFactor) -> Array:
    """Return `[[H, g], [g', f]]` (n + 1, n + 1) of a factor `1/2 d' H d - g' d + f / 2`."""
    return np.array(factor.augmentedInformation(), np.float64, order="F")


def hessian_factor_of(keys: IntArray, widths: IntArray, matrix: Array) -> gtsam.HessianFactor:
    """Build a factor with `[[H, g], [g', f]]` (n + 1, n + 1) on keys (k,) of widths (k,).

    The constructors of GTSAM's binding take at most three keys, so it is the sum of one factor for each block
    of H. Blocks do not overlap: each entry is only added to zeros. ValueError if the arguments do not match.
    """
    _check_keys(keys, widths)
    size = int(widths.sum()) + 1
    _check_matrix(matrix, size)
    if len(matrix) != size:
        raise ValueError(f"expected a square matrix of {size} rows, found {len(matrix)}")
    ends = np.cumsum(widths).tolist()
    blocks = [slice(end - width, end) for end, width in zip(ends, widths.tolist(), strict=True)]
    zeros = [np.zeros((width, width)) for width in widths.tolist()]
    graph, names = gtsam.GaussianFactorGraph(), keys.tolist()
    for i, own in enumerate(blocks):
        constant = float(matrix[-1, -1]) if i == 0 else 0.0
        graph.push_back(gtsam.HessianFactor(names[i], matrix[own, own], matrix[own, -1], constant))
        for j, other in enumerate(blocks[:i]):
            pair = (names[j], names[i], zeros[j], matrix[other, own], zeros[j][0], zeros[i], zeros[i][0])
            graph.push_back(gtsam.HessianFactor(*pair, 0.0))
    return gtsam.HessianFactor(graph)


def _check_keys(keys: IntArray, widths: IntArray) -> None:
    if not 0 < len(keys) == len(widths) == len(set(keys.tolist())):
        raise ValueError(f"expected one or more different keys, a width for each, found {keys}, {widths}")


def _check_matrix(matrix: Array, columns: int) -> None:
    if matrix.ndim != 2 or matrix.shape[1] != columns or matrix.dtype != np.float64:
        raise ValueError(f"expected a matrix of {columns} columns, found {matrix.dtype} {matrix.shape}")
