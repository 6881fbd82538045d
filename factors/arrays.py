"""Array types by dtype, and read-only arrays."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def read_only(array: Array) -> Array:
    """Make an array read-only, so that copies of an estimator can share it."""
    array.setflags(write=False)
    return array
