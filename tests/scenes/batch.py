"""Small problems of the batch: a short straight drive, and curves with poses and detections made by hand."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.association import add_drive, associate, locate_poses
from pathspace_graph.batch.lap import LapMarginal, far_first
from pathspace_graph.batch.simplification import boundary_of, own_settings
from pathspace_graph.batch.start import start_odometry
from pathspace_graph.batch.system import BatchSystem, moved
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.elimination import solution
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import CalibrationSettings, MapperSettings
from pathspace_graph.sim.vehicle import integrate
from pathspace_graph.spline.bspline import fit_spline

from .drives import DT, ahead, corridor, exact_log

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SMOOTHNESS = 20.0
"""The prior of smoothness is so weak that it doesn't reduce errors: the truth is smoother than the noise."""
COURSE = 120.0
"""This is the length of the closed course (m)."""


def straight(
    seconds: float = 6.0, smoothness: float = SMOOTHNESS, sensor: bool = True
) -> tuple[BatchSystem, State]:
    """Returns an exact drive at 6 m/s between two rows of cones at its optimum, every detection used.

    The calibration of the sensor is estimated, or is not. Residuals are squared, whatever their size.
    """
    whole = MapperSettings(calibration=CalibrationSettings(sensor=sensor))
    whole = replace(whole, batch=replace(whole.batch, sigma_smoothness=smoothness))
    whole = replace(whole, gate=replace(whole.gate, huber=np.inf))
    cones, labels = corridor(60.0)
    log = exact_log(ahead(6.0, seconds), cones, labels)
    settings = own_settings(whole)
    chain, detections = (
        judge_log(log, log.noise, settings).chain,
        DetectionTable.of(log.cycles),
    )
    detections.twist[:] = ahead(6.0, 1.0)[0]
    system = BatchSystem(detections, [chain], [settings])
    state = start_odometry(system)
    system.begin(state)
    locate_poses(state)
    associate(state, detections, settings, settings.batch.gate, True)
    system.evaluate(state, hold=True)
    return system, settled(system, state)


def settled(system: BatchSystem, state: State, steps: int = 4) -> State:
    """Returns the state after some Gauss-Newton steps."""
    for _ in range(steps):
        at = system.evaluate(state)
        system.detections.refine(at.across.rows, at.u)
        state = moved(state, solution(system.linear_graph(at), state.variables.layout))
    return state


def drawn(system: BatchSystem, rng: np.random.Generator) -> tuple[BatchSystem, Array]:
    """Returns the same drive measured with the problem's own noise, and the calibration (7,) in it."""
    detections, chain = system.detections, system.chains[0]
    odometry = system.settings.odometry
    sigmas = [odometry.sigma_scale, odometry.sigma_bias, *system.settings.calibration.sigmas]
    calibration = rng.normal(0.0, sigmas)
    sigma = np.sqrt(detections.covariance[:, 0, 0] + system.settings.spline.sigma_model**2)
    derivatives = by_sensor(detections.measured, detections.twist)[:, :, : len(calibration) - 2]
    points = detections.measured - derivatives @ calibration[2:]
    points += sigma[:, None] * rng.normal(size=points.shape)
    noisy = BatchSystem(
        replace(detections, measured=points, u=detections.u.copy()),
        [drawn_chain(chain, calibration[:2], rng)],
        system.priors,
    )
    return noisy, calibration


def drawn_chain(chain: LogOdometry, calibration: Array, rng: np.random.Generator) -> LogOdometry:
    """Returns the same drive measured with the odometry's own noise and a calibration (2,)."""
    driven = chain.odometry
    noise = np.linalg.solve(driven.whiteners, rng.normal(size=(*driven.deltas.shape, 1)))[..., 0]
    local = noise + driven.by_calibration @ calibration
    first = rng.multivariate_normal(chain.first, np.linalg.inv(chain.first_information))
    return _with_errors(replace(chain, first=first), local)


def _with_errors(chain: LogOdometry, local: Array) -> LogOdometry:
    """Returns the chain with errors (P - 1, 3), each in the frame of the end of its interval."""
    odometry = copy(chain.odometry)
    moved_ends = to_map(local[:, :2], odometry.deltas)
    odometry.deltas = np.column_stack([moved_ends, odometry.deltas[:, 2] + local[:, 2]])
    return replace(chain, odometry=odometry)


def state_of(curves: dict[int, Array], poses: Array, periodic: bool = False) -> State:
    """Returns a state with a curve through ordered points (k, 2) for each label, and poses (P, 3)."""
    settings, state = MapperSettings(), State()
    for label, points in curves.items():
        spline, _ = fit_spline(points, len(points) // 2, periodic)
        state.add_boundary(label, *boundary_of(spline, settings))
    add_drive(state, poses, np.zeros(2))
    return state


def ring(radius: float, count: int = 80) -> Array:
    """Returns points (count, 2) on a counterclockwise circle about the origin."""
    phi = 2.0 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(phi), np.sin(phi)])


def course_curvature(s: Array) -> Array:
    """Returns the curvature (m,) of a closed course of length COURSE at path lengths (m,), in 1/m.

    Its bends have two axes of symmetry, so that it closes, and are short, so that a lap is well defined.
    """
    phase = 2.0 * np.pi * s / COURSE
    return 2.0 * np.pi / COURSE * (1.0 + 0.8 * np.cos(2.0 * phase) + 0.8 * np.sin(6.0 * phase))


def course_log(laps: float, speed: float = 6.0) -> Log:
    """Returns an exact drive around the course, between cones 1.8 m to both sides of it."""
    s = np.arange(0.0, laps * COURSE, speed * DT)
    twists = np.column_stack([np.full(len(s), speed), np.zeros(len(s)), speed * course_curvature(s)])
    middle = integrate(twists[: round(COURSE / (speed * DT))], DT)[::25]
    normal = np.column_stack([-np.sin(middle[:, 2]), np.cos(middle[:, 2])])
    cones = np.concatenate([middle[:, :2] + 1.8 * normal, middle[:, :2] - 1.8 * normal])
    return exact_log(twists, cones, np.repeat([LEFT, RIGHT], len(middle)).astype(np.intp))


def detections_of(points_vehicle: Array, labels: IntArray, sigma: float) -> DetectionTable:
    """Returns the detections (m, 2) of cycle 0 with isotropic sigma (m), none of them used."""
    covariances, table = np.tile(sigma**2 * np.eye(2), (len(labels), 1, 1)), DetectionTable()
    table.append(Detections(0.0, points_vehicle, covariances, labels), 0)
    return table


def information_of(marginal: LapMarginal) -> NDArray[np.float64]:
    """Returns the information (n, n) of a marginal on [calibration | control points | pose]."""
    sizes = {label: spline.size for label, spline in marginal.splines.items()}
    order = far_first(sizes, marginal.near, len(marginal.calibration))
    by_entry = marginal.root[:, np.argsort(order)]
    return np.asarray(by_entry.T @ by_entry)
