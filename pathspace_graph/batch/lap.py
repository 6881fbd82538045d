"""The batch of the open lap, whose result replaces the online map after loop closure.

Online, every measurement of the first lap is linearized while the map is still open, and the curves are
sparse. Both rotate the map by several tenths of a degree. The batch solves the same measurements again, on
curves that meet the cones. The result is a marginal: the information of the poses that have left the window
about the simplified map, the calibration and the oldest pose of the window.

The batch of a lap starts from odometry and the revisit that ended the lap, a repair from a map.
"""

import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import eliminated_system, linear_graph
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE, Layout, are_poses, indices, pose_keys
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline

from .association import add_drive
from .objections import evidence_against
from .optimizer import Convergence, Effort, Optimizer
from .simplification import boundary_of, map_block, own_settings, simplified
from .start import start_odometry
from .stations import StationMatches
from .system import BatchSystem, Evaluation, curve_gauge

FROM_MAP: Final = Effort(rough_rounds=8, rounds=20, tolerance=10.0)  # limited, to finish in time
FROM_ODOMETRY: Final = Effort(rounds=24, tolerance=10.0)


@dataclass(frozen=True, eq=False)
class ClosedMap:
    """A map that has just been closed, and the poses beside it."""

    splines: dict[int, BSpline]  # closed curves by label, map frame
    poses: Array  # (P, 3) poses of all cycles, map frame
    calibration: Array  # (2,) or (7,) calibration of the odometry, and of the sensor if estimated

    def state(self, settings: MapperSettings) -> State:
        """Build the initial state from the map and the poses."""
        state = State()
        for label, spline in self.splines.items():
            state.add_boundary(label, *boundary_of(spline, settings))
        add_drive(state, self.poses, self.calibration)
        return state


@dataclass(frozen=True, eq=False)
class OpenLap:
    """All measurements from the start to the closing cycle, and the start of the batch."""

    settings: MapperSettings  # settings of the online mapper
    chain: LogOdometry  # odometry between all cycles
    detections: DetectionTable  # detections of all cycles, to associate again
    first_kept: int  # first cycle whose pose stays a variable of the window
    start: ClosedMap | Revisit  # a map, or the revisit that ended the lap, for a start from odometry
    factors: tuple[Rows, ...] = ()  # the user's factors on poses, at values of zero


@dataclass(frozen=True, eq=False)
class LapMarginal:
    """The batch's map on few knots, and the information of the poses before `first_kept` about it.

    It is a Gaussian of [calibration | control points, left first | pose of `first_kept`].
    """

    convergence: Convergence
    splines: dict[int, BSpline]  # simplified closed curves by label, map frame
    calibration: Array  # (2,) or (7,) calibration of odometry and sensor at the optimum
    poses: Array  # (P, 3) poses of all cycles of the lap, map frame
    first_kept: int  # cycle that ends the marginal: it has all measurements of earlier poses, and no others
    mean: Array  # (n,) mean of the marginal
    information: Array  # (n, n) its information, the inverse of its covariance
    scatter: dict[int, Array]  # (m,) sigma of each boundary's control points by the scatter of its cones (m)
    cones: dict[int, Array]  # (k,) parameters of each boundary's detected cones on its curve (m)
    stations: dict[int, Array]
    """(2, k) parameters of stations along each curve, and sigmas of the cones along it, given the curve (m);
    empty without stations."""
    seconds: float  # wall time (s)
    objection: str = ""  # evidence against the map; empty if there is none


def solve_lap(lap: OpenLap) -> LapMarginal:
    """Compute the marginal of an open lap at the optimum of its batch, in one thread."""
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        system, at, convergence = lap_optimum(lap)
        simple = simplified(at.state, system.detections, system.settings)
        few, change, scatter = simple.state, simple.change, simple.scatter
        information, mean, dense = marginal_of(system, at, few, change, lap.first_kept)
        stations = dict[int, Array]()
        if system.matches is not None:
            stations = stations_on(few, system.matches, at.state, change, dense)
        return LapMarginal(
            convergence=convergence,
            splines=few.splines,
            calibration=at.state.variables.calibrations.copy(),
            poses=at.state.poses.copy(),
            first_kept=lap.first_kept,
            mean=mean,
            information=information,
            scatter={label: scatter.of_control_points(label, b) for label, b in few.boundaries.items()},
            cones=scatter.places,
            stations=stations,
            seconds=time.perf_counter() - begin,
            objection=evidence_against(system, at, few.splines, simple.detections),
        )


