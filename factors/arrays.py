"""Array types by their numbers, and arrays that nothing writes."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def read_only(array: Array) -> Array:
    """Return an array that can't be written from now on, so that copies of an estimator share it."""
    array.setflags(write=False)
    return array
