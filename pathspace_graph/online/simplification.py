"""Simplification (paper): closed curves on fewer knots, `C_old = E C_new`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import control_keys
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.seam import Join, join

Array = NDArray[np.float64]


def simplify(smoother: CurveSmoother) -> None:
    """Join every curve, whose end readings already tie to its beginning, and change to the new variables."""
    state, settings = smoother.map.state, smoother.map.settings
    joins = {
        label: join(boundary, state.control_points(label), settings, settings.spline.knots)
        for label, boundary in state.boundaries.items()
    }
    substitute(smoother, joins)
    for _ in range(settings.closing.iterations):
        smoother.step(settings.closing.sigma_step)


def substitute(smoother: CurveSmoother, joins: dict[int, Join]) -> None:
    """Closed curves for open ones, `C_old = E C_new`, in the graph, the readings and the stations."""
    state, readings = smoother.map.state, smoother.map.readings
    for label, new in joins.items():
        old_keys, rows = state.keys(label), readings.used_on(label)
        boundary = state.boundaries[label].closed(new.knots)
        new_keys = control_keys(label, boundary.numbers)
        smoother.substitute(
            old_keys, new_keys, new.points, new.old_from_new, smoother.map.settings.spline.sigma_simplify
        )
        state.boundaries[label] = boundary
        readings.take(rows, label, new.overlap.new_parameter(readings.u[rows]))
        state.stations[label] = new.overlap.new_parameter(state.stations[label])
