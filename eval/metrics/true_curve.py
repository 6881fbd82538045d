"""The true boundaries as curves, and the mapped ones as points, so that the two can be held side by side."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import MapBoundary, SplineBoundary
from pathspace_graph.laps import lap_end_indices

from .limit import driving_order

Array = NDArray[np.float64]

TRUE_STEP: Final = 0.02
"""Distance (m) between the points of a true curve: a distance of 0.1 m to it is 0.5 mm too long at most."""
MAPPED_STEP: Final = 0.1
"""Distance (m) between the points of a mapped curve that are held against it."""
ROUND_OFF: Final = 1e-9
"""A length that is a whole number of steps, but for round-off, has no step more (share of a step)."""
_OVERLAP: Final = 3
"""Cones past the seam that Akima's tangents of a closed curve look at."""
_REMEMBERED: Final = 16
"""Curves kept, since every map of a log is held against the same ones several times."""
_FEWEST: Final = 2
"""Cones that make a curve."""


@lru_cache(maxsize=_REMEMBERED)
def true_curve(truth: Truth, label: int, step: float = TRUE_STEP) -> Array:
    """(k, 2) points, m, at most `step` apart on the curve through a boundary's true cones, in driving order.

    Akima's cubic on chord lengths: it passes through every cone and, unlike a natural spline, doesn't swing
    where cones stand unevenly. Closed where the true path has come round. One cone is a point, none nothing.
    Not to be written to: the same array is given again.
    """
    cones = driving_order(truth, label)
    if len(cones) < _FEWEST:
        return cones
    closed = len(cones) > _OVERLAP and len(truth.poses) > 0 and len(lap_end_indices(truth.poses)) > 0
    around = np.concatenate([cones[-_OVERLAP:], cones, cones[: _OVERLAP + 1]]) if closed else cones
    around = around[np.append(True, np.linalg.norm(np.diff(around, axis=0), axis=1) > 0.0)]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1)))
    low, high = (along[_OVERLAP], along[-_OVERLAP - 1]) if closed else (along[0], along[-1])
    stations = np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)
    return np.asarray(Akima1DInterpolator(along, around)(stations), dtype=float)


def mapped_points(boundary: MapBoundary, step: float = MAPPED_STEP) -> Array:
    """(k, 2) points, m, equal lengths apart on a mapped curve, `step` (m) at most; or the landmarks."""
    if not isinstance(boundary, SplineBoundary):
        return boundary.points
    spline = boundary.spline
    length = spline.length()
    count = max(int(np.ceil(length / step - ROUND_OFF)), 1)
    return spline.evaluate(spline.parameters_at((np.arange(count) + 0.5) * length / count))
