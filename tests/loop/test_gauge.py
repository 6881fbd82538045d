"""The gauge of a closed map is held: shape goes on to be estimated, and the covariance stays what it was."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.graph.smoother import restart
from pathspace_graph.io.log import Log
from pathspace_graph.loop.closing import fix_gauge, motion_across
from pathspace_graph.mapping.state import State
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import bean_track, replay
from ..shared.copied import copied

Array = NDArray[np.float64]


def ring(count: int = 40) -> tuple[Array, Array]:
    """Points of an ellipse, and its normals there."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    points = np.column_stack([20.0 * np.cos(angle) + 5.0, 9.0 * np.sin(angle) - 3.0])
    normals = np.column_stack([9.0 * np.cos(angle), 20.0 * np.sin(angle)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@given(x=st.floats(-1.0, 1.0), y=st.floats(-1.0, 1.0), theta=st.floats(-0.01, 0.01))
def test_a_rigid_motion_is_found_though_points_slide_along(x: float, y: float, theta: float) -> None:
    points, normals = ring()
    moved = np.array([x, y]) + theta * np.column_stack([-points[:, 1], points[:, 0]])
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    slid = moved + np.linspace(-2.0, 3.0, len(points))[:, None] * tangents
    np.testing.assert_allclose(motion_across(points, normals) @ slid.ravel(), [x, y, theta], atol=1e-9)


# --- a closed map ----------------------------------------------------------------------------------------


@cache
def log() -> Log:
    return simulate(bean_track(), SimulationSettings(laps=3), seed=2)


def with_laps(laps: float) -> MapperSettings:
    settings = MapperSettings()
    return replace(settings, closing=replace(settings.closing, gauge_laps=laps))


@cache
def _run(laps: float, until: float) -> FixedLagMapper:
    return drive_on(FixedLagMapper(with_laps(laps)), until)


def run(laps: float, until: float) -> FixedLagMapper:
    """Returns a copy of a mapper after the cycles up to a stamp (s), which are mapped once."""
    return copied(_run(laps, until))


def drive_on(mapper: FixedLagMapper, until: float) -> FixedLagMapper:
    """Hands the cycles up to a stamp (s) to a mapper that has had the first ones."""
    for odometry, detections in islice(split_odometry(log()), mapper.road.smoother.next_cycle, None):
        if detections.t > until:
            break
        replay(mapper, odometry, detections)
    return mapper


def across(state: State) -> tuple[Array, Array]:
    """The keys of the control points, and the rows that give the motion across the curves."""
    order = np.argsort(state.map_keys)
    tangent = np.concatenate([state.spline(b).tangent_unit(c.abscissae) for b, c in state.boundaries.items()])
    normals = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return state.map_keys[order], motion_across(state.map_points[order], normals[order])


@cache
def mid() -> float:
    return float(log().cycles[len(log().cycles) // 2].t)


def test_holding_moves_nothing_and_keeps_what_is_known_of_map_and_pose() -> None:
    """Nothing that is relative to the map changes by holding it, and no covariance does at that moment."""
    mapper = run(np.inf, mid())
    smoother = mapper.road.smoother
    assert mapper.closed and smoother.held is None
    keys, rows = across(smoother.map.state)
    newest = np.array([mapper.next_pose_key - 1])
    before, of_pose = smoother.covariance(keys), smoother.covariance(newest)
    fix_gauge(smoother)
    np.testing.assert_allclose(smoother.covariance(keys), before, atol=1e-6 * before.max())
    np.testing.assert_allclose(smoother.covariance(newest), of_pose, rtol=0.02, atol=1e-8)
    pinned = smoother._covariance(keys)
    assert np.trace(rows @ pinned @ rows.T) < 1e-3 * np.trace(rows @ before @ rows.T)


def test_a_step_of_a_held_map_is_that_of_a_free_one_given_that_the_whole_does_not_move() -> None:
    """With the covariance P of the points and the rows C the free step is conditioned on `C dx = 0`."""
    smoother, free = (run(np.inf, mid()).road.smoother for _ in range(2))
    keys, C = across(smoother.map.state)
    P, before = smoother.covariance(keys), smoother.variables.of(keys)
    fix_gauge(smoother)
    for one in (smoother, free):
        one.step()
    moved, expected = (one.variables.of(keys) - before for one in (smoother, free))
    assert np.abs(C @ expected).max() > 1e-4
    expected = expected - P @ C.T @ np.linalg.solve(C @ P @ C.T, C @ expected)
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    np.testing.assert_allclose(C @ moved, 0.0, atol=1e-6)


def test_the_map_is_held_after_the_laps_that_were_set_and_its_shape_is_not() -> None:
    early, free = run(0.4, held_since()), drive_on(run(np.inf, mid()), np.inf)
    held = drive_on(copied(early), np.inf)
    assert held.road.smoother.held is not None and free.road.smoother.held is None
    known = held.road.smoother.held
    keys, rows = across(early.road.smoother.map.state)
    moved = held.road.smoother.variables.of(keys) - early.road.smoother.variables.of(keys)
    sigma = np.sqrt(np.diag(rows @ known.covariance @ rows.T))
    assert (np.abs(rows @ moved) < 0.1 * sigma).all()
    assert np.abs(moved).max() > 5e-3
    claimed = held.road.smoother.covariance(known.keys)
    np.testing.assert_allclose(claimed, known.covariance, atol=0.02 * known.covariance.max())
    assert np.trace(claimed) > np.trace(free.road.smoother.covariance(known.keys))


def test_the_gauge_is_held_that_many_laps_after_the_swap() -> None:
    mapper, at = run(np.inf, 0.3 * mid()), dict[str, float]()
    mapper.settings = mapper.road.settings = with_laps(0.4)
    while "held" not in at:
        newest = mapper.road.smoother.next_cycle
        result = replay(mapper, *next(islice(split_odometry(log()), newest, None)))
        if result.jump is not None:
            at["swap"] = mapper.road.path.length
        if mapper.road.smoother.held is not None:
            at["held"] = mapper.road.path.length
    longest = max(boundary.length for boundary in mapper.road.boundaries.values())
    assert 0.4 * longest < at["held"] - at["swap"] < 0.4 * longest + 2.0


def held_since() -> float:
    """The stamp by which the gauge was held: one more lap after the swap, and a little more."""
    return 0.7 * log().cycles[-1].t


def test_factors_of_the_user_may_tell_the_gauge_so_that_it_is_not_held() -> None:
    """Without them it is held by then, as the test below shows."""
    mapper = FixedLagMapper(with_laps(0.1))
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    for cycle, (odometry, detections) in enumerate(split_odometry(log())):
        own = [gtsam.PriorFactorPose2(mapper.next_pose_key, gtsam.Pose2(), noise)] if cycle == 5 else []
        mapper.update(odometry, detections, own)
        if detections.t > mid():
            break
    assert mapper.closed and mapper.road.smoother.held is None


def test_a_map_that_replaces_another_has_a_gauge_of_its_own() -> None:
    smoother = run(0.1, mid()).road.smoother
    assert smoother.held is not None
    restart(smoother, smoother.first_cycle)
    assert smoother.held is None
