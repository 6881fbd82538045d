"""What became of the newest detections: which of them were used, and where they lie on the curves."""

from __future__ import annotations

import numpy as np

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.run import Readings


def newest_readings(smoother: CurveSmoother) -> Readings:
    """Returns the detections of the newest cycle by the estimate, and changes nothing.

    A foot point is that of the last linearization, on the curve as it is now.
    """
    table, state = smoother.map.detections, smoother.map.state
    first = int(table.cycle.searchsorted(smoother.next_cycle - 1))
    cycles, used = table.cycle[first:], table.used[first:].copy()
    points = to_map(table.point[first:], state.variables.poses_at(cycles))
    feet = np.full(points.shape, np.nan)
    for label in state.boundaries:
        on = np.flatnonzero(used & (table.boundary[first:] == label))
        if len(on):
            feet[on] = state.boundaries[label].evaluate(state.control_points(label), table.u[first:][on])
    return Readings(points, table.boundary[first:].copy(), used, feet)
