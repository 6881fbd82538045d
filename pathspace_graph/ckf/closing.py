"""Closing and simplification in the paper's filter: an early segment is met, then curves are periodic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.graph.keys import POSE, pose_keys
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import Motion, register
from pathspace_graph.mapping.seam import PeriodicCurve, make_periodic
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import refit

from .state import CurveState

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def associate_early(
    state: CurveState, cycles: list[tuple[Array, Detections]], beginning: Array
) -> Motion | None:
    """The motion that lays the newest readings on the beginning of the curves; None where they disagree.

    cycles: pose (3,) and readings of the last few seconds, oldest first; beginning: poses (k, 3) of the
    drive's first stretch.
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
    """The curves, the newest poses and their readings, as the registration takes them."""
    track = CurveMap(state.settings)
    for label in state.curves:
        track.state.add_boundary(label, state.boundary(label), state.control_points(label))
    for cycle, (pose, detections) in enumerate(cycles):
        track.variables.insert(pose_keys(np.array([cycle])), pose)
        track.detections.append(detections, cycle)
    return track


def update_by_correspondences(state: CurveState, motion: Motion) -> bool:
    """One Kalman update: the end of each curve, where the motion lays it on its beginning, is the beginning.

    `n . (S(u) - S(w)) = 0`, with u along the end, w its association on the early segment, and n the normal
    there. Along the curve the same, but that is one fact however many points say it, the registration's; so
    each of k points says it with sqrt(k) times that sigma. False, and nothing done, where the end of a curve
    hasn't reached its beginning yet.
    """
    overlaps = {label: _overlap(state, label, motion) for label in state.curves}
    if not all(len(u) for u, _ in overlaps.values()):
        return False
    rows, columns = [], []
    for label, (u, w) in overlaps.items():
        spline = state.spline(label)
        basis = spline.basis_matrix(u) - spline.basis_matrix(w)
        tangents = spline.tangent_unit(w)
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        own = [(basis[:, :, None] * axes[:, None, :]).reshape(len(u), -1) for axes in (normals, tangents)]
        rows.append(np.concatenate(own))
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
    """Parameters (k,) on the end of a curve that the motion lays on its beginning, and theirs (k,) there."""
    closing, spline = state.settings.closing, state.spline(label)
    high = spline.domain[1]
    low = max(high - closing.beginning - closing.join_margin, closing.join_share * high)
    u = np.arange(low, high, closing.overlap_step)
    moved = motion.apply(spline.evaluate(u))
    zero = np.zeros(len(u))
    foot = state.find(label, moved, zero, zero + min(closing.beginning, closing.beginning_share * high))
    on = foot.interior & (np.abs(foot.distance) < state.settings.ckf.tie_reach)
    return u[on], foot.u[on]


def simplify(state: CurveState, observed: dict[int, list[Array]]) -> None:
    """Both curves become periodic, on curvature-weighted knots (paper: Simplification).

    Sampling the curve and fitting it by least squares is linear in its control points once the knots are
    determined, so that the cubature transform's mean and covariance are those of the matrix itself.
    """
    for label in state.curves:
        boundary = state.boundary(label)
        points, zero = np.array(observed[label]).reshape(-1, 2), np.zeros(len(observed[label]))
        foot = boundary.find(state.control_points(label), points, zero, zero + boundary.confirmed_end)
        boundary.cone_parameters = np.sort(foot.u).tolist()
        periodic_curve = make_periodic(
            boundary, state.control_points(label), state.settings, state.settings.ckf.knots
        )
        curve, matrix = periodic_refit(state.spline(label), periodic_curve, state.settings)
        state.replace(label, curve, matrix, state.settings.spline.sigma_simplify)
        state.pose_u[label] = float(periodic_curve.overlap.new_parameter(np.array([state.pose_u[label]]))[0])


def periodic_refit(
    spline: BSpline, periodic_curve: PeriodicCurve, settings: MapperSettings
) -> tuple[BSpline, Array]:
    """The closed curve's knots, and the matrix (m, n) from the open curve's control points to its own."""
    degree = settings.spline.degree
    points = np.concatenate([periodic_curve.points, periodic_curve.points[:degree]])
    curve = BSpline(periodic_curve.knots, points, degree, periodic=True)
    return curve, refit(spline, curve, periodic_curve.overlap.new_parameter).new_from_old
