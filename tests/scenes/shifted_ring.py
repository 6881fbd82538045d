"""A round boundary whose uncertainty is known: it may be shifted as a whole."""

from __future__ import annotations

import numpy as np

from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.spline.bspline import BSpline

SIGMA = 0.2
"""The whole boundary has this standard deviation in x and in y (m)."""


def shifted_ring(radius: float) -> SplineBoundary:
    """A ring around (0, 20) m, travelled anticlockwise, whose control points all move as one."""
    angle = 2 * np.pi * np.arange(16) / 16
    points = radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1) + [0.0, 20.0]
    together = np.tile(np.eye(2), (16, 1))
    return SplineBoundary(BSpline.periodic_from(np.arange(17.0), points), SIGMA**2 * together @ together.T)
