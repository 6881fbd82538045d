"""Where the batch begins without an online run: at the odometry alone, and what recurs in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.projection import to_map

from .arrowhead import Arrowhead, empty_arrowhead
from .batch_cones import cluster
from .batch_data import Chain
from .batch_equations import add_odometry, add_priors, calibration_information, odometry_terms
from .batch_gating import locate_poses
from .batch_knots import exact_settings, fit_through
from .boundary import Boundary
from .candidates import SIDES
from .labels import BOUNDARIES
from .path import along_and_across
from .readings import Readings
from .settings import ClosingSettings, MapperSettings
from .state import State
from .window import POSE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

PROFILE_STEP = 0.5
"""Step (m) of the curvature profile along the way driven."""
SMOOTHING = 3.0
"""Length (m) over which its curvature is averaged."""
LEAST_CORRELATION = 0.8
"""Correlation of the profile with itself a lap later, as a share of the best of all lags."""
LEAST_OVERLAP = 5.0
"""Stretch (m) that must be driven twice to tell where a lap ends."""
REFERENCE_STEP = 8.0
"""Way (m) between the reference poses that all laps are tied to."""
TIE = np.array([1.5, 1.5, 0.15])
"""Standard deviation (m, m, rad) of a lap's poses about the reference: laps are driven differently."""
TIE_STEPS = 8
"""Gauss-Newton steps that tie the laps together."""
LEAST_CONES = 4
"""Fewest cones that a boundary is begun with."""


@dataclass(frozen=True, eq=False)
class Recurrence:
    """The way driven, and where it repeats itself."""

    driven: Array
    """(P,) way driven to each pose, m."""
    lap: float
    """Way of a lap, m; infinite where nothing repeats itself."""
    turn: float
    """What the heading gains in a lap, by the odometry (rad)."""


def start_odometry(chain: Chain, readings: Readings, settings: MapperSettings) -> State:
    """Poses by dead reckoning, laps tied together where the way repeats, and curves through lap 1's cones."""
    poses = chain.dead_reckoned(np.zeros(CALIBRATION_SIZE))
    recurrence = find_recurrence(poses, settings)
    calibration = np.zeros(CALIBRATION_SIZE)
    if np.isfinite(recurrence.lap):
        calibration = _bias(chain, recurrence)
        poses, calibration = tie_laps(chain, recurrence, calibration, settings)
    state = State()
    for label in BOUNDARIES:
        _begin_boundary(state, label, poses, recurrence, readings, settings)
    state.vector = np.concatenate([state.vector[: state.map_size], calibration, poses.ravel()])
    locate_poses(state)
    return state


# --- the lap ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Profile:
    """The way driven at equal steps along it."""

    position: Array
    """(n, 2) m."""
    heading: Array
    """(n,) rad, not wrapped."""
    curvature: Array
    """(n,) averaged over a stretch, 1/m."""

    def likeness(self, lag: int, settings: ClosingSettings) -> float:
        """Correlation of the curvature with itself `lag` steps later; -inf where that is somewhere else."""
        away = np.hypot(*(self.position[lag:] - self.position[:-lag]).T)
        turned = self.heading[lag:] - self.heading[:-lag]
        off = np.abs(turned - 2.0 * np.pi * np.round(turned / (2.0 * np.pi)))
        near = settings.radius + settings.drift * lag * PROFILE_STEP
        if np.median(away) >= near or np.median(off) >= settings.heading:
            return -np.inf
        first, second = self.curvature[:-lag], self.curvature[lag:]
        power = np.mean(first**2) + np.mean(second**2)
        return float(1.0 - np.mean((first - second) ** 2) / max(power, np.finfo(float).tiny))


def find_recurrence(poses: Array, settings: MapperSettings) -> Recurrence:
    """The shortest way after which the curvature repeats itself, back at about the same place and heading."""
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    profile = _profile(poses, driven)
    first, last = int(settings.closing.min_path / PROFILE_STEP), int(LEAST_OVERLAP / PROFILE_STEP)
    lags = np.arange(first, len(profile.heading) - last)
    scores = np.array([profile.likeness(int(lag), settings.closing) for lag in lags])
    if not scores.max(initial=-np.inf) > 0.0:
        return Recurrence(driven, np.inf, 0.0)
    begin = int(np.argmax(scores >= LEAST_CORRELATION * scores.max()))
    reach = int(settings.closing.radius / PROFILE_STEP)
    lag = int(lags[begin + int(np.argmax(scores[begin : begin + reach]))])
    turn = float(np.median(profile.heading[lag:] - profile.heading[:-lag]))
    return Recurrence(driven, lag * PROFILE_STEP, turn)


def _profile(poses: Array, driven: Array) -> Profile:
    """Poses (P, 3), so far driven (P,), at equal steps."""
    s = np.arange(0.0, driven[-1], PROFILE_STEP)
    x, y, heading = (np.interp(s, driven, poses[:, k]) for k in range(POSE))
    half, number = max(int(0.5 * SMOOTHING / PROFILE_STEP), 1), np.arange(len(s))
    later, before = np.minimum(number + half, len(s) - 1), np.maximum(number - half, 0)
    return Profile(np.column_stack([x, y]), heading, (heading[later] - heading[before]) / SMOOTHING)


def _bias(chain: Chain, recurrence: Recurrence) -> Array:
    """(2,) the calibration at which a lap turns by whole turns."""
    whole = 2.0 * np.pi * np.round(recurrence.turn / (2.0 * np.pi))
    laps = recurrence.driven[-1] / recurrence.lap
    seconds = (chain.stamps[-1] - chain.stamps[0]) / laps
    return np.array([0.0, (recurrence.turn - whole) / seconds])


