"""The batch of a drive so far, whose result replaces the online map where road is driven again.

Online, every measurement is linearized while the map is still open, and the curves are sparse. Both rotate
the map by several tenths of a degree. The batch solves the same measurements again, with the revisits. The
result is a marginal: the information of the poses that have left the window about the map, the calibration
and the oldest pose of the window.

A lap starts from odometry and the revisit that ended it, and is solved on curves that meet the cones. A
repair starts from a closed map. An open road keeps the curves of its map, which goes on to grow.
"""

import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import marginal_before
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline

from .objections import disagreement, evidence_against
from .optimizer import Convergence, Effort, Optimizer
from .simplification import map_block, own_settings, simplified
from .start import StartMap, start_odometry
from .stations import StationMatches
from .system import BatchSystem, Evaluation, curve_gauge

FROM_MAP: Final = Effort(rough_rounds=8, rounds=20, tolerance=10.0)  # limited, to finish in time
OPEN_SLIDE: Final = 10.0  # weak prior on the slide of an open curve's control points (m): online has one, too
FROM_ODOMETRY: Final = Effort(rounds=24, tolerance=10.0)


@dataclass(frozen=True, eq=False)
class OpenLap:
    """All measurements from the start to the newest cycle, and the start of the batch."""

    settings: MapperSettings  # settings of the online mapper
    chain: LogOdometry  # odometry between all cycles
    detections: DetectionTable  # detections of all cycles, to associate again
    first_kept: int  # first cycle whose pose stays a variable of the window
    start: StartMap | None  # None for a start from odometry, whose first revisit ended the lap
    revisits: tuple[Revisit, ...] = ()
    factors: tuple[Rows, ...] = ()  # the user's factors on poses, at values of zero


@dataclass(frozen=True, eq=False)
class LapMarginal:
    """The batch's map, and the information of the poses before `first_kept` about it.

    It is a Gaussian of [calibration | control points, left first | pose of `first_kept`].
    """

    convergence: Convergence
    splines: dict[int, BSpline]  # closed curves on few knots, or open ones on those of the start, map frame
    ends: dict[int, float]  # parameter up to which each curve is confirmed (m)
    calibration: Array  # (2,) or (7,) calibration of odometry and sensor at the optimum
    calibration_prior: tuple[Array, Array]  # means and standard deviations of the calibrations' priors in it
    poses: Array  # (P, 3) poses of all cycles, map frame
    first_kept: int  # cycle that ends the marginal: it has all measurements of earlier poses, and no others
    mean: Array  # (n,) mean of the marginal
    information: Array  # (n, n) its information, the inverse of its covariance
    scatter: dict[int, Array]
    """(m,) sigma of each closed boundary's control points by the scatter of its cones (m)."""
    cones: dict[int, Array]  # (k,) parameters of each closed boundary's detected cones on its curve (m)
    stations: dict[int, Array]
    """(2, k) parameters of stations along each closed curve, and sigmas of the cones along it, given the
    curve (m); empty without stations."""
    seconds: float  # wall time (s)
    objection: str = ""  # evidence against the map; empty if there is none

    @property
    def closed(self) -> bool:
        return any(spline.periodic for spline in self.splines.values())


def solve_lap(lap: OpenLap) -> LapMarginal:
    """Compute the marginal of a drive at the optimum of its batch, in one thread."""
    begin = time.perf_counter()
    with threadpool_limits(limits=1):
        system, at, convergence = lap_optimum(lap)
        few, change = at.state, np.eye(at.state.map_points.size)
        prior = np.array(lap.settings.calibrations), np.array(lap.settings.sigmas_calibrations)
        scatter, cones, stations = dict[int, Array](), dict[int, Array](), dict[int, Array]()
        if at.state.closed:
            simple = simplified(at.state, system.detections, system.settings)
            few, change, cones = simple.state, simple.change, simple.scatter.places
            curves = few.boundaries.items()
            scatter = {label: simple.scatter.of_control_points(label, boundary) for label, boundary in curves}
            objection = evidence_against(system, at, few.splines, simple.detections)
        else:
            objection = disagreement(system, at.state.poses, at.state.variables.calibration)
        information, mean, dense = marginal_of(system, at, few, change, lap.first_kept)
        if system.matches is not None:
            stations = stations_on(few, system.matches, at.state, change, dense)
        return LapMarginal(
            convergence=convergence,
            splines=few.splines,
            ends={label: boundary.confirmed_end for label, boundary in few.boundaries.items()},
            calibration=at.state.variables.calibrations.copy(),
            calibration_prior=prior,
            poses=at.state.poses.copy(),
            first_kept=lap.first_kept,
            mean=mean,
            information=information,
            scatter=scatter,
            cones=cones,
            stations=stations,
            seconds=time.perf_counter() - begin,
            objection=objection,
        )


def lap_optimum(lap: OpenLap, effort: Effort | None = None) -> tuple[BatchSystem, Evaluation, Convergence]:
    """Return the problem of a drive, its optimum, and the convergence.

    A lap is solved on closed curves that meet the cones, an open road on the curves of its map.
    """
    start = lap.start
    settings = lap.settings if start is not None and start.is_open else own_settings(lap.settings)
    system = BatchSystem(lap.detections.copy(), lap.chain, settings, lap.revisits, lap.factors)
    if start is None:
        return system, *Optimizer(system, effort or FROM_ODOMETRY).find(start_odometry(system))
    optimizer = Optimizer(system, effort or FROM_MAP)
    if start.is_open:
        return system, *optimizer.run(start.state(settings), settings.batch.gate, optimizer.effort.rounds)
    return system, *optimizer.find(start.state(settings))


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
    sigma = system.sigma_slide if state.closed else OPEN_SLIDE
    gauges = {label: curve_gauge(state, label, sigma, first_kept) for label in state.boundaries}
    _, information, vector = marginal_before(system.rows(at, gauges), variables, first_kept)
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
