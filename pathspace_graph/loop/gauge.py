"""The gauge of a closed map: where the whole of it lies in the map frame.

Only the beginning of the drive is known in the map frame, and every later reading is relative. So what later
laps tell of the gauge comes through the shape of the map alone: the better the curves beside the start are
known, the better is the heading of all the rest. This is true of the noise of readings, which is new in every
lap. But cones lie off a curve with few control points by the same distance in each lap. The readings of many
laps bend the curve to it, and a bend of centimetres beside the start turns the whole map. So the gauge is
held after a few laps, and the shape goes on to be estimated. What cones share between laps is not averaged
out, so no more is claimed of the map than was known then.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import left_of
from pathspace_graph.mapping.curve_map import CurveSmoother

Array = NDArray[np.float64]


def hold_gauge(smoother: CurveSmoother) -> None:
    """Holds where the closed map as a whole is, across its curves."""
    state = smoother.map.state
    tangents = [state.spline(label).tangent_unit(b.abscissae) for label, b in state.boundaries.items()]
    keys, normals = state.map_keys, left_of(np.concatenate(tangents))
    order = np.argsort(keys)
    smoother.hold_gauge(keys[order], motion_across(state.map_points[order], normals[order]))


def motion_across(points: Array, normals: Array) -> Array:
    """Returns the rows C (3, 2k) by which `C dx` is the rigid motion that fits small moves dx (2k,) best.

    Points (k, 2) of a curve may slide along it, so their moves count along the normals (k, 2) only. With the
    rows N (k, 2k) of the normals and the rigid motions G it is the least squares solution `(N G)^+ N`.
    """
    count = len(points)
    across = np.zeros((count, count, 2))
    across[np.arange(count), np.arange(count)] = normals
    turn = (normals * left_of(points)).sum(axis=1)
    return np.asarray(np.linalg.pinv(np.column_stack([normals, turn])) @ across.reshape(count, -1))
