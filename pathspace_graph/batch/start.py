"""The start of the batch: from an online run of the same log, or from odometry alone.

From odometry, the curvature of the path driven says how long a lap is. The laps are brought together by
dead reckoning, and the curves begin as those through the cones beside lap 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, next_fast_len

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import path_lengths, rotated, to_map
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import Elimination, linear_graph, owners
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, Variables, pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.constellation import (
    NEARBY,
    SeenIn,
    find_return,
    return_to_beginning,
    revisit_of,
)
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.path import MIN_LATERAL, SIDES, along_and_across
from pathspace_graph.mapping.registration import HEADING
from pathspace_graph.mapping.state import State
from pathspace_graph.run import OnlineEstimator, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import ClosingSettings
from pathspace_graph.spline.boundary import Boundary

from .association import MIN_CONES, add_drive, cluster
from .simplification import boundary_of, exact_settings, fit_through

ComplexArray = NDArray[np.complex128]

PROFILE_STEP: Final = 0.5  # step at which the path driven is sampled (m)
SMOOTHING: Final = 3.0  # length over which the curvature is averaged (m)
CORRELATION_SHARE: Final = 0.8  # least correlation of a lap's lag over the largest; it is the shortest such
RECURS: Final = 0.7  # least correlation a lap later; 0.56 at most after one of two loops, if one is wider
MIN_OVERLAP: Final = 20.0  # least length of the path after a lap (m): over less, straights agree
REFERENCE_STEP: Final = 8.0  # distance of the reference poses that every lap passes (m)
LAP_SIGMAS: Final = np.array([1.5, 1.5, 0.15])  # of a lap's pose about a reference pose (m, m, rad)
ALIGN_STEPS: Final = 8  # most Gauss-Newton steps that bring the laps together
ALIGN_TOLERANCE: Final = 1e-2  # largest move of a step at which they are together (m, rad)
INTERVAL: Final = 15.0  # least distance from one revisit to the next (m along the path)
LAP_SHARE: Final = 0.7  # least share of a lap between two passes
MAX_LATERAL: Final = 15.0  # distance from the driven path within which a boundary has detections (m)


class CurveMapper(OnlineEstimator, Protocol):
    """An online estimator with curves, with whose map the batch can begin."""

    @property
    def boundaries(self) -> dict[int, Boundary]: ...
    @property
    def corrected_poses(self) -> Array: ...
    @property
    def revisits(self) -> tuple[Revisit, ...]: ...
    def control_points(self, label: int) -> Array: ...
    def vehicle_state(self) -> VehicleState: ...


def start_online(log: Log, mapper: CurveMapper) -> tuple[State, RunResult]:
    """Return the final map of an online run with all of its poses, and the run."""
    run, state = run_online(log, mapper), State()
    for label, known in mapper.boundaries.items():
        boundary = Boundary(known.knots, known.periodic, exact_settings(known.settings), known.gauge)
        boundary.confirmed_end = known.confirmed_end
        state.add_boundary(label, boundary, mapper.control_points(label))
    corrected = mapper.corrected_poses
    poses = unwrap(np.concatenate([corrected, run.trajectory[len(corrected) :]]))
    vehicle = mapper.vehicle_state()
    calibration = np.concatenate([vehicle.calibration, vehicle.sensor])
    add_drive(state, poses, calibration, mapper.settings.batch.association)
    return state, run


def unwrap(poses: Array) -> Array:
    """Return poses (n, 3) whose headings have no jump."""
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]) if len(poses) else poses


# --- the length of a lap ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Recurrence:
    """Length of the path driven, and after which length it recurs."""

    driven: Array  # path lengths (P,) from the first pose to each pose (m)
    lap: float = np.inf  # path length of a lap (m), infinite where the path doesn't recur
    turn: float = 0.0  # change of the heading in a lap, by the odometry (rad)
    correlation: float = 0.0  # how well the curvature agrees with itself a lap later, 1 where it is the same
    revisits: tuple[Revisit, ...] = ()  # where the cones of an earlier pass were met again

    @property
    def recurs(self) -> bool:
        return bool(np.isfinite(self.lap))

    @property
    def whole_turn(self) -> float:
        """Return the whole turns nearest to the change of the heading in a lap (rad)."""
        return float(2.0 * np.pi * np.round(self.turn / (2.0 * np.pi)))


def find_recurrence(poses: Array, settings: MapperSettings) -> Recurrence:
    """Return the shortest path length after which the curvature of dead-reckoned poses (P, 3) recurs.

    From the first lag whose correlation is a large share of the best one's, the search climbs to a lag that
    is the best within `closing.radius` after it.
    """
    closing, driven = settings.closing, path_lengths(poses)
    s = np.arange(0.0, driven[-1], PROFILE_STEP)
    x, y, heading = (np.interp(s, driven, poses[:, k]) for k in range(POSE))
    first, last = int(closing.min_path / PROFILE_STEP), int(MIN_OVERLAP / PROFILE_STEP)
    lags = np.arange(first, len(s) - last)
    scores = correlations(x + 1j * y, heading, lags, closing) if len(lags) else np.zeros(0)
    if not scores.max(initial=-np.inf) >= RECURS:
        return Recurrence(driven)
    best = int(np.argmax(scores >= CORRELATION_SHARE * scores.max()))
    reach = int(closing.radius / PROFILE_STEP)
    while (step := int(np.argmax(scores[best : best + reach]))) > 0:
        best += step
    lag = int(lags[best])
    turn = float(np.median(heading[lag:] - heading[:-lag]))
    return Recurrence(driven, lag * PROFILE_STEP, turn, float(scores[best]))


def correlations(place: ComplexArray, heading: Array, lags: IntArray, settings: ClosingSettings) -> Array:
    """Return how well the curvature of a path agrees with itself each of the lags (l,) later, in samples.

    `1 - mean((a - b)^2) / (mean(a^2) + mean(b^2))`, and -inf where the path isn't back at about the same
    place and heading, by the limits of a loop closure. The places x + i y (n,) and headings (n,), which
    aren't wrapped, are `PROFILE_STEP` apart. The sums come from a Fourier transform.
    """
    half, number = max(int(0.5 * SMOOTHING / PROFILE_STEP), 1), np.arange(len(heading))
    later, before = np.minimum(number + half, len(heading) - 1), np.maximum(number - half, 0)
    curvature = ((heading[later] - heading[before]) / SMOOTHING).astype(complex)
    squares, products = _means(place - place.mean(), lags)
    _, along = _means(np.exp(1j * heading), lags)
    radius = settings.radius + settings.drift * lags * PROFILE_STEP
    back = (squares - 2.0 * products < radius**2) & (along > np.cos(HEADING))
    squares, products = _means(curvature, lags)
    agreement = 1.0 - (squares - 2.0 * products) / np.maximum(squares, np.finfo(float).tiny)
    return np.where(back, agreement, -np.inf)


def _means(values: ComplexArray, lags: IntArray) -> tuple[Array, Array]:
    """Return the means of `|v(i)|^2 + |v(i + lag)|^2` and of `Re(v(i + lag) v(i)*)` for each lag (l,)."""
    total, count = np.append(0.0, np.cumsum(np.abs(values) ** 2)), len(values) - lags
    transform = fft(values, next_fast_len(2 * len(values)))
    products = (ifft(np.abs(transform) ** 2)[lags] / count).real
    return (total[count] + total[-1] - total[lags]) / count, products


# --- from odometry ---------------------------------------------------------------------------------------


def start_odometry(
    chain: LogOdometry,
    detections: DetectionTable,
    settings: MapperSettings,
    recurrence: Recurrence | None = None,
) -> State:
    """Return poses by dead reckoning, and curves through the cones that were seen in the first lap."""
    calibration, state = np.array(settings.calibrations), State()
    poses = chain.dead_reckoned(calibration[:CALIBRATION_SIZE])
    recurrence = recurrence or find_recurrence(poses, settings)
    if recurrence.revisits:
        poses, calibration[:CALIBRATION_SIZE] = align_revisits(chain, recurrence.revisits)
    elif recurrence.recurs:
        poses, calibration[:CALIBRATION_SIZE] = align_laps(chain, recurrence)
    detections.correct(calibration[CALIBRATION_SIZE:])
    for label in BOUNDARIES:
        _begin_boundary(state, label, poses, recurrence, detections, settings)
    add_drive(state, poses, calibration, settings.batch.association)
    return state


def align_laps(chain: LogOdometry, recurrence: Recurrence) -> tuple[Array, Array]:
    """Return the poses (P, 3) and the calibration (2,) at which every lap passes the same reference poses.

    Gauss-Newton on the odometry and the residuals `(x_k - reference_k - (0, 0, turns_k)) / sigmas` of poses
    k that pass a reference pose, from the yaw-rate bias by which the heading changes by whole turns in a lap.
    The keys of the reference poses, also unknown, follow the last cycle's.
    """
    seconds = (chain.stamps[-1] - chain.stamps[0]) / (recurrence.driven[-1] / recurrence.lap)
    calibration = np.array([0.0, (recurrence.turn - recurrence.whole_turn) / seconds])
    poses, (cycles, reference, turns) = chain.dead_reckoned(calibration), lap_correspondences(recurrence)
    passed = np.unique(reference, return_index=True)[1]  # by the first pose that passes each
    references = poses[cycles[passed]] - turns[passed, None] * [0.0, 0.0, 1.0]
    poses, variables = np.concatenate([poses, references]), Variables()
    variables.insert(np.array([CALIBRATION_KEY]), calibration)
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    count = len(chain)
    keys = np.repeat(pose_keys(np.column_stack([cycles, count + reference])), POSE, axis=0)
    jacobian = np.concatenate([np.diag(1.0 / LAP_SIGMAS), np.diag(-1.0 / LAP_SIGMAS)], axis=1)
    jacobian, owner = np.tile(jacobian, (len(cycles), 1)), np.repeat(owners(cycles), POSE)
    for _ in range(ALIGN_STEPS):
        poses, calibration = variables.poses[:count], variables.calibration
        off = poses[cycles] - variables.poses[count:][reference]
        off[:, 2] -= turns
        rows = [*chain.rows(poses, calibration), Rows(keys, jacobian, (off / LAP_SIGMAS).ravel(), owner)]
        step = Elimination(linear_graph(rows, variables), variables.layout).step(np.zeros(CALIBRATION_SIZE))
        variables.values = variables.values + step
        if np.abs(step).max() < ALIGN_TOLERANCE:
            break
    return variables.poses[:count], variables.calibration


@dataclass(frozen=True, eq=False)
class AlignedOdometry:
    """The optimum of odometry and revisits: what is known of a drive without any curve."""

    poses: Array  # (P, 3) poses of all cycles
    calibration: Array  # (2,) calibration of the odometry
    covariances: Array  # (P, 3, 3) marginal covariance of each pose

    def disagreement(self, poses: Array) -> float:
        """Return the root mean square distance of poses (P, 3) from these, in standard deviations."""
        off = poses - self.poses
        square = np.einsum("ki,ki->k", off, np.linalg.solve(self.covariances, off[:, :, None])[:, :, 0])
        return float(np.sqrt(square.mean() / POSE))


def align_revisits(chain: LogOdometry, revisits: Sequence[Revisit]) -> tuple[Array, Array]:
    """Return the poses (P, 3) and the calibration (2,) at the optimum of odometry and revisits."""
    variables = _aligned(chain, revisits)
    return variables.poses, variables.calibration


def aligned_odometry(chain: LogOdometry, revisits: Sequence[Revisit]) -> AlignedOdometry:
    """Return the optimum of odometry and revisits, with the marginal covariances of its poses."""
    variables = _aligned(chain, revisits)
    marginals = _system_of(chain, revisits, variables).pose_marginals
    return AlignedOdometry(variables.poses, variables.calibration, marginals)


def _aligned(chain: LogOdometry, revisits: Sequence[Revisit]) -> Variables:
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), chain.calibration_mean)
    poses = chain.dead_reckoned(chain.calibration_mean)
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    for _ in range(ALIGN_STEPS):
        step = _system_of(chain, revisits, variables).step(np.zeros(CALIBRATION_SIZE))
        variables.values = variables.values + step
        if np.abs(step).max() < ALIGN_TOLERANCE:
            break
    return variables


def _system_of(chain: LogOdometry, revisits: Sequence[Revisit], variables: Variables) -> Elimination:
    poses = variables.poses
    rows = [*chain.rows(poses, variables.calibration), *(one.rows(poses) for one in revisits)]
    return Elimination(linear_graph(rows, variables), variables.layout)


def find_revisits(chain: LogOdometry, table: DetectionColumns, settings: MapperSettings) -> Recurrence:
    """Return the recurrence of a whole drive by its cones: the first return to its beginning, and later ones.

    Before the first return the poses are dead reckoned, so it has to be sure. Each revisit aligns the poses,
    and the next is searched for `INTERVAL` metres later, nearby.
    """

    def seen_in(cycles: IntArray) -> DetectionColumns:
        return table.where(np.flatnonzero(table.in_cycles(cycles)))

    closing, reckoned = settings.closing, aligned_odometry(chain, ())
    poses = reckoned.poses
    driven, revisits, due, lap = path_lengths(poses), list[Revisit](), closing.min_path, np.inf
    for newest in range(len(poses)):
        is_last = newest == len(poses) - 1 and driven[newest] > closing.min_path
        if driven[newest] < due and not is_last:
            continue
        so_far = poses[: newest + 1]
        if revisits:
            due = driven[newest] + INTERVAL / 3.0
            revisit = _return_again(seen_in, so_far, lap, settings)
        else:
            due = driven[newest] + closing.check_interval
            revisit = return_to_beginning(seen_in, so_far, reckoned.covariances[newest], settings)
        if revisit is None:
            continue
        if not revisits:
            lap = float(driven[newest] - driven[revisit.earlier] - revisit.local[0])
        revisits.append(revisit)
        poses, _ = align_revisits(chain, revisits)
        due = driven[newest] + INTERVAL
    return Recurrence(driven, lap, revisits=tuple(revisits))


def _return_again(seen_in: SeenIn, poses: Array, lap: float, settings: MapperSettings) -> Revisit | None:
    """Return the newest of poses (P, 3) in the frame of one a lap (m) before, once laps are aligned."""
    last = float(path_lengths(poses)[-1]) - LAP_SHARE * lap
    found = find_return(seen_in, poses, last, NEARBY, settings.growth)
    if found is None or not found[0].is_sure:
        return None
    return revisit_of(found[0], poses, found[1], len(poses) - 1)


def lap_correspondences(recurrence: Recurrence) -> tuple[IntArray, IntArray, Array]:
    """Return the cycles (k,) nearest to where each lap passes each reference pose, and its number (k,).

    The change of the heading (k,) in the whole laps before is returned, too (rad).
    """
    count = max(int(np.ceil(recurrence.lap / REFERENCE_STEP)), 1)
    places = recurrence.driven / recurrence.lap * count
    whole = np.arange(np.ceil(places[0]), np.floor(places[-1]) + 1.0)
    after = np.clip(np.searchsorted(places, whole), 1, len(places) - 1)
    nearer = np.abs(places[after - 1] - whole) < np.abs(places[after] - whole)
    cycles = np.unique(np.where(nearer, after - 1, after))
    reference = np.mod(np.round(places[cycles]).astype(np.intp), count)
    turns = recurrence.whole_turn * np.round((places[cycles] - reference) / count)
    return cycles, reference, turns


def _begin_boundary(
    state: State,
    label: int,
    poses: Array,
    recurrence: Recurrence,
    detections: DetectionTable,
    settings: MapperSettings,
) -> None:
    """Add a curve through the cones of a boundary that were seen beside the first lap, if there are enough.

    A detection whose station isn't about that of its cycle belongs to a stretch that is driven later.
    """
    first_lap, gate = recurrence.driven < recurrence.lap, settings.gate
    rows = np.flatnonzero((detections.label == label) & first_lap[detections.cycle])
    if len(rows) == 0 or first_lap.sum() < 2:
        return
    cycles, path, stations = detections.cycle[rows], poses[first_lap, :2], recurrence.driven[first_lap]
    length = float(stations[-1]) + settings.growth.reach
    if recurrence.recurs:
        length, path = recurrence.lap, np.concatenate([path, path[:1]])
        stations = np.append(stations, length)
    points = to_map(detections.point[rows], poses[cycles])
    station, lateral = along_and_across(points, path, stations)
    side, ahead = SIDES[label] * lateral, station - recurrence.driven[cycles]
    kept = (side > MIN_LATERAL) & (side < MAX_LATERAL)
    kept &= (ahead > -gate.view_behind) & (ahead < gate.view_ahead) & (station >= 0.0) & (station < length)
    covariances = rotated(detections.covariance[rows[kept]], poses[cycles[kept], 2])
    cones = cluster(points[kept], station[kept], covariances, length, recurrence.recurs, settings)
    if len(cones.u) >= MIN_CONES:
        spline = fit_through(cones.points, recurrence.recurs, settings, settings.batch.size_share)
        state.add_boundary(label, *boundary_of(spline, settings))
