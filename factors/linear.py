"""GTSAM's linear factors from arrays, without loss of a bit."""

import gtsam
import numpy as np

from .arrays import Array, IntArray


def linear_factor(
    keys: IntArray, widths: IntArray, A: Array, b: Array, frontals: int = 1
) -> gtsam.GaussianConditional:
    """Build the factor `1/2 |A x - b|^2` on keys (k,) of widths (k,), with whitened A (m, n) and b (m,).

    The constructors of GTSAM's binding take at most three keys. A Gaussian conditional has no such limit, and
    is a Jacobian factor. It is the conditional of its first keys, `frontals`, where A is upper triangular in
    them. ValueError if the arguments do not match, which GTSAM does not check.
    """
    if not 0 < len(keys) == len(widths) == len(set(keys.tolist())):
        raise ValueError(f"expected one or more different keys, a width for each, found {keys}, {widths}")
    if A.shape != (len(b), widths.sum()) or A.dtype != np.float64:
        shape = f"{len(b)} rows, {widths.sum()} columns"
        raise ValueError(f"expected a matrix of {shape}, found {A.dtype} {A.shape}")
    rows = np.asfortranarray(np.concatenate([A, b[:, None]], axis=1))
    blocks = gtsam.VerticalBlockMatrix([*widths.tolist(), 1], rows, False)
    return gtsam.GaussianConditional(keys.tolist(), frontals, blocks)


def keys_of_factor(factor: gtsam.GaussianFactor | gtsam.NonlinearFactor) -> IntArray:
    """Return the keys (k,) of a factor in its own order."""
    return np.array(list(factor.keys()), np.intp)
