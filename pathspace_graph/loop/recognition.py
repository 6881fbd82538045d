"""Place recognition: the newest stretch of the curves is registered with an earlier one.

After a long lap the vehicle may be anywhere along the first few hundred metres. The detections of the last
seconds agree with any place along a straight there. The open curves hold more: their newest stretch has the
bends of the track in it, and these are where they were a lap before.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of, wrap_angle
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import (
    BEGINNING_SHARE,
    START_CHI2,
    START_STEP,
    Motion,
    Sightings,
    by_motion,
    is_lost,
    refine,
    sigma_of_information,
)
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.online import ClosingSettings
from pathspace_graph.spline.boundary import Boundary

STRETCH: Final = 150.0
"""Length at the end of the curves that is registered with an earlier stretch (m): it holds the bends that
tell the place along the track."""
STRETCH_ROOM: Final = 10.0
"""Room beyond the ends of the earlier stretch in which foot points are searched (m)."""
STARTS: Final = 6
"""Largest number of earlier stretches, which turn as the newest does, that it is registered with."""


@dataclass(frozen=True, eq=False)
class RecognizedPlace:
    """Place where the newest stretch of the curves lies on an earlier stretch."""

    motion: Motion
    """Motion of the newest stretch onto the earlier one."""
    beside: dict[int, float]
    """Parameter of each boundary beside which the newest pose was there (m), a lap or more before."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """The cones of the newest stretch of both curves."""

    cones: dict[int, Array]
    """(k, 2) Positions of each boundary's cones in m, map frame."""
    normals: dict[int, Array]
    """(k, 2) Unit normals of the curve at them."""

    def tells_place(self, centre: Array, settings: ClosingSettings) -> bool:
        """Return whether the stretch, laid on itself, holds the vehicle at `centre` (2,) in every direction.

        A straight does not: it could as well lie farther along.
        """
        arms = {label: cones - centre for label, cones in self.cones.items()}
        rows = np.concatenate([by_motion(self.normals[b], arms[b]) for b in arms]) / settings.sigma_reading
        return sigma_of_information(rows.T @ rows) <= settings.sigma_max

    @property
    def sightings(self) -> Sightings:
        """Return the cones as the registration takes them."""
        labels = np.repeat(list(self.cones), [len(cones) for cones in self.cones.values()])
        points = np.concatenate(list(self.cones.values()))
        return Sightings.of_points(np.arange(len(points)), labels, points)


def recognize(smoother: CurveSmoother) -> RecognizedPlace | None:
    """Return the place at which the newest stretch of the curves has been before.

    The result is None where the vehicle is not lost, or its place is not found.
    """
    settings, track = smoother.map.settings.closing, smoother.map
    if not may_tell_place(track.state, settings):
        return None
    smoother.carry()
    smoother.refresh()
    covariance = smoother.newest_covariance()
    return find_place(track, covariance, settings) if is_lost(covariance, settings) else None


def may_tell_place(state: State, settings: ClosingSettings) -> bool:
    """Return whether it is worth asking for the place: the curves are long enough, and not straight."""
    if not is_long_enough(state, settings):
        return False
    return newest_stretch(state).tells_place(state.poses[-1, :2], settings)


def find_place(track: CurveMap, covariance: Array, settings: ClosingSettings) -> RecognizedPlace | None:
    """Return the only place at which the newest stretch of the curves agrees with an earlier stretch.

    The `covariance` (3, 3) of the newest pose says how far the place may be from where the vehicle believes
    to be. The result is None if no place agrees, if several do, or if the place along the track is uncertain.
    """
    state = track.state
    if not is_long_enough(state, settings):
        return None
    newest = newest_stretch(state)
    centre = state.poses[-1, :2].copy()
    prior = np.asarray(np.linalg.inv(_wide(covariance) * settings.prior_scale**2), np.float64)
    found: list[RecognizedPlace] = []
    for vector, low in _starts(state, prior, settings):
        place = _register(state, newest, Motion(centre, vector), low, prior, settings)
        if place is not None and not any(_same(place, other, settings) for other in found):
            found.append(place)
    return found[0] if len(found) == 1 else None


def _wide(covariance: Array) -> Array:
    """Return the covariance (3, 3) of a pose without correlations, as wide as its worst direction.

    A lap away the heading turns the position on an arc, which the correlations follow only for small angles.
    """
    variance = np.linalg.eigvalsh(covariance[:2, :2])[-1]
    return np.diag([variance, variance, covariance[2, 2]])


def is_long_enough(state: State, settings: ClosingSettings) -> bool:
    """Return whether the curves hold a whole lap between an earlier stretch and the newest one."""
    end = min(boundary.confirmed_end for boundary in state.boundaries.values())
    early = BEGINNING_SHARE * end
    return bool(STRETCH < early < end - STRETCH - settings.min_path)


