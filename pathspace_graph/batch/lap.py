"""The batch of the open lap: what an online mapper goes on from after its loop has closed.

Online, every measurement of the first lap is linearized while the map is still open, and the curves are
sparse. Both turn the map by several tenths of a degree. Here the same measurements are solved again as a
batch, on curves that meet the cones. The result is a marginal: what the poses that have left the window know
about the simplified map, the calibration and the oldest pose of the window.

Where no registration closes the loop, though the drive's own recurrence says that a lap is over, the batch
begins at odometry. Its result is believed by what the detections of the second lap say.
"""

import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system, linear_graph
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE, Layout, are_poses, indices, pose_keys
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.registration import by_motion, sigma_of_information
from pathspace_graph.mapping.state import SAMPLE, State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import at_level_crossing, boundaries_cross, crossings, sampled
from pathspace_graph.spline.bspline import BSpline

from .association import add_drive
from .optimizer import LOOSE_GATE, Convergence, Effort, Optimizer
from .simplification import boundary_of, own_settings, scatter_of_cones, simplified
from .start import Recurrence, aligned_odometry, start_odometry
from .system import BatchSystem, Biweight, Evaluation, curve_gauge

USED_AGAIN: Final = 0.85  # least share of the detections used after the first lap, over that of the first lap
MISFIT: Final = 1.5  # most root mean square distance of detections after the first lap (sigmas)
GAP: Final = 25.0  # longest stretch of a boundary without detections on it (m)
OVERLAP: Final = 15.0  # least length that has been driven again (m)
SIGMA: Final = 0.3
"""Largest standard deviation by which later laps' detections hold their drive beside the curves (m)."""
WIDER: Final = 2.5  # most ratio of a boundary point's distance from the drive to the drive's beside it
MOST_BENT: Final = 4.0  # most distance of an optimum's poses from odometry and revisits (sigmas)
MOSTLY: Final = 95.0  # percentile of the poses' distances: the drive may begin or end off the track
FROM_MAP: Final = Effort(rough_rounds=8, rounds=20, knot_passes=1, tolerance=10.0)  # so that it is in time
FROM_ODOMETRY: Final = Effort(rounds=24, knot_passes=1, tolerance=10.0)


@dataclass(frozen=True, eq=False)
class ClosedMap:
    """A map that has just been closed, and the poses beside it."""

    splines: dict[int, BSpline]  # closed curves by label, map frame
    poses: Array  # (P, 3) poses of all cycles, map frame
    calibration: Array  # (2,) or (7,) calibration of the odometry, and of the sensor where it is estimated


@dataclass(frozen=True, eq=False)
class OpenLap:
    """Everything measured from the start to the closing cycle, and what to begin with."""

    settings: MapperSettings  # settings of the online mapper
    chain: LogOdometry  # odometry between all cycles
    detections: DetectionTable  # detections of all cycles; their associations are found anew
    first_kept: int  # the poses from this cycle on stay variables of the window
    start: ClosedMap | Recurrence  # a map, or odometry alone, where the path driven recurs after a lap


@dataclass(frozen=True, eq=False)
class LapMarginal:
    """The batch's map on few knots, and what the poses before `first_kept` know about it.

    A Gaussian of [calibration | control points, left first | pose of `first_kept`].
    """

    convergence: Convergence
    splines: dict[int, BSpline]  # simplified closed curves by label, map frame
    calibration: Array  # (2,) or (7,) calibration of odometry and sensor at the optimum
    poses: Array  # (P, 3) poses of all cycles of the lap, map frame
    first_kept: int  # cycle before whose pose all measurements are in the marginal, and no later ones
    mean: Array  # (n,) mean of the marginal
    information: Array  # (n, n) its information, the inverse of its covariance
    scatter: dict[int, Array]  # sigma (m,) of each boundary's cones about the curve at each control point (m)
    cones: dict[int, Array]  # parameters (k,) of each boundary's detected cones on its curve (m)
    seconds: float  # wall time (s)
    objection: str = ""  # what speaks against the map; empty where nothing does


def solve_lap(lap: OpenLap) -> LapMarginal | None:
    """Return the marginal of an open lap at the optimum of its batch. It uses one thread.

    The result is None where the search begins at odometry and ends at a loop that the detections are against.
    """
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        system, at, convergence = lap_optimum(lap)
        settings, detections = system.settings, system.detections
        found = evidence(at, detections, settings)
        by_shape = isinstance(lap.start, Recurrence) and not lap.start.revisits
        if by_shape and not is_true_closure(found, settings):
            return None
        few, change = simplified(at.state, detections, settings)
        information, mean = marginal_of(system, at, few, change, lap.first_kept)
        scatter = scatter_of_cones(few, detections, settings)
        return LapMarginal(
            convergence=convergence,
            splines=few.splines,
            calibration=at.state.variables.calibrations.copy(),
            poses=at.state.poses.copy(),
            first_kept=lap.first_kept,
            mean=mean,
            information=information,
            scatter={label: scatter.sigma(label, b.abscissae) for label, b in few.boundaries.items()},
            cones=scatter.places,
            seconds=time.perf_counter() - begin,
            objection=disagreement(system, at.state.poses)
            or objection(found, few.splines, at.state.poses, settings),
        )


