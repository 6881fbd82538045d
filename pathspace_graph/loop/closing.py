"""Loop closing and simplification (paper: Simplification) of the online mapper.

`mapping.registration.register` finds the correspondences between the newest detections and the beginning of
the curves. `apply_correspondences` moves the window there and associates the detections with the oldest
control points, `optimize_loop` solves the whole loop, and `simplify` makes the curves periodic.
"""

from __future__ import annotations

from pathspace_graph.graph.keys import control_keys
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.registration import Registration
from pathspace_graph.mapping.seam import PeriodicCurve, make_periodic


def apply_correspondences(smoother: CurveSmoother, registration: Registration) -> None:
    """Moves the window onto the beginning, and associates its inliers with the beginning."""
    smoother.reactivate(with_prior=smoother.submaps is None)
    registration.motion.move(smoother.map.state.poses)
    for label, (rows, u) in registration.matches.items():
        smoother.map.detections.take(rows, label, u)


def optimize_loop(smoother: CurveSmoother) -> None:
    """Solves the whole loop; each submap is relinearized in its own frame."""
    settings = smoother.map.settings.closing
    smoother.solve_loop(settings.iterations, settings.sigma_step)


def simplify(smoother: CurveSmoother) -> None:
    """Replaces every open curve by a periodic one of its final size, and steps to the new optimum."""
    state, settings = smoother.map.state, smoother.map.settings
    periodic = {
        label: make_periodic(boundary, state.control_points(label), settings, settings.spline.knots)
        for label, boundary in state.boundaries.items()
    }
    substitute(smoother, periodic)
    for _ in range(settings.closing.iterations):
        smoother.step(settings.closing.sigma_step)


def substitute(smoother: CurveSmoother, periodic: dict[int, PeriodicCurve]) -> None:
    """Changes the variables, `C_old = E C_new`, in the graph, the detections and the poses' parameters."""
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
