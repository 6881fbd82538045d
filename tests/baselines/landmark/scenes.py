"""Landmarks in the engine: a drive past five cones, landmarks of a given covariance, and oracle systems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.baselines.landmarks import (
    LandmarkMap,
    LandmarkSmoother,
    LandmarkState,
    LandmarkSystem,
    start_oracle,
)
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.graph.elimination import linear_graph
from pathspace_graph.graph.gaussian import jacobian_factor
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.motion import smoother_settings
from pathspace_graph.settings.mapper import CalibrationSettings, GateSettings, MapperSettings

from ...scenes.drives import ODOMETRY_SIGMA, beginning, see

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

CONES = np.array([[6.0, 2.0], [6.0, -2.0], [10.0, 2.5], [10.0, -1.5], [6.1, 2.05]])
LABELS = np.array([LEFT, RIGHT, LEFT, RIGHT, LEFT], dtype=np.intp)
PERIOD = 0.1
SPEED = 1.0
KNOWN = CalibrationSettings(sensor=False)
"""The sensor has no errors, and none are estimated."""
QUADRATIC = replace(MapperSettings(), lag=100.0, gate=GateSettings(huber=np.inf), calibration=KNOWN)


def drive_on(smoother: LandmarkSmoother, cycle: int, twist: tuple[float, float, float]) -> None:
    """Adds the pose of one more cycle, reached with a twist (m/s, m/s, rad/s)."""
    steps = 1 if cycle else 0
    odometry = integrate_twists(np.full(steps, PERIOD), np.tile(twist, (steps, 1)), ODOMETRY_SIGMA)
    smoother.predict(PERIOD * cycle, odometry, smoother.map.settings.odometry.sigmas_start)


def see_all(smoother: LandmarkSmoother, cycle: int, noise: float) -> None:
    """Adds a detection of every cone from the newest pose, associated with its landmark."""
    t, rng = PERIOD * cycle, np.random.default_rng(cycle)
    if cycle == 0:
        smoother.map.state.add(CONES + 0.1, LABELS)
    seen = see(t, np.array([SPEED * t, 0.0, 0.0]), CONES, LABELS)
    noisy = seen.points_vehicle + noise * rng.normal(0.0, 0.1, seen.points_vehicle.shape)
    rows = smoother.map.detections.append(replace(seen, points_vehicle=noisy), cycle)
    smoother.map.detections.take(np.arange(rows.start, rows.stop), np.arange(len(CONES)))


def driven(cycles: int, settings: MapperSettings = QUADRATIC, noise: float = 1.0) -> LandmarkSmoother:
    """Returns the smoother after a drive straight on, with all cones detected in every cycle."""
    smoother = FixedLagSmoother(smoother_settings(settings), LandmarkMap(settings))
    for cycle in range(cycles):
        drive_on(smoother, cycle, (SPEED, 0.1, 0.05))
        see_all(smoother, cycle, noise)
        smoother.step()
        smoother.marginalize()
    return smoother


def with_covariance(
    points: Array, labels: IntArray, covariance: Array, settings: MapperSettings | None = None
) -> LandmarkSmoother:
    """Returns a smoother at the start, after a step on landmarks (n, 2) with joint covariance (2 n, 2 n)."""
    settings = settings or MapperSettings(calibration=KNOWN)
    smoother = FixedLagSmoother(smoother_settings(settings), LandmarkMap(settings))
    drive_on(smoother, 0, (0.0, 0.0, 0.0))
    smoother.map.state.add(points, labels)
    root = np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)
    smoother.prior.push_back(jacobian_factor(smoother.map.state.keys, root, np.zeros(len(root))))
    smoother.step()
    return smoother


def beginning_of(log: Log, cycles: int) -> tuple[Log, NDArray[np.int_]]:
    """Returns the first cycles of a simulated log, and their true associations."""
    first = beginning(log, cycles)
    assert first.truth is not None and first.truth.associations is not None
    made = Log(log.odometry, first.cycles, log.odometry_sigma, odometry_drift=np.zeros(3))
    return made, first.truth.associations


def oracle_system(log: Log, cycles: int) -> tuple[LandmarkSystem, LandmarkState]:
    """Returns the system of the first cycles of a log with oracle associations, and its start."""
    beginning, associations = beginning_of(log, cycles)
    system = LandmarkSystem.of_log(beginning, MapperSettings(), log.noise)
    return system, start_oracle(system, associations)


def normal_equations_of(system: LandmarkSystem, state: LandmarkState) -> tuple[Array, Array]:
    """Returns the normal equations of all variables, in the order of their keys."""
    graph = linear_graph(system.rows(state, system.settings.gate.huber), state.variables)
    hessian, vector = graph.hessian(state.variables.layout.ordering)
    return hessian, vector
