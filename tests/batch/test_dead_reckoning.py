"""The start from odometry and revisits: a drift that they take out, and curves beside the first lap."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.start import aligned_odometry, start_odometry
from pathspace_graph.batch.system import BatchSystem
from pathspace_graph.factors.se2 import path_lengths, relative, wrap_angle
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.rows import OdometryChain, Revisit
from pathspace_graph.io.log import Log
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import COURSE, course_log
from ..scenes.drives import ahead, corridor, exact_log, true_poses

Array = NDArray[np.float64]

SETTINGS = MapperSettings()
SCALE, BIAS = 0.004, 0.004
"""The odometry has this scale error [-] and this bias of the yaw rate (rad/s)."""


@cache
def drifting() -> tuple[Log, LogOdometry]:
    """Returns laps of a closed course whose odometry drifts."""
    log = course_log(2.6)
    twists = log.odometry.twist * [1.0 + SCALE, 1.0 + SCALE, 1.0] + [0.0, 0.0, BIAS]
    log = replace(log, odometry=replace(log.odometry, twist=twists))
    return log, judge_log(log, log.noise, SETTINGS).chain


# --- drift -----------------------------------------------------------------------------------------------


def revisits() -> list[Revisit]:
    """Returns the last pose and one a lap before, each in the frame of one a lap earlier, with no error."""
    truth = true_poses(drifting()[0])
    driven, found = path_lengths(truth), []
    for later in (int(driven.searchsorted(driven[-1] - COURSE)), len(truth) - 1):
        earlier = int(driven.searchsorted(driven[later] - COURSE))
        local = relative(truth[earlier], truth[later])
        local[2] = wrap_angle(local[2])
        found.append(Revisit(earlier, later, local, np.diag([10.0, 10.0, 50.0])))
    return found


def test_the_drift_of_the_odometry_is_taken_out() -> None:
    """Dead reckoning ends metres away, the aligned laps within decimetres. The bias has a prior."""
    log, chain = drifting()
    reckoned, truth = chain.dead_reckoned(np.zeros(2)), true_poses(log)
    aligned = aligned_odometry(chain, revisits())
    assert np.hypot(*(reckoned - truth)[-1, :2]) > 2.0
    assert np.hypot(*(aligned.poses - truth)[:, :2].T).max() < 0.7
    np.testing.assert_allclose(aligned.calibration[1], BIAS, rtol=0.3)


def test_a_vehicle_that_rests_far_from_its_start_is_not_taken_for_free() -> None:
    """Its last poses are certain relative to each other, by far more than relative to the first one."""
    deltas = np.repeat([[0.8, 0.0, 0.02], [0.0, 0.0, 0.0]], [220, 20], axis=0)
    sigmas = np.repeat([[0.14, 0.05, 0.02], [5e-4, 5e-4, 5e-5]], [220, 20], axis=0)
    odometry = OdometryChain()
    odometry.deltas, odometry.by_calibration = deltas, np.zeros((240, 3, 2))
    odometry.whiteners = np.array([np.diag(1.0 / sigma) for sigma in sigmas])
    prior, still = np.diag([1e8, 1e8, 1e10]), np.zeros((241, 3))
    chain = LogOdometry(np.arange(241.0), still[0], prior, odometry, still, np.zeros(2), np.full(2, 1e-3))
    aligned = aligned_odometry(chain, ())
    np.testing.assert_allclose(aligned.poses, chain.dead_reckoned(np.zeros(2)), atol=1e-9)
    np.testing.assert_allclose(aligned.covariances[-1, 2, 2], 1e-10 + (sigmas[:, 2] ** 2).sum(), rtol=1e-4)


def test_poses_every_few_metres_are_aligned_as_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within centimetres, and about as certain, from a tenth of the variables."""
    _, chain = drifting()
    few = aligned_odometry(chain, revisits())
    monkeypatch.setattr("pathspace_graph.batch.start.NODE_STEP", 1e-6)
    every = aligned_odometry(chain, revisits())
    assert len(few.nodes) < 0.2 * len(every.nodes) == 0.2 * len(chain)
    off = few.poses - every.poses
    assert np.hypot(*off[:, :2].T).max() < 0.05
    assert np.abs(off[:, 2]).max() < 0.005
    np.testing.assert_allclose(few.calibration, every.calibration, rtol=1e-3, atol=1e-6)
    sigmas = (
        np.sqrt(np.diagonal(one, axis1=1, axis2=2)) for one in (few.covariances, every.covariances[few.nodes])
    )
    np.testing.assert_allclose(*sigmas, rtol=1e-3)


