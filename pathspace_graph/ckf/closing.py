"""Closes the loop of the paper's filter, and simplifies its curves (paper: Results, Simplification)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.factors.se2 import left_of
from pathspace_graph.graph.keys import POINT, POSE, pose_keys
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import BEGINNING, BEGINNING_SHARE, Motion, register
from pathspace_graph.mapping.seam import JOIN_MARGIN, JOIN_SHARE, OVERLAP_STEP, PeriodicCurve, make_periodic
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import refit

from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def associate_early_segment(
    state: CurveState, cycles: list[tuple[Array, Detections]], beginning: Array
) -> Motion | None:
    """Returns the motion that moves the newest detections onto the beginning of the curves, or None.

    cycles holds the poses (3,) and detections of the last few seconds, oldest first. beginning holds the
    poses (k, 3) of the first stretch of the drive. The result is None if the registration fails.
    """
    ckf = state.settings.ckf
    closing = replace(
        state.settings.closing,
        sigma_reading=ckf.sigma_match,
        patience=ckf.patience,
        sigma_patience=ckf.sigma_patience,
    )
    covariance = state.belief.covariance[:POSE, :POSE]
    times = [detections.t for _, detections in cycles]
    found = register(_recent(state, cycles), times, covariance, beginning, closing)
    return None if found is None else found.motion


def _recent(state: CurveState, cycles: list[tuple[Array, Detections]]) -> CurveMap:
    """Returns the curves, the newest poses and their detections as the registration takes them."""
    track = CurveMap(state.settings)
    for label in state.curves:
        track.state.add_boundary(label, state.boundary(label), state.control_points(label))
    for cycle, (pose, detections) in enumerate(cycles):
        track.variables.insert(pose_keys(np.array([cycle])), pose)
        track.detections.append(detections, cycle)
    track.detections.used[:] = True  # a filter keeps no record of what its curves explained
    return track


def update_by_correspondences(state: CurveState, motion: Motion) -> bool:
    """Makes one Kalman update: the end of each curve lies on its beginning, at the correspondences.

    `n . (S(u) - S(w)) = 0` with sigma `ckf.sigma_tie`, where u is a parameter near the end, w that of the
    point of the early segment on which the motion moves S(u), and n the normal there. Along the tangent the
    residual is the same, but all k correspondences there are one result of the registration. So each of them
    has sqrt(k) times its sigma. Returns False, and does nothing, if the end of a curve has not reached its
    beginning yet.
    """
    overlaps = {label: _overlap(state, label, motion) for label in state.curves}
    if not all(len(u) for u, _ in overlaps.values()):
        return False
    rows, columns = [], []
    for label, (u, w) in overlaps.items():
        spline = state.spline(label)
        basis = spline.basis_matrix(u) - spline.basis_matrix(w)
        tangents = spline.tangent_unit(w)
        normals = left_of(tangents)
        by_axis = [(basis[:, :, None] * axis[:, None, :]).reshape(len(u), -1) for axis in (normals, tangents)]
        rows.append(np.concatenate(by_axis))
        columns.append(state.columns(label, np.arange(spline.size)))
    matrix = block_diag(*rows)
    across, along = state.settings.ckf.sigma_tie, state.settings.closing.sigma_max
    counts = [len(r) // 2 for r in rows]
    sigma = np.concatenate([np.repeat([across, along * np.sqrt(k)], k) for k in counts])
    state.belief.update(
        np.concatenate(columns), lambda x: x @ matrix.T, np.zeros(len(matrix)), np.diag(sigma**2)
    )
    return True


def _overlap(state: CurveState, label: int, motion: Motion) -> tuple[Array, Array]:
    """Returns parameters (k,) near the end of a curve, and those (k,) of the points they are moved on."""
    spline = state.spline(label)
    high = spline.domain[1]
    u = np.arange(max(high - BEGINNING - JOIN_MARGIN, JOIN_SHARE * high), high, OVERLAP_STEP)
    moved = motion.apply(spline.evaluate(u))
    zero = np.zeros(len(u))
    beginning = min(BEGINNING, BEGINNING_SHARE * high)
    foot = state.foot_points(label, moved, zero, zero + beginning)
    on = foot.interior & (np.abs(foot.distance) < state.settings.ckf.tie_reach)
    return u[on], foot.u[on]


def simplify(state: CurveState, observed: dict[int, list[Array]]) -> None:
    """Makes both curves periodic, on curvature-weighted knots (paper: Simplification).

    observed holds the confirmed cones by label. With given knots, sampling the curve and fitting it by least
    squares is linear in the control points. So the matrix gives the mean and covariance of the cubature
    transform.
    """
    for label in state.curves:
        boundary = state.boundary(label)
        points, zero = np.array(observed[label]).reshape(-1, POINT), np.zeros(len(observed[label]))
        foot = boundary.find(state.control_points(label), points, zero, zero + boundary.confirmed_end)
        boundary.cone_parameters = np.sort(foot.u).tolist()
        periodic = make_periodic(
            boundary, state.control_points(label), state.settings, state.settings.ckf.knots
        )
        curve, matrix = periodic_refit(state.spline(label), periodic, state.settings)
        state.replace(label, curve, matrix, state.settings.spline.sigma_simplify)
        state.pose_u[label] = float(periodic.overlap.new_parameter(np.array([state.pose_u[label]]))[0])


def periodic_refit(
    spline: BSpline, periodic: PeriodicCurve, settings: MapperSettings
) -> tuple[BSpline, Array]:
    """Returns the closed curve, and the matrix (m, n) from the open curve's control points to its own."""
    degree = settings.spline.degree
    points = np.concatenate([periodic.points, periodic.points[:degree]])
    curve = BSpline(periodic.knots, points, degree, periodic=True)
    return curve, refit(spline, curve, periodic.overlap.new_parameter).new_from_old
