"""Where the batch begins without an online run: at the odometry alone, and what recurs in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.projection import to_map

from .arrowhead import empty_arrowhead
from .batch_data import Chain
from .batch_gating import locate_poses
from .batch_knots import cluster, exact_settings, fit_through
from .batch_system import add_odometry, add_priors, calibration_information, odometry_terms
from .boundary import Boundary
from .growth import SIDES
from .labels import BOUNDARIES
from .path import along_and_across
from .readings import Readings
from .settings import MapperSettings
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


def find_recurrence(poses: Array, settings: MapperSettings) -> Recurrence:
    """The shortest way after which the curvature repeats itself, back at about the same place and heading."""
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    s = np.arange(0.0, driven[-1], PROFILE_STEP)
    if len(s) < 2:
        return Recurrence(driven, np.inf, 0.0)
    x, y, heading = (np.interp(s, driven, poses[:, k]) for k in range(POSE))
    half = max(int(0.5 * SMOOTHING / PROFILE_STEP), 1)
    later, before = np.minimum(np.arange(len(s)) + half, len(s) - 1), np.maximum(np.arange(len(s)) - half, 0)
    curvature = (heading[later] - heading[before]) / SMOOTHING
    lags = np.arange(
        int(settings.closing.min_path / PROFILE_STEP), len(s) - int(LEAST_OVERLAP / PROFILE_STEP)
    )
    scores = np.full(len(lags), -np.inf)
    for i, lag in enumerate(lags.tolist()):
        away = np.hypot(x[lag:] - x[:-lag], y[lag:] - y[:-lag])
        turned = heading[lag:] - heading[:-lag]
        off = np.abs(turned - 2.0 * np.pi * np.round(turned / (2.0 * np.pi)))
        near = settings.closing.radius + settings.closing.drift * lag * PROFILE_STEP
        if np.median(away) < near and np.median(off) < settings.closing.heading:
            first, second = curvature[:-lag], curvature[lag:]
            difference = np.mean((first - second) ** 2)
            scores[i] = 1.0 - difference / max(np.mean(first**2) + np.mean(second**2), np.finfo(float).tiny)
    if len(scores) == 0 or not scores.max(initial=-np.inf) > 0.0:
        return Recurrence(driven, np.inf, 0.0)
    good = scores >= LEAST_CORRELATION * scores.max()
    first_good = int(np.argmax(good))
    reach = int(settings.closing.radius / PROFILE_STEP)
    lag = int(lags[first_good + int(np.argmax(scores[first_good : first_good + reach]))])
    turn = float(np.median(heading[lag:] - heading[:-lag]))
    return Recurrence(driven, lag * PROFILE_STEP, turn)


def _bias(chain: Chain, recurrence: Recurrence) -> Array:
    """(2,) the calibration at which a lap turns by whole turns."""
    whole = 2.0 * np.pi * np.round(recurrence.turn / (2.0 * np.pi))
    laps = recurrence.driven[-1] / recurrence.lap
    seconds = (chain.stamps[-1] - chain.stamps[0]) / laps
    return np.array([0.0, (recurrence.turn - whole) / seconds])


def tie_laps(
    chain: Chain, recurrence: Recurrence, calibration: Array, settings: MapperSettings
) -> tuple[Array, Array]:
    """Poses (P, 3) and calibration (2,): every lap passes the same reference poses, about.

    The reference poses are unknown themselves; they are the border of the same arrowhead as the map is.
    """
    count = max(int(np.ceil(recurrence.lap / REFERENCE_STEP)), 1)
    places = recurrence.driven / recurrence.lap * count
    cycles = _nearest_cycles(places)
    reference = np.mod(np.round(places[cycles]).astype(np.intp), count)
    poses = chain.dead_reckoned(calibration)
    whole = 2.0 * np.pi * np.round(recurrence.turn / (2.0 * np.pi))
    turns = whole * np.round((places[cycles] - reference) / count)
    information = calibration_information(settings.odometry)
    border = np.zeros(POSE * count + CALIBRATION_SIZE)
    first = np.array([np.flatnonzero(reference == r)[0] for r in range(count)])
    border[: POSE * count] = (poses[cycles[first]] - turns[first, None] * [0.0, 0.0, 1.0]).ravel()
    border[-CALIBRATION_SIZE:] = calibration
    for _ in range(TIE_STEPS):
        system = empty_arrowhead(len(chain), len(border))
        add_odometry(system, *odometry_terms(chain, poses, border[-CALIBRATION_SIZE:]))
        add_priors(system, chain, poses[0], border[-CALIBRATION_SIZE:], information)
        residual = poses[cycles] - border[: POSE * count].reshape(-1, POSE)[reference]
        residual[:, 2] -= turns
        weight = TIE**-2.0
        for k in range(POSE):
            rows, columns = POSE * cycles + k, POSE * reference + k
            system.diagonal[cycles, k, k] += weight[k]
            np.add.at(system.border, (columns, columns), weight[k])
            system.coupling[rows, columns] -= weight[k]
            system.descent_poses[rows] -= weight[k] * residual[:, k]
            np.add.at(system.descent_border, columns, weight[k] * residual[:, k])
        reduced = system.reduced()
        step_poses, step_border = reduced.step(np.zeros_like(system.border))
        poses, border = poses + step_poses.reshape(-1, POSE), border + step_border
    return poses, border[-CALIBRATION_SIZE:]


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
    cycles = np.flatnonzero(recurrence.driven < recurrence.lap)
    path = poses[cycles, :2]
    stations = recurrence.driven[cycles]
    if closed:
        path, stations = np.concatenate([path, path[:1]]), np.append(stations, recurrence.lap)
    rows = np.flatnonzero((readings.label == label) & (readings.slot < len(cycles)))
    if len(rows) == 0 or len(path) < 2:
        return
    points = to_map(readings.point[rows], poses[readings.slot[rows]])
    station, lateral = along_and_across(points, path, stations)
    side = SIDES[label] * lateral
    length = recurrence.lap if closed else float(stations[-1]) + settings.growth.reach
    kept = (side > settings.growth.min_lateral) & (side < settings.growth.max_lateral)
    ahead = (
        station - recurrence.driven[readings.slot[rows]]
    )  # else it is of a stretch that comes later, or again
    kept &= (ahead > -settings.gate.view_behind) & (ahead < settings.gate.view_ahead)
    kept &= (station >= 0.0) & (station < length)
    rows, points, station = rows[kept], points[kept], station[kept]
    weight = 1.0 / np.trace(readings.covariance[rows], axis1=1, axis2=2)
    cones = cluster(points, station, weight, length, closed, settings)
    if len(cones.points) < LEAST_CONES:
        return
    spline = fit_through(cones.points, closed, settings, settings.batch.size_share)
    spline = spline if spline.periodic else spline.unclamp()
    boundary = Boundary(spline.knots, spline.periodic, exact_settings(settings.spline), settings.gauge)
    boundary.confirmed = boundary.tables.high
    state.add_boundary(label, boundary)
    state.insert(state.offset(label), spline.distinct_control_points.ravel())
