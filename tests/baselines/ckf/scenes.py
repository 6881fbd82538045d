"""States of the paper's filter whose curves are known: a bend, two straight rows, and two circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.baselines.ckf import HEAD, Belief, CurveState
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import CkfSettings, MapperSettings
from pathspace_graph.spline.bspline import fit_spline

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

COVARIANCE = 0.01 * np.eye(2)
"""Each detection has this covariance (m^2)."""
RADII = {LEFT: 22.0, RIGHT: 26.0}
"""The circles have these radii (m) about the origin; the drive is counterclockwise between them."""


def detections_of(points: Array, labels: IntArray | None = None, t: float = 0.0) -> Detections:
    """Returns detections (m, 2), vehicle frame, on the left by default."""
    labels = np.full(len(points), LEFT) if labels is None else labels
    return Detections(t, points, np.tile(COVARIANCE, (len(points), 1, 1)), labels)


def bend(ckf: CkfSettings | None = None, pose_variance: float = 1e-4) -> CurveState:
    """Returns the left row of a bend up to 12 m, begun at the origin."""
    belief = Belief(np.zeros(3), pose_variance * np.eye(3))
    state = CurveState(belief, MapperSettings(ckf=ckf or CkfSettings()))
    begin(state, LEFT, np.array([[4.0, 2.0], [8.0, 2.4], [12.0, 3.4]]))
    return state


def straight_rows(settings: MapperSettings | None = None) -> CurveState:
    """Returns two rows along x, 2 m beside it, from 4 m to 12 m."""
    state = CurveState(Belief(np.zeros(3), 1e-4 * np.eye(3)), settings or MapperSettings())
    for label, y in ((RIGHT, -2.0), (LEFT, 2.0)):
        begin(state, label, np.array([[4.0, y], [8.0, y], [12.0, y]]))
    return state


def begin(state: CurveState, label: int, points: Array) -> None:
    """Begins a curve at detections (k, 2), vehicle frame."""
    state.begin(label, points, np.tile(COVARIANCE, (len(points), 1, 1)))


def around(phi: Array, radius: float) -> Array:
    """Returns points (k, 2) of a circle at angles (k,)."""
    return radius * np.column_stack([np.cos(phi), np.sin(phi)])


def circles(pose: Array, shift: Array, covariance: Array) -> CurveState:
    """Returns open curves along two circles, a little more than a lap, for a vehicle at `pose` (3,).

    The last quarter of the lap is displaced by up to `shift` (2,), as drift does. The pose has the given
    covariance (3, 3), and each control point a variance of 0.04 m^2.
    """
    state = CurveState(Belief(pose, covariance), MapperSettings())
    phi = np.linspace(0.0, 2.0 * np.pi + 1.2, 140)
    drift = np.clip((phi - 1.5 * np.pi) / (0.5 * np.pi), 0.0, 1.0)[:, None] * shift
    for label, radius in sorted(RADII.items()):
        curve, _ = fit_spline(around(phi, radius) + drift, 40, periodic=False)
        state.curves[label] = curve
        state.belief.mean = np.append(state.belief.mean, curve.control_points)
        state.pose_u[label] = curve.domain[1] - 0.6 * radius
    n = len(state.belief.mean)
    joint = 0.04 * np.eye(n)
    joint[:HEAD, :HEAD] = state.belief.covariance
    state.belief.covariance = joint
    return state
