"""The outlook: the open curves as they lead on, through tentative tracks beyond their confirmed ends.

The tentative stretch is no part of the graph. It is fitted to the tracks whenever the map is asked for, so it
can't harm the estimate, and it is taken back as soon as the tracks contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.graph.keys import POINT, POSE
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.candidates import SIDES
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.ahead import CurveAhead
from pathspace_graph.spline.boundary import Boundary, Placement, open_boundary
from pathspace_graph.spline.bspline import BSpline

from .corridor import Row, lead_on
from .growth import Growth, undisputed

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

MIN_TRACKS = 2
"""A boundary that has not begun needs at least this many tracks for a tentative curve."""


@dataclass(frozen=True, eq=False)
class Outlook:
    """Holds a boundary with its tentative stretch."""

    boundary: Boundary
    """The knots hold the tentative stretch, too."""
    known: Array
    """(n, 2) These are the control points of the confirmed curve (m, map frame)."""
    confirmed_until: float
    """The curve is confirmed up to this parameter (m)."""
    tracks: Array
    """(k, 2) The tentative stretch leads through these tracks (m, map frame)."""
    variances: Array
    """(k,) Each track has this variance in any direction (m^2), seen from the vehicle."""
    placement: Placement | None
    """Control points were placed so for the tentative stretch; None where there is none."""

    @property
    def control_points(self) -> Array:
        """Returns the control points (m, 2) in m, map frame."""
        if self.placement is None:
            return self.known.copy()
        return self.placement.place(self.known, self.tracks)

    @property
    def spline(self) -> BSpline:
        """Returns the curve."""
        return self.boundary.spline(self.control_points)

    def linear(self, vehicle: Array, sigma_bend: float) -> tuple[Array, Array]:
        """Returns A (2m, 2n + 3) and N (2m, 2m): the control points have the covariance `A Sigma A' + N`.

        Sigma is the joint covariance of the known control points and of the newest pose `vehicle` (3,), from
        which the tracks were seen. The placement is linear in both, in the tracks' own errors, and in the
        second differences, which have the standard deviation `sigma_bend` (m).
        """
        placement, eye, size = self.placement, np.eye(POINT), self.known.size
        if placement is None:
            return np.eye(size, size + POSE), np.zeros((size, size))
        kept, by_track = POINT * placement.kept, np.kron(placement.by_target, eye)
        A = np.zeros((kept + len(by_track), size + POSE))
        A[:kept, :kept] = np.eye(kept)
        A[kept:, POINT * placement.first : size] = np.kron(placement.by_known, eye)
        A[kept:, size:] = by_track @ _by_pose(self.tracks, vehicle)
        own = (placement.by_target * self.variances) @ placement.by_target.T
        own += sigma_bend**2 * placement.by_bend @ placement.by_bend.T
        N = np.zeros((len(A), len(A)))
        N[kept:, kept:] = np.kron(own, eye)
        return A, N


def joint_covariance_of(
    outlooks: Sequence[Outlook], joint: Array, vehicle: Array, sigma_bend: float
) -> tuple[Array, list[slice]]:
    """Returns the joint covariance of the control points of all curves, and the block of each curve.

    `joint` is the covariance of the known control points of all curves and, last, of the pose `vehicle` (3,).
    """
    changes, noises, blocks, begin, end = [], [], [], 0, 0
    for outlook in outlooks:
        A, N = outlook.linear(vehicle, sigma_bend)
        size = outlook.known.size
        change = np.zeros((len(A), len(joint)))
        change[:, begin : begin + size], change[:, -POSE:] = A[:, :size], A[:, size:]
        changes.append(change)
        noises.append(N)
        blocks.append(slice(end, end + len(A)))
        begin, end = begin + size, end + len(A)
    T = np.concatenate(changes)
    covariance = T @ joint @ T.T + block_diag(*noises)
    return np.asarray(0.5 * (covariance + covariance.T)), blocks


def led_rows(
    smoother: CurveSmoother, growth: Growth, path: DrivenPath
) -> tuple[dict[int, Row], dict[int, IntArray]]:
    """Returns the row of each boundary, led on through its tentative tracks, and the indices of these."""
    settings = smoother.map.settings
    tracks = {label: _tracks(smoother, growth, label) for label in BOUNDARIES}
    rows = {label: _row(smoother, growth, label, tracks[label]) for label in BOUNDARIES}
    lead_on(rows[LEFT], rows[RIGHT], path.points, settings.growth.threshold, settings.tentative)
    return rows, tracks


def curves_ahead(smoother: CurveSmoother, growth: Growth, path: DrivenPath) -> dict[int, CurveAhead]:
    """Returns each open curve from beside the vehicle on, with the tracks that lead on, for `track_ahead`.

    These are the tracks of `look_ahead`, but no curve is fitted to them, which would take most of the time.
    """
    state, settings = smoother.map.state, smoother.map.settings
    rows, tracks = led_rows(smoother, growth, path)
    curves = {}
    for label, row in rows.items():
        if label in state.boundaries:
            boundary = state.boundaries[label]
            points, beside = state.control_points(label), float(state.pose_u[label][-1])
            on = row.candidates[row.chosen]
            curves[label] = CurveAhead(boundary.tables, points, beside, boundary.confirmed_end, on)
        elif len(row.chosen) >= MIN_TRACKS:
            variances = growth.tentative[label].variances(tracks[label][row.chosen])
            outlook = _begun(settings, row, variances)
            boundary = outlook.boundary
            points = outlook.control_points
            curves[label] = CurveAhead(boundary.tables, points, 0.0, boundary.tables.high, confirmed=False)
    return curves


def look_ahead(smoother: CurveSmoother, growth: Growth, path: DrivenPath) -> dict[int, Outlook]:
    """Returns each open curve with its tentative stretch, and curves that have not begun but may."""
    state, settings = smoother.map.state, smoother.map.settings
    rows, tracks = led_rows(smoother, growth, path)
    outlooks = {}
    for label, row in rows.items():
        chosen = tracks[label][row.chosen]
        variances = growth.tentative[label].variances(chosen) + settings.tentative.sigma_cone**2
        if label in state.boundaries:
            known = state.control_points(label)
            outlooks[label] = _extended(state.boundaries[label], known, row, variances)
        elif len(chosen) >= MIN_TRACKS:
            outlooks[label] = _begun(settings, row, variances)
    return outlooks


def confirmed(smoother: CurveSmoother) -> dict[int, Outlook]:
    """Returns the curves as they are, without a tentative stretch."""
    state, none = smoother.map.state, np.zeros((0, POINT))
    return {
        label: Outlook(boundary, state.control_points(label), boundary.confirmed_end, none, np.zeros(0), None)
        for label, boundary in state.boundaries.items()
    }


def _tracks(smoother: CurveSmoother, growth: Growth, label: int) -> IntArray:
    """Returns the indices of the tracks near the vehicle that are confirmed or were seen just now.

    A track at a cone that the curve has already is left out: across an infield, the sensor sees the row of an
    earlier stretch again.
    """
    settings, tracks, t = smoother.map.settings, growth.tentative[label], smoother.times[-1]
    offset = tracks.points - smoother.variables.poses[-1, :2]
    near = np.hypot(offset[:, 0], offset[:, 1]) < settings.tentative.reach
    believed = tracks.counts >= settings.growth.sightings
    believed |= tracks.last_t > t - settings.tentative.memory
    indices = np.flatnonzero(near & believed)
    if label in smoother.map.state.boundaries:
        mapped = np.array(smoother.map.state.boundaries[label].observed).reshape(-1, POINT)
        offset = tracks.points[indices, None] - mapped
        distance = np.hypot(offset[:, :, 0], offset[:, :, 1])
        indices = indices[(distance > settings.growth.threshold).all(axis=1)]
    radius = settings.growth.merge_radius
    return indices[undisputed(smoother, label, tracks.points[indices], radius)]


def _row(smoother: CurveSmoother, growth: Growth, label: int, tracks: IntArray) -> Row:
    """Returns a boundary's row with its candidates; it begins beside the vehicle if there is no curve yet."""
    state, settings = smoother.map.state, smoother.map.settings.tentative
    candidates, side = growth.tentative[label].points[tracks], SIDES[label]
    if label not in state.boundaries:
        x, y, theta = state.poses[-1]
        ahead = np.array([np.cos(theta), np.sin(theta)])
        beside = np.array([x, y]) + side * settings.begin_lateral * np.array([-ahead[1], ahead[0]])
        return Row(side, np.array([beside - settings.tail * ahead, beside]), ahead, candidates)
    boundary, known = state.boundaries[label], state.control_points(label)
    end = boundary.confirmed_end
    steps = int(np.ceil(min(settings.tail, end) / settings.tail_step)) + 1
    u = np.linspace(max(end - settings.tail, 0.0), end, max(steps, 2))
    direction = boundary.evaluate(known, u[-1:], 1)[0]
    return Row(side, boundary.evaluate(known, u), direction / np.hypot(*direction), candidates)


