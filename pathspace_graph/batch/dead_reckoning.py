"""Where the batch begins without an online run: at the odometry alone, and what recurs in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.elimination import Elimination, linear_graph, owners
from pathspace_graph.graph.keys import CALIBRATION_KEY, POSE, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Variables
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.candidates import SIDES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.measurements import Chain
from pathspace_graph.mapping.path import along_and_across
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import ClosingSettings, MapperSettings

from .association import add_drive
from .cones import cluster
from .knots import fit_through, on_knots_of

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
"""Most Gauss-Newton steps that tie the laps together."""
TIED = 1e-6
"""Laps are tied where a step moves nothing farther than this (m, rad)."""
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


def start_odometry(chain: Chain, detections: DetectionTable, settings: MapperSettings) -> State:
    """Poses by dead reckoning, laps tied together where the way repeats, and curves through lap 1's cones."""
    poses = chain.dead_reckoned(np.zeros(CALIBRATION_SIZE))
    recurrence = find_recurrence(poses, settings)
    calibration = np.zeros(CALIBRATION_SIZE)
    if np.isfinite(recurrence.lap):
        calibration = _bias(chain, recurrence)
        poses, calibration = tie_laps(chain, recurrence, calibration)
    state = State()
    for label in BOUNDARIES:
        _begin_boundary(state, label, poses, recurrence, detections, settings)
    add_drive(state, poses, calibration)
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
    """Poses that pass a reference pose, each of a lap: `(x_k - reference - turns) / TIE`."""

    cycles: IntArray
    """(k,) the poses."""
    reference: IntArray
    """(k,) the reference pose that each passes, by number."""
    turns: Array
    """(k,) what the heading has gained in whole laps, rad."""

    @property
    def begin(self) -> IntArray:
        """(c,) the first pose that passes each reference pose."""
        return np.unique(self.reference, return_index=True)[1]

    def rows(self, poses: Array, references: Array) -> Rows:
        """Whitened rows at poses (P, 3) and reference poses (c, 3), whose keys come after theirs."""
        off = poses[self.cycles] - references[self.reference]
        off[:, 2] -= self.turns
        keys = pose_keys(np.column_stack([self.cycles, len(poses) + self.reference]))
        both = np.concatenate([np.diag(1.0 / TIE), np.diag(-1.0 / TIE)], axis=1)
        return Rows(
            keys=np.repeat(keys, POSE, axis=0),
            jacobian=np.tile(both, (len(off), 1)),
            residual=(off / TIE).ravel(),
            owner=np.repeat(owners(self.cycles), POSE),
        )


def tie_laps(chain: Chain, recurrence: Recurrence, calibration: Array) -> tuple[Array, Array]:
    """Poses (P, 3) and calibration (2,): every lap passes the same reference poses, about.

    The reference poses are unknown themselves: poses of cycles past the last.
    """
    ties, poses, count = _ties(recurrence), chain.dead_reckoned(calibration), len(chain)
    references = poses[ties.cycles[ties.begin]] - ties.turns[ties.begin, None] * [0.0, 0.0, 1.0]
    poses, variables = np.concatenate([poses, references]), Variables()
    variables.insert(np.array([CALIBRATION_KEY]), calibration)
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    for _ in range(TIE_STEPS):
        poses, calibration = variables.poses[:count], variables.calibration
        rows = chain.rows(chain.terms(poses, calibration), poses[0], calibration)
        graph = linear_graph([*rows, ties.rows(poses, variables.poses[count:])], variables)
        step = Elimination(graph, variables.layout).step(np.zeros(CALIBRATION_SIZE))
        variables.values = variables.values + step
        if np.abs(step).max() < TIED:
            break
    return variables.poses[:count], variables.calibration


def _ties(recurrence: Recurrence) -> Ties:
    """A reference pose every so many metres of a lap, and the poses nearest to where it is passed."""
    count = max(int(np.ceil(recurrence.lap / REFERENCE_STEP)), 1)
    places = recurrence.driven / recurrence.lap * count
    cycles = _nearest_cycles(places)
    reference = np.mod(np.round(places[cycles]).astype(np.intp), count)
    whole = 2.0 * np.pi * np.round(recurrence.turn / (2.0 * np.pi))
    return Ties(cycles, reference, whole * np.round((places[cycles] - reference) / count))


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
    detections: DetectionTable,
    settings: MapperSettings,
) -> None:
    """A curve through what was seen of a boundary in the first lap, beside the path of that lap."""
    closed = bool(np.isfinite(recurrence.lap))
    first = recurrence.driven < recurrence.lap
    rows = np.flatnonzero((detections.label == label) & first[detections.cycle])
    if len(rows) == 0 or first.sum() < 2:
        return
    points = to_map(detections.point[rows], poses[detections.cycle[rows]])
    station, kept, length = _beside_path(points, detections.cycle[rows], label, poses, recurrence, settings)
    weight = 1.0 / np.trace(detections.covariance[rows[kept]], axis1=1, axis2=2)
    cones = cluster(points[kept], station[kept], weight, length, closed, settings)
    if len(cones.points) < LEAST_CONES:
        return
    spline = fit_through(cones.points, closed, settings, settings.batch.size_share)
    state.add_boundary(label, *on_knots_of(spline, settings))


def _beside_path(
    points: Array,
    cycles: IntArray,
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
    ahead = station - recurrence.driven[cycles]  # else it is of a stretch that comes later, or again
    kept &= (ahead > -gate.view_behind) & (ahead < gate.view_ahead)
    return station, np.asarray(kept & (station >= 0.0) & (station < length)), length
