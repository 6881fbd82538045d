"""Place recognition: the newest stretch of the curves is registered with an earlier one.

After a long lap the vehicle may be anywhere along the first few hundred metres, and the detections of the
last seconds agree with any place along a straight there. The bends in the newest stretch tell the place.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of, rotations, wrap_angle
from pathspace_graph.mapping import registration
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import Motion, Sightings, by_motion, is_lost, refine
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.online import ClosingSettings

STRETCH: Final = 150.0  # length at the end of the curves that is registered (m): its bends tell the place
STRETCH_ROOM: Final = 10.0  # beyond the ends of the earlier stretch in which foot points are searched (m)
STARTS: Final = 6  # most earlier stretches, alike in their turns, that it is registered with


@dataclass(frozen=True, eq=False)
class RecognizedPlace:
    """Place where the newest stretch of the curves lies on an earlier stretch."""

    motion: Motion  # motion of the newest stretch onto the earlier one
    beside: dict[int, float]  # parameter of each boundary beside the newest pose (m), a lap or more before


def recognize(smoother: CurveSmoother) -> RecognizedPlace | None:
    """Return the earlier place of the newest stretch; None if it is not found, or the vehicle is not lost."""
    settings, track = smoother.map.settings.closing, smoother.map
    if not may_tell_place(track.state, settings):
        return None
    smoother.transform_to_origin()
    smoother.refresh()
    covariance = smoother.newest_covariance()
    return find_place(track, covariance, settings) if is_lost(covariance, settings) else None


def may_tell_place(state: State, settings: ClosingSettings) -> bool:
    """Return whether a lap lies between an earlier stretch and the newest one, and this may tell a place.

    Laid on itself, the newest stretch must hold the vehicle in every direction, as no straight does.
    """
    end = min(boundary.confirmed_end for boundary in state.boundaries.values())
    if not STRETCH < registration.BEGINNING_SHARE * end < end - STRETCH - settings.min_path:
        return False
    stretch, centre = newest_stretch(state), state.poses[-1, :2]
    rows = np.concatenate([by_motion(normals, cones - centre) for cones, normals in stretch.values()])
    rows /= settings.sigma_reading
    return registration.sigma_of_information(rows.T @ rows) <= settings.sigma_max


def find_place(track: CurveMap, covariance: Array, settings: ClosingSettings) -> RecognizedPlace | None:
    """Return the only place at which the newest stretch of the curves agrees with an earlier stretch.

    It is searched for within the `covariance` (3, 3) of the newest pose. None if no place agrees, if several
    do, or if the place along the track is uncertain.
    """
    state = track.state
    newest = {label: cones for label, (cones, _) in newest_stretch(state).items()}
    centre = state.poses[-1, :2].copy()
    # a lap away the heading turns the position on an arc, which correlations follow only for small angles
    variance = np.linalg.eigvalsh(covariance[:2, :2])[-1]
    wide = np.diag([variance, variance, covariance[2, 2]])
    prior = np.asarray(np.linalg.inv(wide * settings.prior_scale**2), np.float64)
    found: list[RecognizedPlace] = []
    for vector, low in _starts(state, prior, settings):
        place = _register(state, newest, Motion(centre, vector), low, prior, settings)
        if place is not None and all(
            np.hypot(*(place.motion.vector - other.motion.vector)[:2]) >= settings.overlap for other in found
        ):
            found.append(place)
    return found[0] if len(found) == 1 else None


def newest_stretch(state: State) -> dict[int, tuple[Array, Array]]:
    """Return the confirmed cones (k, 2) on the last `STRETCH` metres of each curve, and the normals there."""
    found = {}
    for label, boundary in state.boundaries.items():
        u, points = boundary.cone_parameters, state.control_points(label)
        chosen = u[(u > boundary.confirmed_end - STRETCH) & (u <= boundary.confirmed_end)]
        tangents = boundary.evaluate(points, chosen, 1)
        tangents /= np.hypot(tangents[:, :1], tangents[:, 1:])
        found[label] = boundary.evaluate(points, chosen), left_of(tangents)
    return found


def _starts(state: State, prior: Array, settings: ClosingSettings) -> list[tuple[Array, float]]:
    """Return motions (3,) onto earlier stretches that turn as the newest one does, most similar first.

    Each goes with the parameter at which the earlier stretch of the first boundary begins. The headings along
    both stretches are compared, after a common turn.
    """
    (label, boundary), step = next(iter(state.boundaries.items())), registration.START_STEP
    u = np.arange(boundary.confirmed_end % step, boundary.confirmed_end, step)
    points, tangents = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
    headings = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    count, last = int(STRETCH / step), int(registration.BEGINNING_SHARE * len(points))
    turns = sliding_window_view(headings[:last], count) - headings[-count:]
    places = sliding_window_view(points[:last], count, axis=0).mean(axis=2)
    turn, unlike = turns.mean(axis=1), turns.std(axis=1)
    centre, middle = state.poses[-1, :2], points[-count:].mean(axis=0)
    turned = rotations(turn) @ (middle - centre) + centre
    motions = np.column_stack([places - turned, wrap_angle(turn)])
    possible = np.einsum("ij,jk,ik->i", motions, prior, motions) < registration.START_CHI2
    best = _minima(np.where(possible, unlike, np.inf), int(settings.overlap / step))[:STARTS]
    return [(motions[i], float(step * i)) for i in best]


def _minima(values: Array, apart: int) -> list[int]:
    """Return the indices of finite values that are the least of all that are as near as `apart`."""
    padded = np.pad(values, apart, constant_values=np.inf)
    least = sliding_window_view(padded, 2 * apart + 1).min(axis=1)
    found = np.flatnonzero(np.isfinite(values) & (values == least))
    return list(found[np.argsort(values[found])])


def _register(
    state: State, newest: dict[int, Array], start: Motion, low: float, prior: Array, settings: ClosingSettings
) -> RecognizedPlace | None:
    """Return the place of the newest cones, registered from a start whose first boundary begins at `low`."""
    first, boundary = next(iter(state.boundaries.items()))
    corners = boundary.evaluate(state.control_points(first), np.array([low, low + STRETCH]))
    stretches = {label: _between(state, label, corners) for label in state.boundaries}
    points = np.concatenate([*newest.values()])
    labels = np.repeat([*newest], [len(cones) for cones in newest.values()])
    seen = Sightings.of_points(np.arange(len(points)), labels, points)
    found = refine(state, seen, start, stretches, (np.zeros(3), prior), settings)
    shares = [len(found.matches.inliers(b)[0]) / max(len(cones), 1) for b, cones in newest.items()]
    sigma = registration.sigma_of_information(found.matches.hessian)
    if min(shares) < settings.inlier_share or sigma > settings.sigma_max:
        return None
    place, beside = found.motion.apply(state.poses[-1:, :2]), {}
    for label, (begin, end) in stretches.items():
        ends = np.array([begin]), np.array([end])
        beside[label] = float(state.boundaries[label].find(state.control_points(label), place, *ends).u[0])
    return RecognizedPlace(found.motion, beside)


def _between(state: State, label: int, corners: Array) -> tuple[float, float]:
    """Return the parameters of the stretch of a boundary between two points (2, 2), and some room."""
    boundary = state.boundaries[label]
    high = np.full(len(corners), registration.BEGINNING_SHARE * boundary.confirmed_end)
    u = boundary.find(state.control_points(label), corners, np.zeros(len(corners)), high).u
    return max(float(u[0]) - STRETCH_ROOM, 0.0), float(u[1]) + STRETCH_ROOM