def lap_optimum(lap: OpenLap, effort: Effort | None = None) -> tuple[BatchSystem, Evaluation, Convergence]:
    """Return the problem of a lap, its optimum on curves that meet the cones, and how it was found."""
    settings, detections, start = own_settings(lap.settings), deepcopy(lap.detections), lap.start
    system = BatchSystem(detections, lap.chain, settings, Biweight(LOOSE_GATE))
    if isinstance(start, Recurrence):
        system.revisits = start.revisits
        state = start_odometry(lap.chain, detections, settings, start)
    else:
        state = State()
        for label, spline in start.splines.items():
            state.add_boundary(label, *boundary_of(spline, settings))
        add_drive(state, start.poses, start.calibration)
    effort = effort or (FROM_ODOMETRY if isinstance(start, Recurrence) else FROM_MAP)
    return system, *Optimizer(system, effort).find(state)


def marginal_of(
    system: BatchSystem, at: Evaluation, few: State, change: Array, first_kept: int
) -> tuple[Array, Array]:
    """Return information (n, n) and mean (n,) of [calibration | few control points | oldest kept pose].

    Only factors of poses before `first_kept` are summed, linearized at the optimum, since the window has the
    others. `change` F maps the dense control points to the few. So the covariance is `T Sigma T'` with
    `T = diag(I, F, I)`, where Sigma is the inverse of the dense marginal's information.
    """
    state, variables = at.state, at.state.variables
    oldest = pose_keys(np.array([first_kept]))
    kept = Layout(np.concatenate([variables.calibration_keys, state.map_keys, oldest]))
    graph = linear_graph(rows_before(system, at, first_kept), variables)
    information, vector = eliminated_system(graph, kept)
    covariance = np.linalg.inv(information)
    T = block_diag(np.eye(len(variables.calibrations)), change, np.eye(POSE))
    here = np.concatenate([variables.calibrations, few.map_points.ravel(), state.poses[first_kept]])
    mean = here + T @ (covariance @ vector)
    covariance = T @ covariance @ T.T
    return np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)), np.float64), mean


def rows_before(system: BatchSystem, at: Evaluation, first_kept: int) -> list[Rows]:
    """Return the rows of the batch that hold a pose before `first_kept` or no pose at all."""
    state, sigma, before = at.state, system.settings.batch.sigma_slide, []
    gauges = {label: curve_gauge(state, label, sigma, first_kept) for label in state.boundaries}
    for rows in system.rows(at, gauges):
        if len(rows):
            poses = are_poses(rows.keys)
            kept = (poses & (indices(rows.keys) < first_kept)).any(axis=1) | ~poses.any(axis=1)
            before.append(rows.where(np.flatnonzero(kept)))
    return before


# --- when a loop is tried, and believed ------------------------------------------------------------------


def is_worth_trying(recurrence: Recurrence, settings: MapperSettings) -> bool:
    """Return whether the path driven says that a lap and a good part of another one have been driven."""
    closure = settings.batch.closure
    long_enough = float(recurrence.driven[-1]) >= closure.laps * recurrence.lap
    return recurrence.recurs and long_enough and recurrence.correlation >= closure.min_correlation


@dataclass(frozen=True)
class ClosureEvidence:
    """What speaks for or against a closed result."""

    closed: bool  # whether both boundaries are closed
    used: float  # share of the coloured detections of the first lap that lies on the curves
    used_again: float  # share of those after the first lap
    misfit: float  # root mean square distance of those from their curves, in sigmas
    gap: float  # longest stretch of a boundary on which no detection lies (m)
    overlap: float  # length over which the boundary that was driven less far has been driven again (m)
    sigma: float
    """Standard deviation in the worst direction by which the detections after the first lap hold their drive
    in place, beside the curves (m). It is infinite on a straight, whose stretches all agree."""


