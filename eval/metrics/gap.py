"""The gap between two runs over one log: the online map, and the batch optimum that it is held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import wrap_angle
from pathspace_graph.io.map import MapBoundary, SplineBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import NAMES

from .table1 import interpolate_poses, root_mean_square, two_way_distance

Array = NDArray[np.float64]

CURVE_STEP = 0.02
"""Distance (m) between the points that stand for a curve."""


@dataclass(frozen=True)
class Gap:
    """How far one run is from another."""

    curves: dict[str, float]
    """m, mean distance between the two curves of each boundary that both have mapped, both ways."""
    along: float
    """m, root mean square distance of the poses along the reference's heading."""
    across: float
    """m, the same across it."""
    heading: float
    """rad, root mean square difference of the headings."""


def gap(run: RunResult, reference: RunResult) -> Gap:
    """From a run to a reference over the same log."""
    shared = sorted(set(run.map.boundaries) & set(reference.map.boundaries))
    curves = {
        NAMES[b]: two_way_distance(_points(run.map.boundaries[b]), _points(reference.map.boundaries[b]))
        for b in shared
    }
    at = interpolate_poses(reference.trajectory_t, reference.trajectory, run.trajectory_t)
    dx, dy, turn = (run.trajectory - at).T
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    along, across = c * dx + s * dy, c * dy - s * dx
    errors = (along, across, np.asarray(wrap_angle(turn)))
    return Gap(curves, *(root_mean_square(error) for error in errors))


def _points(boundary: MapBoundary) -> Array:
    """(k, 2) points on the curve, or the landmarks."""
    if not isinstance(boundary, SplineBoundary):
        return boundary.points
    spline = boundary.spline
    count = max(int(np.ceil(spline.length() / CURVE_STEP)), 1) + 1
    return spline.evaluate(np.linspace(*spline.domain, count))
