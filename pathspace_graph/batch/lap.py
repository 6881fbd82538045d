"""The batch of the open lap: what an online mapper goes on from after its loop has closed.

Where no registration closes the loop, though the drive says that a lap is over, the batch begins at odometry
and closes it. Its result counts only if the detections are for it.

Online, every measurement of the first lap is linearized while the map is still open, and the curves are
sparse. Both turn the map by several tenths of a degree. Here the same measurements are solved again as a
batch, on curves that meet the cones. The result is a marginal: what the poses that have left the window know
about the simplified map, the calibration and the oldest pose of the window.
"""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system, linear_graph
from pathspace_graph.graph.keys import POSE, are_poses, indices, pose_keys
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.batch import BatchSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

from .association import add_drive, associate, locate_poses
from .closure import evidence, is_true_closure, objection
from .dead_reckoning import start_odometry
from .gauge import curve_gauge
from .knots import boundary_of
from .mapper import find_optimum, own_settings
from .optimizer import Convergence, Optimizer
from .recurrence import Recurrence
from .simplification import scatter_of_cones, simplified
from .system import BatchSystem, Biweight, Evaluation

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ClosedMap:
    """Holds a map that has just been closed, and the poses beside it."""

    splines: dict[int, BSpline]
    """These are the closed curves by label, map frame."""
    poses: Array
    """(P, 3) These are the poses of all cycles, map frame."""
    calibration: Array
    """(2,) or (7,) This is the calibration of the odometry, and of the sensor where it is estimated."""


@dataclass(frozen=True, eq=False)
class OpenLap:
    """Holds everything measured from the start to the closing cycle, and what to begin with."""

    settings: MapperSettings
    """These are the settings of the online mapper."""
    chain: LogOdometry
    """This is the odometry between all cycles."""
    detections: DetectionTable
    """These are the detections of all cycles; their associations are found anew."""
    first_kept: int
    """The poses from this cycle on stay variables of the window."""
    start: ClosedMap | Recurrence
    """The search begins at a map, or at odometry alone, where the path driven recurs after a lap."""


@dataclass(frozen=True, eq=False)
class LapMarginal:
    """Holds the batch's map on few knots, and what the poses before `first_kept` know about it.

    The marginal is a Gaussian of [calibration | control points, left first | pose of `first_kept`].
    """

    convergence: Convergence
    """This is how the optimization ended."""
    splines: dict[int, BSpline]
    """These are the simplified closed curves by label, map frame."""
    calibration: Array
    """(2,) or (7,) This is the calibration of odometry and sensor at the optimum."""
    poses: Array
    """(P, 3) These are the poses of all cycles of the lap, map frame."""
    first_kept: int
    """The marginal has all measurements of the poses before this cycle, and none of later ones."""
    mean: Array
    """(n,) This is the mean of the marginal."""
    information: Array
    """(n, n) This is the information of the marginal, the inverse of its covariance."""
    scatter: dict[int, Array]
    """For each boundary, cones scatter about the curve by this sigma (m,) at each control point (m)."""
    cones: dict[int, Array]
    """For each boundary, the cones that were detected are at these parameters (k,) of its curve (m)."""
    seconds: float
    """The solution took this wall time (s)."""
    objection: str = ""
    """What speaks against the map; empty where nothing does."""


def solve_lap(lap: OpenLap) -> LapMarginal | None:
    """Returns the marginal of an open lap at the optimum of its batch. It uses one thread.

    The result is None where the search begins at odometry and ends at a loop that the detections are against.
    """
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        system, at, convergence = lap_optimum(lap)
        settings, detections = system.settings, system.detections
        found = evidence(at, detections, settings)
        if isinstance(lap.start, Recurrence) and not is_true_closure(found, settings):
            return None
        few, change = simplified(at.state, detections, settings)
        information, mean = marginal_of(system, at, few, change, lap.first_kept)
        locate_poses(few, settings.batch.association)
        associate(few, detections, settings, settings.batch.gate, strict=True)
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
            objection=objection(found, few.splines, at.state.poses, settings),
        )