def evidence(at: Evaluation, detections: DetectionTable, settings: MapperSettings) -> ClosureEvidence:
    """Return the evidence for or against an optimum whose curves are closed."""
    state, boundaries = at.state, at.state.boundaries
    coloured = np.isin(detections.label, list(boundaries))
    second = np.ones(len(state.poses), bool)  # beside a stretch of every boundary that was driven before
    gaps, overlaps = [], []
    for label, boundary in boundaries.items():
        driven, length = state.pose_u[label] - state.pose_u[label][0], boundary.length
        second &= driven >= length
        overlaps.append(float(np.clip(driven[-1] - length, 0.0, length)))
        gaps.append(_longest_gap(at.projected[label].foot.u, length))
    again = second[detections.cycle] & coloured
    parts = [(p, again[p.rows]) for p in at.projected.values()]
    whitened = np.concatenate([np.zeros(0), *(p.whitened[chosen] for p, chosen in parts)])
    return ClosureEvidence(
        closed=set(boundaries) == set(BOUNDARIES) and all(b.periodic for b in boundaries.values()),
        used=_share(detections.used, coloured & ~again),
        used_again=_share(detections.used, again),
        misfit=float(np.sqrt(np.mean(whitened**2))) if len(whitened) else np.inf,
        gap=max(gaps, default=np.inf),
        overlap=min(overlaps, default=0.0),
        sigma=_sigma_of_motion([p.foot.where(chosen) for p, chosen in parts], settings.closing.sigma_reading),
    )


def is_true_closure(found: ClosureEvidence, settings: MapperSettings) -> bool:
    """Return whether the evidence is for a closed result, in every respect."""
    return (
        found.closed
        and found.used >= settings.batch.closure.used
        and found.used_again >= USED_AGAIN * found.used
        and found.misfit <= MISFIT
        and found.gap <= GAP
        and found.overlap >= OVERLAP
        and found.sigma <= SIGMA
    )


def objection(
    found: ClosureEvidence, splines: Mapping[int, BSpline], poses: Array, settings: MapperSettings
) -> str:
    """Return what speaks against a map of closed curves around the poses (P, 3) of a lap; empty for nothing.

    Both boundaries are closed. They don't cross but at level crossings, the vehicle crosses neither and has
    driven beside all of both, and the detections lie on them. Where cycles are missing the drive is not
    known, so nothing is asked of the boundaries beside a step so long that a point beside its middle would be
    too far from both poses.
    """
    if not found.closed:
        return "not both of its boundaries are closed"
    driven, by_drive = poses[:, :2], KDTree(poses[:, :2])
    if boundaries_cross(splines, SAMPLE, driven):
        return "its boundaries cross"
    for curve in (sampled(spline, SAMPLE) for spline in splines.values()):
        distance, beside = map(np.asarray, KDTree(curve).query(driven))
        aside = float(np.percentile(distance, MOSTLY))
        missing = np.flatnonzero(np.hypot(*np.diff(driven, axis=0).T) > 2.0 * WIDER * aside)
        pieces = [piece for piece in np.split(driven, missing + 1) if len(piece) > 1]
        if any(not at_level_crossing(crossings(curve, piece), driven).all() for piece in pieces):
            return "the vehicle would have crossed a boundary"
        known = np.ones(len(curve), bool)
        for first, last in zip(beside[missing], beside[missing + 1], strict=True):
            known[np.arange(first, last if last >= first else last + len(curve)) % len(curve)] = False
        wider = float(np.max(by_drive.query(curve[known])[0])) / aside
        if wider > WIDER:
            return f"a boundary would be {wider:.1f} times as far from the drive as it is beside it"
    if found.used < settings.batch.closure.used:
        return f"only {found.used:.0%} of the detections lie on its boundaries".replace("%", " %")
    return ""


def disagreement(system: BatchSystem, poses: Array) -> str:
    """Return that the poses (P, 3) of an optimum are not those of odometry and revisits; empty if they are.

    Both are estimates of one drive, so their distance is some standard deviations of the less certain one. A
    wrong optimum bends the drive to the map, by much more.
    """
    if not system.revisits:
        return ""
    sigmas = aligned_odometry(system.chain, system.revisits).disagreement(poses)
    return f"the poses are {sigmas:.1f} sigmas from the odometry" if sigmas > MOST_BENT else ""


def _longest_gap(u: Array, length: float) -> float:
    """Return the longest stretch (m) of a closed curve of a length without any of the parameters u (m,)."""
    if len(u) == 0:
        return length
    places = np.sort(np.mod(u, length))
    return float(np.diff(places, append=places[0] + length).max())


def _share(used: BoolArray, among: BoolArray) -> float:
    return float(used[among].mean()) if among.any() else 0.0


def _sigma_of_motion(feet: Sequence[FootPoints], sigma_reading: float) -> float:
    """Return the largest standard deviation (m) of a rigid motion that detections hold across curves."""
    normal = np.concatenate([np.zeros((0, 2)), *(foot.normal_unit for foot in feet)])
    point = np.concatenate([np.zeros((0, 2)), *(foot.position for foot in feet)])
    if len(point) == 0:
        return np.inf
    jacobian = by_motion(normal, point - point.mean(axis=0)) / sigma_reading
    return sigma_of_information(jacobian.T @ jacobian)
