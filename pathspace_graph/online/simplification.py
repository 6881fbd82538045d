"""Simplification (paper): closed curves on fewer knots, `C_old = E C_new`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import control_keys
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.seam import PeriodicCurve, make_periodic

Array = NDArray[np.float64]


def simplify(smoother: CurveSmoother) -> None:
    """Join every curve, whose end readings already tie to its beginning, and change to the new variables."""
    state, settings = smoother.map.state, smoother.map.settings
    periodic = {
        label: make_periodic(boundary, state.control_points(label), settings, settings.spline.knots)
        for label, boundary in state.boundaries.items()
    }
    substitute(smoother, periodic)
    for _ in range(settings.closing.iterations):
        smoother.step(settings.closing.sigma_step)


def substitute(smoother: CurveSmoother, periodic: dict[int, PeriodicCurve]) -> None:
    """Closed curves for open ones, `C_old = E C_new`, in the graph, the readings and the stations."""
    state, detections = smoother.map.state, smoother.map.detections
    for label, new in periodic.items():
        old_keys, rows = state.keys(label), detections.used_on(label)
        boundary = state.boundaries[label].closed(new.knots)
        new_keys = control_keys(label, boundary.numbers)
        smoother.substitute(
            old_keys, new_keys, new.points, new.old_from_new, smoother.map.settings.spline.sigma_simplify
        )
        state.boundaries[label] = boundary
        detections.take(rows, label, new.overlap.new_parameter(detections.u[rows]))
        state.pose_u[label] = new.overlap.new_parameter(state.pose_u[label])
