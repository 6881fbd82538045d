"""Stations of a batch: cones of the first lap, detections of later ones, what they tell along the curves."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.association import cone_stations, laps_of_detections
from pathspace_graph.batch.lap import OpenLap, along_of, lap_optimum, marginal_of, stations_on
from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.batch.simplification import map_block, simplified
from pathspace_graph.batch.system import BatchSystem, Evaluation, moved, nonlinear_graph
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.log import Log
from pathspace_graph.mapping.detections import NO_STATION
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import straight
from ..scenes.drives import bean_track, lap_log, noisy, true_poses
from .test_lap import open_lap
from .test_nonlinear_graph import rotations

Array = NDArray[np.float64]

# --- a drive ---------------------------------------------------------------------------------------------


@cache
def log() -> Log:
    """Return a lap and a quarter with noise, past cones that no gap tells apart from the next."""
    return noisy(lap_log(bean_track(), overrun=25.0), seed=3)


@cache
def optimum() -> tuple[BatchSystem, Evaluation, OpenLap]:
    """Return the lap's problem at its optimum, the detections of which have stations."""
    lap = open_lap()
    system, at, _ = lap_optimum(lap)
    return system, at, lap


def true_cones(system: BatchSystem, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the true cone (m,) of each detection."""
    drive = log()
    assert drive.truth is not None
    poses = true_poses(drive)[system.detections.cycle[rows]]
    points = to_map(system.detections.measured[rows], poses)
    return np.asarray(np.hypot(*(points[:, None] - drive.truth.cones).transpose(2, 0, 1)).argmin(axis=1))


@pytest.mark.parametrize("off", [0.0, 0.8, -0.8])
def test_detections_of_both_passes_are_of_one_cone(off: float) -> None:
    """The seam: the second pass is decimetres along from the first, and is matched with its own cones."""
    system, at, _ = optimum()
    state, detections = at.state.copy(), system.detections
    for label in state.boundaries:
        second = laps_of_detections(at.state, detections, label) > 0
        u = detections.u.copy()
        u[second & (detections.boundary == label)] += off
        detections = replace(detections, u=u)
    found, detections = cone_stations(state, detections, system.settings), detections.copy()
    assert found is not None
    again = 0
    for curve in found.curves:
        rows = detections.used_on(curve.label)
        found.match(state, detections, rows, state.spline(curve.label).tangent_unit(detections.u[rows]))
        rows = rows[detections.station[rows] != NO_STATION]
        again += (laps_of_detections(state, detections, curve.label)[rows] > 0).sum()
        cone, station = true_cones(system, rows), detections.station[rows]
        for one in np.unique(station):
            assert len(np.unique(cone[station == one])) == 1
    assert again > 0


def test_the_gradient_is_that_of_the_cost() -> None:
    system, at, _ = optimum()
    state = moved(at.state, np.random.default_rng(2).normal(0.0, 0.01, at.state.variables.layout.size))
    system.evaluate(state, hold=True)
    here, layout = system.evaluate(state), state.variables.layout
    assert len(here.along.residual) > 300
    rng, (_, negative_gradient) = np.random.default_rng(5), system.linear_graph(here).hessian(layout.ordering)
    for _ in range(3):
        step = rng.normal(0.0, 1e-6, layout.size)
        costs = [system.evaluate(moved(state, sign * step)).cost for sign in (1.0, -1.0)]
        assert -2.0 * negative_gradient @ step == pytest.approx(costs[0] - costs[1], rel=1e-3)


def test_gtsam_has_the_same_linear_problem() -> None:
    system, at, _ = optimum()
    state, variables = at.state, at.state.variables
    theirs = nonlinear_graph(system, at).linearize(variables.gtsam_values(variables.keys))
    information, vector = theirs.hessian(variables.layout.ordering)
    expected, negative_gradient = system.linear_graph(at).hessian(variables.layout.ordering)
    turn, size = rotations(state), np.sqrt(np.diagonal(expected))
    found = turn @ information @ turn.T
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=1e-6)
    np.testing.assert_allclose(turn @ vector / size, negative_gradient / size, atol=1e-5)


def test_a_station_s_sigma_is_how_it_moves_along_the_few_curve() -> None:
    """By drawing dense control points of their covariance: the few ones follow by the change."""
    system, at, lap = optimum()
    assert system.stations is not None
    simple = simplified(at.state, system.detections, system.settings)
    few, change = simple.state, simple.change
    _, _, dense = marginal_of(system, at, few, change, lap.first_kept)
    stations = stations_on(few, system.stations, at.state, change, dense)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(dense)), dense, 2000)
    for curve in system.stations.curves:
        label, old, new = curve.label, at.state.boundaries[curve.label], few.boundaries[curve.label]
        t = new.evaluate(few.control_points(label), stations[label][:, 0], 1)
        t /= np.hypot(*t.T)[:, None]
        mine = draws[:, map_block(at.state, label)]
        moved_few = mine @ change[map_block(few, label), map_block(at.state, label)].T
        along = mine @ along_of(old, curve.u, t).T - moved_few @ along_of(new, stations[label][:, 0], t).T
        np.testing.assert_allclose(along.std(axis=0), stations[label][:, 1], rtol=0.1)


def test_a_setting_leaves_the_pure_projection() -> None:
    lap = open_lap(MapperSettings(stations=False))
    system, at, _ = lap_optimum(lap)
    assert system.stations is None and len(at.along.rows) == 0


def test_stations_hold_the_vehicle_along_the_curves() -> None:
    """The same drive, by itself odometry of 2 %: the second pass is told where the first one was."""
    without, held = (
        BatchMapper(MapperSettings(stations=stations), log().noise).solve(log(), "odometry")
        for stations in (False, True)
    )
    error = [np.hypot(*(result.trajectory - true_poses(log()))[:, :2].T).mean() for result in (without, held)]
    assert error[1] < error[0]


def test_a_road_of_lines_has_no_stations() -> None:
    system, state = straight()
    settings = replace(system.settings, kind="line")
    assert cone_stations(state, system.detections, settings) is None
