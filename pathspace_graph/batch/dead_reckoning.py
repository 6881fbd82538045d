"""The start of the batch from odometry alone: dead reckoning, laps brought together, curves beside lap 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import Elimination, linear_graph, owners
from pathspace_graph.graph.keys import CALIBRATION_KEY, POSE, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Variables
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.path import MIN_LATERAL, SIDES, along_and_across
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import LapCorrespondenceSettings
from pathspace_graph.settings.mapper import MapperSettings

from .association import add_drive
from .cones import cluster
from .knots import boundary_of, fit_through
from .recurrence import Recurrence, find_recurrence

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def start_odometry(
    chain: LogOdometry,
    detections: DetectionTable,
    settings: MapperSettings,
    recurrence: Recurrence | None = None,
) -> State:
    """Returns poses by dead reckoning, and curves through the cones that were seen in the first lap.

    Where the path recurs, the drift of the odometry is taken out first: every lap passes the same places. The
    curves are closed then, and otherwise open. By default the path driven says whether it recurs.
    """
    calibration = np.array(settings.calibrations)
    poses = chain.dead_reckoned(calibration[:CALIBRATION_SIZE])
    recurrence = recurrence or find_recurrence(poses, settings)
    if recurrence.recurs:
        poses, calibration[:CALIBRATION_SIZE] = align_laps(chain, recurrence, settings.batch.laps)
    state = State()
    for label in BOUNDARIES:
        _begin_boundary(state, label, poses, recurrence, detections, settings)
    add_drive(state, poses, calibration, settings.batch.association)
    return state


# --- laps ------------------------------------------------------------------------------------------------


def align_laps(
    chain: LogOdometry, recurrence: Recurrence, settings: LapCorrespondenceSettings
) -> tuple[Array, Array]:
    """Returns the poses (P, 3) and the calibration (2,) at which every lap passes the same reference poses.

    Gauss-Newton minimizes the odometry's cost and that of the lap correspondences. The reference poses are
    unknown, too: their keys are those of cycles after the last one.
    """
    calibration, count = _bias_of_turn(chain, recurrence), len(chain)
    correspondences, poses = lap_correspondences(recurrence, settings), chain.dead_reckoned(calibration)
    poses, variables = np.concatenate([poses, correspondences.references_at(poses)]), Variables()
    variables.insert(np.array([CALIBRATION_KEY]), calibration)
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    for _ in range(settings.max_steps):
        poses, calibration = variables.poses[:count], variables.calibration
        rows = chain.rows(chain.terms(poses, calibration), poses[0], calibration)
        rows.append(correspondences.rows(poses, variables.poses[count:]))
        step = Elimination(linear_graph(rows, variables), variables.layout).step(np.zeros(CALIBRATION_SIZE))
        variables.values = variables.values + step
        if np.abs(step).max() < settings.tolerance:
            break
    return variables.poses[:count], variables.calibration


def _bias_of_turn(chain: LogOdometry, recurrence: Recurrence) -> Array:
    """Returns the calibration (2,) by whose yaw-rate bias the heading changes by whole turns in a lap."""
    laps = recurrence.driven[-1] / recurrence.lap
    seconds = (chain.stamps[-1] - chain.stamps[0]) / laps
    return np.array([0.0, (recurrence.turn - recurrence.whole_turn) / seconds])


@dataclass(frozen=True, eq=False)
class LapCorrespondences:
    """Each correspondence k is a residual `(x_k - reference_k - (0, 0, turns_k)) / sigmas`.

    It says that a pose passes a reference pose, which the other laps pass as well.
    """

    cycles: IntArray
    """Each entry (k,) is the perception cycle of the pose."""
    reference: IntArray
    """Each entry (k,) is the number of the reference pose that the pose passes."""
    turns: Array
    """Each entry (k,) is the change of the heading in the whole laps before the pose (rad)."""
    sigmas: Array
    """These are the standard deviations (3,) of a residual (m, m, rad)."""

    def references_at(self, poses: Array) -> Array:
        """Returns the reference poses (c, 3): the first of the poses (P, 3) that passes each of them."""
        first = np.unique(self.reference, return_index=True)[1]
        return poses[self.cycles[first]] - self.turns[first, None] * [0.0, 0.0, 1.0]

    def rows(self, poses: Array, references: Array) -> Rows:
        """Returns whitened rows at poses (P, 3) and reference poses (c, 3), whose keys follow the poses'."""
        off = poses[self.cycles] - references[self.reference]
        off[:, 2] -= self.turns
        keys = pose_keys(np.column_stack([self.cycles, len(poses) + self.reference]))
        jacobian = np.concatenate([np.diag(1.0 / self.sigmas), np.diag(-1.0 / self.sigmas)], axis=1)
        return Rows(
            keys=np.repeat(keys, POSE, axis=0),
            jacobian=np.tile(jacobian, (len(off), 1)),
            residual=(off / self.sigmas).ravel(),
            owner=np.repeat(owners(self.cycles), POSE),
        )


