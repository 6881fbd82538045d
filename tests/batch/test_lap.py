"""The batch of an open lap: its marginal is that of the whole problem, its map as good as the batch's."""

from __future__ import annotations

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import (
    LapMarginal,
    OpenLap,
    far_first,
    lap_optimum,
    marginal_of,
    reached_next,
    solve_lap,
)
from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.batch.simplification import simplified
from pathspace_graph.batch.start import StartMap
from pathspace_graph.batch.system import BatchSystem, Effort, Evaluation, weak_priors
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.graph.elimination import eliminated_system, linear_graph
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor
from pathspace_graph.graph.rows import Revisit, Rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, Layout, are_poses, indices, pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import fit_spline

from ..scenes.batch import COURSE, course_log, information_of
from ..scenes.drives import bean_track, lap_log, noisy, true_poses

Array = NDArray[np.float64]
WINDOW = 15


@cache
def log() -> Log:
    return noisy(lap_log(bean_track(), overrun=25.0), seed=3)


def open_lap(settings: MapperSettings | None = None) -> OpenLap:
    """Returns the lap with curves through the true cones, whose poses are those of the truth."""
    drive, settings = log(), settings or MapperSettings()
    truth = drive.truth
    assert truth is not None
    splines = {}
    for label in BOUNDARIES:
        cones = truth.cones[truth.cone_labels == label]
        splines[label] = fit_spline(cones, len(cones) // 2, periodic=True)[0]
    return OpenLap(
        settings=settings,
        chain=judge_log(drive, drive.noise, settings).chain,
        detections=DetectionTable.of(drive.cycles),
        first_kept=len(drive.cycles) - WINDOW,
        start=StartMap(splines, true_poses(drive), np.zeros(2)),
    )


@cache
def solved() -> LapMarginal:
    return solve_lap(open_lap())


@cache
def optimum() -> tuple[BatchSystem, Evaluation]:
    system, at, _ = lap_optimum(open_lap())
    return system, at


def are_later(rows: Rows, cycle: int) -> NDArray[np.bool_]:
    """Whether the first pose of each row is of a cycle or a later one."""
    poses = are_poses(rows.keys)
    first = np.where(poses, indices(rows.keys), np.iinfo(np.intp).max).min(axis=1)
    return np.asarray(poses.any(axis=1) & (first >= cycle))


def test_the_marginal_and_the_window_are_the_whole_problem() -> None:
    system, at = optimum()
    state, first = at.state, len(log().cycles) - WINDOW
    unchanged = np.eye(state.map_points.size)
    information, mean, _ = marginal_of(system, at, state, unchanged, first)
    here = np.concatenate([state.variables.calibration, state.map_points.ravel(), state.poses[first]])
    keys = np.concatenate([[CALIBRATION_KEY], state.map_keys, pose_keys(np.array([first]))])
    root = np.linalg.cholesky(information).T
    weak = weak_priors(state, system.gauge, first)
    groups = [rows for rows in system.rows(at, weak) if len(rows)]
    window = [rows.where(are_later(rows, first)) for rows in groups]
    measured = linear_graph(window, state.variables)
    kept = Layout(keys[:-1])
    marginal = jacobian_factor(keys, root, root @ (mean - here))
    found, vector = eliminated_system(graph_of(marginal, measured), kept)
    early = [rows.where(~are_later(rows, first)) for rows in groups]
    whole = graph_of(linear_graph(early, state.variables), measured)
    expected, right = eliminated_system(whole, kept)
    scale = np.sqrt(np.diagonal(expected))
    assert found / np.outer(scale, scale) == pytest.approx(expected / np.outer(scale, scale), abs=1e-7)
    assert vector / scale == pytest.approx(right / scale, abs=1e-5)


def test_the_map_is_as_good_as_that_of_the_batch_over_the_same_log() -> None:
    batch = BatchMapper(None, log().odometry_sigma, FixedLagMapper).solve(log(), "odometry")
    truth, marginal = log().truth, solved()
    assert truth is not None
    boundaries = {
        label: SplineBoundary(spline, np.eye(2 * len(spline.distinct_control_points)))
        for label, spline in marginal.splines.items()
    }
    assert marginal.convergence.converged
    rmse = lap_metrics(Map(True, boundaries), truth, 0).rmse
    assert rmse < 0.01 + lap_metrics(batch.map, truth, 0).rmse


def test_the_mean_of_the_marginal_is_near_the_optimum_by_its_own_covariance() -> None:
    marginal = solved()
    points = [spline.distinct_control_points.ravel() for spline in marginal.splines.values()]
    first = marginal.first_kept
    optimum = np.concatenate([marginal.calibration, *points, marginal.poses[first]])
    off = optimum - marginal.mean
    assert off @ information_of(marginal) @ off < len(off)


def test_the_root_is_triangular_with_the_control_points_first_that_the_window_does_not_reach() -> None:
    lap = open_lap()
    near = dict.fromkeys(BOUNDARIES, np.arange(3))
    state = optimum()[1].state
    sizes = [state.boundaries[label].size for label in BOUNDARIES]
    count = 2 + 2 * sum(sizes) + 3
    order = far_first(dict(zip(BOUNDARIES, sizes, strict=True)), near, 2)
    far = [2 + 2 * 3 + k for k in range(2 * (sizes[0] - 3))]
    far += [2 + 2 * (sizes[0] + 3) + k for k in range(2 * (sizes[1] - 3))]
    assert order[: len(far)].tolist() == far
    assert sorted(order.tolist()) == list(range(count))
    marginal = solved()
    np.testing.assert_array_equal(np.tril(marginal.root, -1), 0.0)
    system, at = optimum()
    few = simplified(at.state, system.detections, system.settings)
    expected = marginal_of(system, at, few.state, few.change, lap.first_kept)[0]
    np.testing.assert_allclose(information_of(marginal), expected, atol=1e-6 * np.abs(expected).max())
    reached = reached_next(state, lap)
    for label, boundary in state.boundaries.items():
        window = state.pose_u[label][lap.first_kept :]
        seen = np.linspace(window.min(), window.max() + lap.settings.gate.view_ahead, 100)
        shaping = boundary.columns(boundary.tables.evaluate(seen)[1])
        assert set(shaping.ravel().tolist()) <= set(reached[label].tolist())


def test_few_rounds_do_not_converge() -> None:
    _, _, convergence = lap_optimum(open_lap(), Effort(rough_rounds=1, rounds=1))
    assert not convergence.converged


def test_the_lap_itself_is_not_changed() -> None:
    lap = open_lap()
    assert lap.start is not None
    used, poses = deepcopy(lap.detections.used), lap.start.poses.copy()
    solve_lap(lap)
    assert (lap.detections.used == used).all()
    assert (lap.start.poses == poses).all()


@pytest.mark.parametrize("lap", [1.0, 0.8])
def test_a_search_from_odometry_closes_where_the_revisit_is_right(lap: float) -> None:
    """The last pose is said to be where the vehicle was a lap before, or nearer: nothing then fits."""
    drive, settings = noisy(course_log(1.35), seed=3), MapperSettings()
    chain, truth = judge_log(drive, drive.noise, settings).chain, true_poses(drive)
    earlier = int(path_lengths(truth).searchsorted((1.35 - lap) * COURSE))
    revisit = Revisit(earlier, len(truth) - 1, np.zeros(3), np.diag([10.0, 10.0, 50.0]))
    detections, first_kept = DetectionTable.of(drive.cycles), len(drive.cycles) - WINDOW
    marginal = solve_lap(OpenLap(settings, chain, detections, first_kept, None, (revisit,)))
    assert (marginal.objection == "") == (lap == 1.0)
    if lap == 1.0:
        assert marginal.convergence.converged
        for spline in marginal.splines.values():
            assert spline.periodic
            np.testing.assert_allclose(spline.length(), COURSE, atol=13.0)