def _extended(boundary: Boundary, known: Array, row: Row, variances: Array) -> Outlook:
    """Returns a curve that is extended through the tracks that its row continues through."""
    tracks, longer = row.candidates[row.chosen], copy(boundary)
    placement = None
    if len(tracks):
        u = boundary.confirmed_end + _lengths(row)
        placement = longer.extend(len(known), u)
    return Outlook(longer, known, boundary.confirmed_end, tracks, variances, placement)


def _begun(settings: MapperSettings, row: Row, variances: Array) -> Outlook:
    """Returns a curve through the tracks of a row; none of it is confirmed."""
    tracks, boundary = row.candidates[row.chosen], open_boundary(settings.spline, settings.gauge)
    u = _lengths(row)
    placement = boundary.extend(0, u - u[0])
    return Outlook(boundary, np.zeros((0, POINT)), 0.0, tracks, variances, placement)


def _lengths(row: Row) -> Array:
    """Returns the lengths (k,) in m along a row from the curve's end to the tracks that continue it."""
    new = row.line[-len(row.chosen) - 1 :]
    return np.asarray(np.cumsum(np.hypot(*np.diff(new, axis=0).T)))


def _by_pose(points: Array, vehicle: Array) -> Array:
    """Returns the derivative (2k, 3) of points (k, 2), fixed to the vehicle, by its pose (x, y, theta)."""
    offset = points - vehicle[:2]
    jacobian = np.zeros((len(points), POINT, POSE))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -offset[:, 1], offset[:, 0]
    return jacobian.reshape(-1, POSE)