def newest_stretch(state: State) -> Stretch:
    """Return the confirmed cones on the last `STRETCH` metres of each curve."""
    cones, normals = {}, {}
    for label, boundary in state.boundaries.items():
        u, points = np.array(boundary.cone_parameters), state.control_points(label)
        chosen = u[(u > boundary.confirmed_end - STRETCH) & (u <= boundary.confirmed_end)]
        cones[label], tangents = boundary.evaluate(points, chosen), boundary.evaluate(points, chosen, 1)
        tangents /= np.hypot(tangents[:, :1], tangents[:, 1:])
        normals[label] = left_of(tangents)
    return Stretch(cones, normals)


def _same(a: RecognizedPlace, b: RecognizedPlace, settings: ClosingSettings) -> bool:
    return bool(np.hypot(*(a.motion.vector - b.motion.vector)[:2]) < settings.overlap)


def _starts(state: State, prior: Array, settings: ClosingSettings) -> list[tuple[Array, float]]:
    """Return motions (3,) onto earlier stretches that turn as the newest one does, most similar first.

    Each goes with the parameter at which the earlier stretch of the first boundary begins. The headings along
    both stretches are compared, after a common turn.
    """
    label = next(iter(state.boundaries))
    boundary, step = state.boundaries[label], START_STEP
    points, headings = _samples(boundary, state.control_points(label), step)
    count = int(STRETCH / step)
    last = int(BEGINNING_SHARE * len(points))
    turns = np.lib.stride_tricks.sliding_window_view(headings[:last], count) - headings[-count:]
    places = np.lib.stride_tricks.sliding_window_view(points[:last], count, axis=0).mean(axis=2)
    turn, unlike = turns.mean(axis=1), turns.std(axis=1)
    centre, middle = state.poses[-1, :2], points[-count:].mean(axis=0)
    arm, c, s = middle - centre, np.cos(turn), np.sin(turn)
    turned = np.column_stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]]) + centre
    motions = np.column_stack([places - turned, wrap_angle(turn)])
    possible = np.einsum("ij,jk,ik->i", motions, prior, motions) < START_CHI2
    unlike = np.where(possible, unlike, np.inf)
    best = _minima(unlike, int(settings.overlap / step))[:STARTS]
    return [(motions[i], float(step * i)) for i in best]


def _samples(boundary: Boundary, control_points: Array, step: float) -> tuple[Array, Array]:
    """Return points (n, 2) a step apart up to the end of a curve, and the headings (n,), not wrapped."""
    u = np.arange(boundary.confirmed_end % step, boundary.confirmed_end, step)
    tangents = boundary.evaluate(control_points, u, 1)
    return boundary.evaluate(control_points, u), np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))


def _minima(values: Array, apart: int) -> list[int]:
    """Return the indices of finite values that are the least of all that are as near as `apart`."""
    padded = np.pad(values, apart, constant_values=np.inf)
    least = np.lib.stride_tricks.sliding_window_view(padded, 2 * apart + 1).min(axis=1)
    found = np.flatnonzero(np.isfinite(values) & (values == least))
    return list(found[np.argsort(values[found])])


def _register(
    state: State, newest: Stretch, start: Motion, low: float, prior: Array, settings: ClosingSettings
) -> RecognizedPlace | None:
    first = next(iter(state.boundaries))
    ends = np.array([low, low + STRETCH])
    corners = state.boundaries[first].evaluate(state.control_points(first), ends)
    stretches = {label: _beside(state, label, corners, settings) for label in state.boundaries}
    found = refine(state, newest.sightings, start, stretches, (np.zeros(3), prior), settings)
    shares = [len(found.matches.inliers(b)[0]) / max(len(cones), 1) for b, cones in newest.cones.items()]
    sigma = sigma_of_information(found.matches.hessian)
    if min(shares) < settings.inlier_share or sigma > settings.sigma_max:
        return None
    return RecognizedPlace(found.motion, _beside_newest(state, found.motion, stretches))


def _beside_newest(
    state: State, motion: Motion, stretches: dict[int, tuple[float, float]]
) -> dict[int, float]:
    """Return the parameter of each boundary's earlier stretch that the moved newest pose is beside (m)."""
    place, beside = motion.apply(state.poses[-1:, :2]), {}
    for label, (low, high) in stretches.items():
        foot = state.boundaries[label].find(
            state.control_points(label), place, np.array([low]), np.array([high])
        )
        beside[label] = float(foot.u[0])
    return beside


def _beside(state: State, label: int, corners: Array, settings: ClosingSettings) -> tuple[float, float]:
    """Return the parameters of the stretch of a boundary between two points (2, 2), and some room."""
    boundary, room = state.boundaries[label], STRETCH_ROOM
    zero = np.zeros(len(corners))
    high = zero + BEGINNING_SHARE * boundary.confirmed_end
    u = boundary.find(state.control_points(label), corners, zero, high).u
    return max(float(u[0]) - room, 0.0), float(u[1]) + room
