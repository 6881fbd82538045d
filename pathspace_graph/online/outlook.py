"""The outlook: open curves extended through tentative tracks past their confirmed ends.

The tentative stretch is not in the graph: each query of the map fits it again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.front_end.sides import ConeRow, extend_rows
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.growth import newest, undisputed
from pathspace_graph.mapping.path import BEGIN_LATERAL, SIDES, DrivenPath
from pathspace_graph.mapping.tracks import Tracks, nearest_within
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary, Placement, open_boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.planning import CurveAhead

TENTATIVE_REACH: Final = 12.5  # largest distance of a track from the vehicle (m)
UNCONFIRMED_MEMORY: Final = 0.35
"""Time for which an unconfirmed track is used (s): clutter is not detected again."""
TAIL: Final = 20.0  # length of the confirmed curve that gives direction and width of the track (m)
TAIL_STEP: Final = 1.0  # step of the points along that length (m)
SIGMA_TRACK: Final = 0.1  # standard deviation of cones about a smooth curve, added to a track's own (m)
SIGMA_BEND: Final = 1.0
"""Standard deviation of the second differences of control points (m). It widens the uncertainty between
distant tracks and past the last one."""
MIN_TRACKS: Final = 2  # least number of tracks for a tentative curve of a boundary that has not begun


@dataclass(frozen=True, eq=False)
class Outlook:
    """A boundary with its tentative stretch."""

    boundary: Boundary  # knots, including the tentative stretch
    known: Array  # (n, 2) control points of the confirmed curve (m, map frame)
    confirmed_until: float  # parameter up to which the curve is confirmed (m)
    tracks: Array  # (k, 2) tracks on the tentative stretch (m, map frame)
    variances: Array  # (k,) their variances per coordinate, relative to the vehicle (m^2)
    placement: Placement | None  # placement of the control points of the tentative stretch

    @property
    def control_points(self) -> Array:
        """Return the control points (m, 2) in m, map frame."""
        if self.placement is None:
            return self.known.copy()
        return self.placement.place(self.known, self.tracks)

    @property
    def spline(self) -> BSpline:
        return self.boundary.spline(self.control_points)


def joint_covariance_of(
    outlooks: Sequence[Outlook], joint: Array, vehicle: Array
) -> tuple[Array, list[slice]]:
    """Return the joint covariance of the control points of all curves, and the block of each curve.

    `joint` is the covariance of the known control points and, last, of the pose `vehicle` (3,) that has seen
    the tracks. The placement is linear in both, in the tracks' errors, and in the second differences.
    """
    changes, noises, blocks, begin, end, eye = [], [], [], 0, 0, np.eye(POINT)
    for outlook in outlooks:
        placement, known = outlook.placement, outlook.known.size
        kept = known if placement is None else POINT * placement.kept
        size = kept if placement is None else kept + POINT * len(placement.by_target)
        change, noise = np.zeros((size, len(joint))), np.zeros((size, size))
        change[:kept, begin : begin + kept] = np.eye(kept)
        if placement is not None:
            first = begin + POINT * placement.first
            change[kept:, first : begin + known] = np.kron(placement.by_known, eye)
            by_pose = np.zeros((len(outlook.tracks), POINT, POSE))  # of tracks fixed to the vehicle
            by_pose[:, :, :POINT], by_pose[:, :, POINT] = eye, left_of(outlook.tracks - vehicle[:POINT])
            change[kept:, -POSE:] = np.kron(placement.by_target, eye) @ by_pose.reshape(-1, POSE)
            own = (placement.by_target * outlook.variances) @ placement.by_target.T
            noise[kept:, kept:] = np.kron(own + SIGMA_BEND**2 * placement.by_bend @ placement.by_bend.T, eye)
        changes.append(change)
        noises.append(noise)
        blocks.append(slice(end, end + size))
        begin, end = begin + known, end + size
    T = np.concatenate(changes)
    covariance = T @ joint @ T.T + block_diag(*noises)
    return np.asarray(0.5 * (covariance + covariance.T)), blocks


def curves_ahead(track: CurveMap, tentative: Tracks, path: DrivenPath, t: float) -> dict[int, CurveAhead]:
    """Return each open curve from the vehicle on, with the tracks past its end, for `track_ahead`.

    The tracks are those of `look_ahead`. No curve is fitted to them, which would take most of the time.
    """
    state, curves = track.state, {}
    for label, (row, chosen) in extended_rows(track, tentative, path, t).items():
        if label in state.boundaries:
            boundary = state.boundaries[label]
            points, beside = state.control_points(label), float(state.pose_u[label][-1])
            end = boundary.confirmed_end
            curves[label] = CurveAhead(boundary.tables, points, beside, end, row.cones)
        elif len(chosen) >= MIN_TRACKS:
            outlook = _begun(track.settings, row, tentative.variances(chosen))
            tables, points = outlook.boundary.tables, outlook.control_points
            curves[label] = CurveAhead(tables, points, 0.0, tables.high, confirmed=False)
    return curves


def look_ahead(track: CurveMap, tentative: Tracks, path: DrivenPath, t: float) -> dict[int, Outlook]:
    """Return each open curve with its tentative stretch at t (s), and curves with only such a stretch."""
    state, outlooks = track.state, {}
    for label, (row, chosen) in extended_rows(track, tentative, path, t).items():
        variances = tentative.variances(chosen) + SIGMA_TRACK**2
        if label in state.boundaries:
            known, longer = state.control_points(label), shallow(state.boundaries[label])
            end = longer.confirmed_end
            placement = longer.extend(len(known), end + row.lengths) if len(chosen) else None
            outlooks[label] = Outlook(longer, known, end, row.cones, variances, placement)
        elif len(chosen) >= MIN_TRACKS:
            outlooks[label] = _begun(track.settings, row, variances)
    return outlooks


def confirmed(track: CurveMap) -> dict[int, Outlook]:
    """Return the curves without a tentative stretch."""
    state, none = track.state, np.zeros((0, POINT))
    return {
        label: Outlook(boundary, state.control_points(label), boundary.confirmed_end, none, np.zeros(0), None)
        for label, boundary in state.boundaries.items()
    }


def extended_rows(
    track: CurveMap, tentative: Tracks, path: DrivenPath, t: float
) -> dict[int, tuple[ConeRow, IntArray]]:
    """Extend the row of each boundary through its tentative tracks; return it with their indices."""
    tracks = {label: _tracks(track, label, tentative, t) for label in BOUNDARIES}
    rows = {label: _row(track, label, tentative.points[tracks[label]]) for label in BOUNDARIES}
    driven = newest(path.ahead(track.state.poses[-1], 0.0)).points
    extend_rows(rows[LEFT], rows[RIGHT], driven, track.settings.growth.threshold)
    return {label: (row, tracks[label][row.chosen]) for label, row in rows.items()}


def _tracks(track: CurveMap, label: int, tracks: Tracks, t: float) -> IntArray:
    """Return the indices of tracks near the vehicle that are confirmed or were just seen.

    Tracks on the curve are left out: the sensor may see an earlier stretch across the infield.
    """
    settings, state = track.settings.growth, track.state
    near = np.hypot(*(tracks.points - state.poses[-1, :2]).T) < TENTATIVE_REACH
    count = tracks.votes[:, label]
    believed = (count >= settings.sightings) | ((count > 0) & (tracks.last_t > t - UNCONFIRMED_MEMORY))
    indices = np.flatnonzero(near & believed)
    if len(indices) == 0:
        return indices
    if label in state.boundaries:
        boundary, radius = state.boundaries[label], settings.merge_radius
        u = np.arange(0.0, boundary.confirmed_end - radius, settings.threshold)
        mapped = np.concatenate([boundary.observed, boundary.evaluate(state.control_points(label), u)])
        _, is_mapped = nearest_within(tracks.points[indices], mapped, settings.threshold)
        indices = indices[~is_mapped]
    return indices[undisputed(track, label, tracks.points[indices], settings.merge_radius)]


def _row(track: CurveMap, label: int, candidates: Array) -> ConeRow:
    """Return a boundary's row with its candidates; without a curve it begins beside the vehicle."""
    state, side = track.state, SIDES[label]
    if label not in state.boundaries:
        x, y, theta = state.poses[-1]
        ahead = np.array([np.cos(theta), np.sin(theta)])
        beside = np.array([x, y]) + side * BEGIN_LATERAL * np.array([-ahead[1], ahead[0]])
        return ConeRow(side, np.array([beside - TAIL * ahead, beside]), ahead, candidates)
    boundary, known = state.boundaries[label], state.control_points(label)
    end = boundary.confirmed_end
    steps = int(np.ceil(min(TAIL, end) / TAIL_STEP)) + 1
    u = np.linspace(max(end - TAIL, 0.0), end, max(steps, 2))
    direction = boundary.evaluate(known, u[-1:], 1)[0]
    return ConeRow(side, boundary.evaluate(known, u), direction / np.hypot(*direction), candidates)


def _begun(settings: MapperSettings, row: ConeRow, variances: Array) -> Outlook:
    """Fit an unconfirmed curve through the tracks of a row."""
    boundary, u = open_boundary(settings.spline), row.lengths
    placement = boundary.extend(0, u - u[0])
    return Outlook(boundary, np.zeros((0, POINT)), 0.0, row.cones, variances, placement)