def lap_optimum(lap: OpenLap, effort: Effort | None = None) -> tuple[BatchSystem, Evaluation, Convergence]:
    """Return the problem of a lap, its optimum on curves that meet the cones, and the convergence."""
    start, settings = lap.start, own_settings(lap.settings)
    revisits = [start] if isinstance(start, Revisit) else []
    system = BatchSystem(lap.detections.copy(), lap.chain, settings, revisits, lap.factors)
    if isinstance(start, Revisit):
        state, usual = start_odometry(system), FROM_ODOMETRY
    else:
        state, usual = start.state(settings), FROM_MAP
    return system, *Optimizer(system, effort or usual).find(state)


def marginal_of(
    system: BatchSystem, at: Evaluation, few: State, change: Array, first_kept: int
) -> tuple[Array, Array, Array]:
    """Return information (n, n) and mean (n,) of [calibration | few control points | oldest kept pose].

    The third result is the covariance (d, d) of the dense control points. The marginal has the factors of
    poses before `first_kept`, linearized at the optimum; the window has the others. `change` F maps the dense
    control points to the few. So the covariance is `T Sigma T'` with `T = diag(I, F, I)`, where Sigma is the
    covariance of the dense marginal.
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
    first, last = len(variables.calibrations), len(covariance) - POSE
    dense = np.asarray(covariance[first:last, first:last], np.float64)
    covariance = T @ covariance @ T.T
    return np.asarray(np.linalg.inv(0.5 * (covariance + covariance.T)), np.float64), mean, dense


def stations_on(
    few: State, matches: StationMatches, dense: State, change: Array, covariance: Array
) -> dict[int, Array]:
    """Transfer stations of dense curves to curves with few knots: parameters and sigmas along, (2, k).

    A cone is `S_dense(u)`. Given the few control points `F c` it moves by `(B_dense(u) - B_few(u') F) dc`,
    where u' is its foot point on the curve with few knots, B the basis, and dc has the given covariance.
    """
    found = {}
    for curve in matches.stations.curves:
        label, u = curve.label, curve.u
        old, new, new_points = dense.boundaries[label], few.boundaries[label], few.control_points(label)
        foot = new.find_anywhere(new_points, old.evaluate(dense.control_points(label), u))
        block = map_block(dense, label)
        F = change[map_block(few, label), block]
        along = along_of(old, u, foot.tangent_unit) - along_of(new, foot.u, foot.tangent_unit) @ F
        variance = np.einsum("kn,kn->k", along @ covariance[block, block], along)
        found[label] = np.array([foot.u, np.sqrt(variance)])
    return found


def along_of(boundary: Boundary, u: Array, directions: Array) -> Array:
    """Derivatives (k, 2 m) of `d . S(u)` by the control points, for unit vectors d (k, 2)."""
    (basis,), span = boundary.tables.evaluate(u)
    by_control = np.zeros((len(u), boundary.size, 2))
    terms = basis[:, :, None] * directions[:, None, :]
    np.add.at(by_control, (np.arange(len(u))[:, None], boundary.columns(span)), terms)
    return by_control.reshape(len(u), -1)


def rows_before(system: BatchSystem, at: Evaluation, first_kept: int) -> list[Rows]:
    """Select the rows of the batch with a pose before `first_kept` or without a pose."""
    state, sigma, before = at.state, system.sigma_slide, []
    gauges = {label: curve_gauge(state, label, sigma, first_kept) for label in state.boundaries}
    for rows in system.rows(at, gauges):
        if len(rows):
            poses = are_poses(rows.keys)
            kept = (poses & (indices(rows.keys) < first_kept)).any(axis=1) | ~poses.any(axis=1)
            before.append(rows.where(np.flatnonzero(kept)))
    return before