def lap_optimum(lap: OpenLap) -> tuple[BatchSystem, Evaluation, Convergence]:
    """Returns the problem of a lap, its optimum on curves that meet the cones, and how it was found."""
    settings, detections = _capped(lap), deepcopy(lap.detections)
    system = BatchSystem(detections, lap.chain, settings, Biweight(settings.batch.loose_gate))
    optimizer = Optimizer(system, settings.batch)
    at, convergence = find_optimum(optimizer, _start(lap, settings), settings)
    return system, at, convergence


def _capped(lap: OpenLap) -> MapperSettings:
    """Returns the batch's settings with fewer rounds and looser tolerances, so that the result is in time."""
    settings, own = own_settings(lap.settings), lap.settings.open_lap
    known = isinstance(lap.start, ClosedMap)
    batch: BatchSettings = settings.batch
    return replace(
        settings,
        batch=replace(
            batch,
            rough_rounds=own.rough_rounds if known else batch.rough_rounds,
            max_rounds=own.rounds if known else own.rounds_from_odometry,
            knot_passes=1,
            tolerance_cost=own.tolerance * batch.tolerance_cost,
            tolerance_curve=own.tolerance * batch.tolerance_curve,
            tolerance_decrease=own.tolerance * batch.tolerance_decrease,
        ),
    )


def _start(lap: OpenLap, settings: MapperSettings) -> State:
    """Returns the closed curves of the online map with all poses beside them, or the start from odometry."""
    if isinstance(lap.start, Recurrence):
        return start_odometry(lap.chain, lap.detections, settings, lap.start)
    state = State()
    for label, spline in lap.start.splines.items():
        state.add_boundary(label, *boundary_of(spline, settings))
    add_drive(state, lap.start.poses, lap.start.calibration, settings.batch.association)
    return state


def marginal_of(
    system: BatchSystem, at: Evaluation, few: State, change: Array, first_kept: int
) -> tuple[Array, Array]:
    """Returns information (n, n) and mean (n,) of [calibration | few control points | oldest kept pose].

    Only factors of poses before `first_kept` are summed, linearized at the optimum, since the window has the
    others. `change` F maps the dense control points to the few. So the covariance is `T Sigma T'` with
    `T = diag(I, F, I)`, where Sigma is the inverse of the dense marginal's information.
    """
    state = at.state
    calibrations = state.variables.calibrations
    kept = np.concatenate(
        [state.variables.calibration_keys, state.map_keys, pose_keys(np.array([first_kept]))]
    )
    graph = linear_graph(rows_before(system, at, first_kept), state.variables)
    information, vector = eliminated_system(graph, Layout(kept))
    covariance = np.linalg.inv(information)
    shift = covariance @ vector
    T = block_diag(np.eye(len(calibrations)), change, np.eye(POSE))
    covariance = T @ covariance @ T.T
    here = np.concatenate([calibrations, few.map_points.ravel(), state.poses[first_kept]])
    return np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)), np.float64), here + T @ shift


def rows_before(system: BatchSystem, at: Evaluation, first_kept: int) -> list[Rows]:
    """Returns the rows of the batch that hold a pose before `first_kept` or no pose at all.

    The rows that hold each control point beside a pose are made anew with poses that leave, so that none of
    them is lost.
    """
    state, sigma = at.state, system.settings.batch.sigma_slide
    gauges = {label: curve_gauge(state, label, sigma, first_kept) for label in state.boundaries}
    groups = system.rows(at, gauges)
    return [rows.where(_is_before(rows.keys, first_kept)) for rows in groups if len(rows)]


def _is_before(keys: IntArray, cycle: int) -> NDArray[np.bool_]:
    """Returns whether each row's first pose is of an earlier cycle than this, or it has no pose."""
    cycles = np.where(are_poses(keys), indices(keys), -1)
    first = np.where(are_poses(keys), cycles, np.iinfo(np.intp).max).min(axis=1)
    return np.asarray((first < cycle) | ~are_poses(keys).any(axis=1))