def test_what_is_aligned_is_a_minimum_of_odometry_and_revisits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradient by every pose is that of the odometry alone where a pose has no revisit."""
    monkeypatch.setattr("pathspace_graph.batch.start.NODE_STEP", 1e-6)
    monkeypatch.setattr("pathspace_graph.batch.start.ALIGN_TOLERANCE", 0.1)
    _, chain = drifting()
    again = revisits()
    aligned = aligned_odometry(chain, again)
    poses, calibration = aligned.poses, aligned.calibration
    met = [cycle for one in again for cycle in (one.earlier, one.later)]
    free = np.setdiff1d(np.arange(1, len(poses) - 1), met)
    h = 1e-5
    for k in free[:: len(free) // 8]:
        for axis in range(3):
            costs = []
            for sign in (1.0, -1.0):
                moved = poses.copy()
                moved[k, axis] += sign * h
                costs.append(0.5 * (chain.odometry.terms(slice(None), moved, calibration)[0] ** 2).sum())
            curvature = (
                costs[0] + costs[1] - (chain.odometry.terms(slice(None), poses, calibration)[0] ** 2).sum()
            ) / h**2
            slope = (costs[0] - costs[1]) / (2.0 * h)
            assert abs(slope) < 1e-3 * np.sqrt(curvature)


def test_the_curves_of_a_closed_course_stand_beside_its_path() -> None:
    log, chain = drifting()
    state = start_odometry(BatchSystem(DetectionTable.of(log.cycles), [chain], [SETTINGS], revisits()))
    assert set(state.boundaries) == set(BOUNDARIES)
    assert log.truth is not None
    for label, boundary in state.boundaries.items():
        assert boundary.periodic
        u = np.linspace(boundary.tables.low, boundary.tables.high, 200)
        curve = boundary.evaluate(state.control_points(label), u)
        cones = log.truth.cones[log.truth.cone_labels == label]
        distance = np.hypot(*(cones[:, None] - curve).transpose(2, 0, 1)).min(axis=1)
        assert distance.max() < 1.0


def test_a_path_without_a_revisit_is_dead_reckoned() -> None:
    cones, labels = corridor(60.0)
    log = exact_log(ahead(6.0, 5.0), cones, labels)
    chain = judge_log(log, log.noise, SETTINGS).chain
    state = start_odometry(BatchSystem(DetectionTable.of(log.cycles), [chain], [SETTINGS]))
    np.testing.assert_allclose(state.poses, chain.dead_reckoned(np.zeros(2)), atol=1e-9)
    np.testing.assert_allclose(state.variables.calibration, 0.0, atol=1e-9)
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert not state.boundaries[label].periodic
        np.testing.assert_allclose(state.control_points(label)[:, 1], y, atol=1e-6)


def test_a_circuit_of_21_metres_has_both_boundaries() -> None:
    log = exact_log(ahead(6.0, 5.0), *corridor(60.0, half_width=10.5))
    chain = judge_log(log, log.noise, SETTINGS).chain
    state = start_odometry(BatchSystem(DetectionTable.of(log.cycles), [chain], [SETTINGS]))
    for label, y in ((LEFT, 10.5), (RIGHT, -10.5)):
        np.testing.assert_allclose(state.control_points(label)[:, 1], y, atol=1e-6)