@dataclass(frozen=True, eq=False)
class Ties:
    """Poses that pass a reference pose, each of a lap."""

    cycles: IntArray
    """(k,) the poses."""
    reference: IntArray
    """(k,) the reference pose that each passes."""
    turns: Array
    """(k,) what the heading has gained in whole laps, rad."""
    count: int
    """Reference poses."""

    def add_to(self, system: Arrowhead, poses: Array, border: Array) -> None:
        """`(x_k - reference) / TIE` added to normal equations whose border begins with the references."""
        residual = poses[self.cycles] - border[: POSE * self.count].reshape(-1, POSE)[self.reference]
        residual[:, 2] -= self.turns
        for k, weight in enumerate(TIE**-2.0):
            rows, columns = POSE * self.cycles + k, POSE * self.reference + k
            system.diagonal[self.cycles, k, k] += weight
            np.add.at(system.border, (columns, columns), weight)
            system.coupling[rows, columns] -= weight
            system.descent_poses[rows] -= weight * residual[:, k]
            np.add.at(system.descent_border, columns, weight * residual[:, k])


def tie_laps(
    chain: Chain, recurrence: Recurrence, calibration: Array, settings: MapperSettings
) -> tuple[Array, Array]:
    """Poses (P, 3) and calibration (2,): every lap passes the same reference poses, about.

    The reference poses are unknown themselves; they are the border of the same arrowhead as the map is.
    """
    ties, poses = _ties(recurrence), chain.dead_reckoned(calibration)
    first = np.array([np.flatnonzero(ties.reference == r)[0] for r in range(ties.count)])
    references = poses[ties.cycles[first]] - ties.turns[first, None] * [0.0, 0.0, 1.0]
    border = np.append(references.ravel(), calibration)
    information = calibration_information(settings.odometry)
    for _ in range(TIE_STEPS):
        calibration = border[-CALIBRATION_SIZE:]
        system = empty_arrowhead(len(chain), len(border))
        add_odometry(system, *odometry_terms(chain, poses, calibration))
        add_priors(system, chain, poses[0], calibration, information)
        ties.add_to(system, poses, border)
        step_poses, step_border = system.reduced().step(np.zeros_like(system.border))
        poses, border = poses + step_poses.reshape(-1, POSE), border + step_border
    return poses, border[-CALIBRATION_SIZE:]


def _ties(recurrence: Recurrence) -> Ties:
    """A reference pose every so many metres of a lap, and the poses nearest to where it is passed."""
    count = max(int(np.ceil(recurrence.lap / REFERENCE_STEP)), 1)
    places = recurrence.driven / recurrence.lap * count
    cycles = _nearest_cycles(places)
    reference = np.mod(np.round(places[cycles]).astype(np.intp), count)
    whole = 2.0 * np.pi * np.round(recurrence.turn / (2.0 * np.pi))
    return Ties(cycles, reference, whole * np.round((places[cycles] - reference) / count), count)


def _nearest_cycles(places: Array) -> IntArray:
    """The cycle nearest to each whole number that the increasing places (P,) pass."""
    whole = np.arange(np.ceil(places[0]), np.floor(places[-1]) + 1.0)
    after = np.clip(np.searchsorted(places, whole), 1, len(places) - 1)
    nearer = np.abs(places[after - 1] - whole) < np.abs(places[after] - whole)
    return np.unique(np.where(nearer, after - 1, after))


# --- curves ----------------------------------------------------------------------------------------------


def _begin_boundary(
    state: State,
    label: int,
    poses: Array,
    recurrence: Recurrence,
    readings: Readings,
    settings: MapperSettings,
) -> None:
    """A curve through what was seen of a boundary in the first lap, beside the path of that lap."""
    closed = bool(np.isfinite(recurrence.lap))
    first = recurrence.driven < recurrence.lap
    rows = np.flatnonzero((readings.label == label) & first[readings.slot])
    if len(rows) == 0 or first.sum() < 2:
        return
    points = to_map(readings.point[rows], poses[readings.slot[rows]])
    station, kept, length = _beside_path(points, readings.slot[rows], label, poses, recurrence, settings)
    weight = 1.0 / np.trace(readings.covariance[rows[kept]], axis1=1, axis2=2)
    cones = cluster(points[kept], station[kept], weight, length, closed, settings)
    if len(cones.points) < LEAST_CONES:
        return
    spline = fit_through(cones.points, closed, settings, settings.batch.size_share)
    spline = spline if spline.periodic else spline.unclamp()
    boundary = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline), settings.gauge)
    boundary.confirmed = boundary.tables.high
    state.add_boundary(label, boundary)
    state.insert(state.offset(label), spline.distinct_control_points.ravel())


def _beside_path(
    points: Array,
    slots: IntArray,
    label: int,
    poses: Array,
    recurrence: Recurrence,
    settings: MapperSettings,
) -> tuple[Array, NDArray[np.bool_], float]:
    """Stations (m,) of points (m, 2) along the first lap, which are beside it, and how far it goes (m)."""
    closed, first = bool(np.isfinite(recurrence.lap)), recurrence.driven < recurrence.lap
    path, stations = poses[first, :2], recurrence.driven[first]
    if closed:
        path, stations = np.concatenate([path, path[:1]]), np.append(stations, recurrence.lap)
    station, lateral = along_and_across(points, path, stations)
    length = recurrence.lap if closed else float(stations[-1]) + settings.growth.reach
    side, gate = SIDES[label] * lateral, settings.gate
    kept = (side > settings.growth.min_lateral) & (side < settings.growth.max_lateral)
    ahead = station - recurrence.driven[slots]  # else it is of a stretch that comes later, or again
    kept &= (ahead > -gate.view_behind) & (ahead < gate.view_ahead)
    return station, np.asarray(kept & (station >= 0.0) & (station < length)), length