def lap_correspondences(recurrence: Recurrence, settings: LapCorrespondenceSettings) -> LapCorrespondences:
    """Returns the correspondences of the poses nearest to where each lap passes each reference pose.

    A lap has a whole number of reference poses, equally spaced by `reference_step` at most.
    """
    count = max(int(np.ceil(recurrence.lap / settings.reference_step)), 1)
    places = recurrence.driven / recurrence.lap * count
    cycles = _nearest_cycles(places)
    reference = np.mod(np.round(places[cycles]).astype(np.intp), count)
    turns = recurrence.whole_turn * np.round((places[cycles] - reference) / count)
    return LapCorrespondences(cycles, reference, turns, np.array(settings.sigmas))


def _nearest_cycles(places: Array) -> IntArray:
    """Returns the cycle nearest to each whole number that the increasing places (P,) pass."""
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
    """Adds a curve through the cones of a boundary that were seen in the first lap, if there are enough."""
    first_lap = recurrence.driven < recurrence.lap
    rows = np.flatnonzero((detections.label == label) & first_lap[detections.cycle])
    if len(rows) == 0 or first_lap.sum() < 2:
        return
    cycles = detections.cycle[rows]
    points = to_map(detections.point[rows], poses[cycles])
    station, kept, length = _beside_path(points, cycles, label, poses, recurrence, settings)
    weight = 1.0 / np.trace(detections.covariance[rows[kept]], axis1=1, axis2=2)
    cones = cluster(points[kept], station[kept], weight, length, recurrence.recurs, settings)
    if len(cones.u) < settings.batch.cones.min_count:
        return
    spline = fit_through(cones.points, recurrence.recurs, settings, settings.batch.size_share)
    state.add_boundary(label, *boundary_of(spline, settings))


def _beside_path(
    points: Array,
    cycles: IntArray,
    label: int,
    poses: Array,
    recurrence: Recurrence,
    settings: MapperSettings,
) -> tuple[Array, BoolArray, float]:
    """Returns the stations (m,) of points (m, 2) on the path of lap 1, which lie beside it, and its length.

    A point whose station isn't about that of its cycle (m,) belongs to a stretch that is driven later.
    """
    first_lap = recurrence.driven < recurrence.lap
    path, stations = poses[first_lap, :2], recurrence.driven[first_lap]
    if recurrence.recurs:
        path, stations = np.concatenate([path, path[:1]]), np.append(stations, recurrence.lap)
    station, lateral = along_and_across(points, path, stations)
    length = recurrence.lap if recurrence.recurs else float(stations[-1]) + settings.growth.reach
    side, gate = SIDES[label] * lateral, settings.gate
    kept = (side > MIN_LATERAL) & (side < settings.batch.cones.max_lateral)
    ahead = station - recurrence.driven[cycles]
    kept &= (ahead > -gate.view_behind) & (ahead < gate.view_ahead)
    return station, np.asarray(kept & (station >= 0.0) & (station < length)), length
