"""MapRepair: holes of the first lap are led through in the second one, and nothing else is touched."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.health import DEGRADED, GOOD, LOST
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop import known_loop
from pathspace_graph.loop.closed import Closed
from pathspace_graph.loop.drive import Drive, Step
from pathspace_graph.loop.known_loop import REPAIRED, ContradictedStretch, carried, newest_lap, refitted
from pathspace_graph.mapping.road import Road
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.spline.boundary import sampled

from ..scenes.drives import Mapped, map_beginning, map_log, true_poses
from ..scenes.holes import cluttered, unseen
from ..scenes.kidnapped import laps_log, pear_track

Array = NDArray[np.float64]

LAP = 200
"""Cycles before the vehicle comes to the hole again, after the swap."""
HOLE = (6.0, 11.0)
"""The boundary is not seen between these stamps (s), in the middle of the first lap."""


@cache
def clean() -> Log:
    """Two laps and a half."""
    log = laps_log(pear_track())
    return replace(log, cycles=log.cycles[:390])


@cache
def holed() -> Log:
    return unseen(clean(), [LEFT], *HOLE)


@cache
def repaired() -> Mapped:
    return map_log(holed(), *map_beginning(holed(), LAP))


def rmse(mapper: FixedLagMapper) -> float:
    """The rmse of the map on all cones; none is missed."""
    truth = clean().truth
    assert truth is not None
    metrics = lap_metrics(mapper.map(), truth, 0)
    assert metrics.missed == 0.0
    return metrics.rmse


def test_a_hole_of_one_boundary_is_mended_once_the_vehicle_has_passed_it_again() -> None:
    mapper, results = repaired()
    (notice,) = [result for result in results if result.notice]
    assert notice.notice == f"{REPAIRED}: 9 more cones on the left lie on it"
    assert notice.jump is not None and np.hypot(*notice.jump[:2]) < 0.3
    lap = 15.0  # seconds, about
    assert HOLE[1] + lap < notice.t < HOLE[1] + 1.5 * lap
    assert rmse(mapper) < 0.05


def test_the_vehicle_is_not_lost_beside_the_hole_and_it_is_said_which_boundary_is_not_mapped() -> None:
    conditions = {result.health.condition for result in repaired()[1]}
    reasons = {result.health.reason for result in repaired()[1]}
    assert conditions == {GOOD, DEGRADED}
    assert "the left boundary is not mapped here" in reasons
    offset = np.array([r.pose[:2] for r in repaired()[1]]) - true_poses(clean())[:, :2]
    assert np.hypot(*offset.T).max() < 0.5


def test_a_hole_of_both_boundaries_is_repaired() -> None:
    mapper, results = map_log(unseen(clean(), [LEFT, RIGHT], HOLE[0], HOLE[1] - 1.0))
    notices = [result.notice for result in results if result.notice]
    assert notices and all(notice.startswith(REPAIRED) for notice in notices)
    assert LOST not in {result.health.condition for result in results}
    assert rmse(mapper) < 0.05


@pytest.mark.parametrize("false_positives", [0, 3])
def test_a_map_without_holes_is_never_solved_again(
    false_positives: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[object] = []
    begin = Drive.begin_batch

    def count(self: Drive, *arguments: Any) -> None:
        begun.append(arguments[-1])
        begin(self, *arguments)

    monkeypatch.setattr(Drive, "begin_batch", count)
    log = cluttered(clean(), false_positives, seed=1) if false_positives else clean()
    mapper, results = map_log(log)
    assert mapper.closed and len(begun) == 1  # the batch of the open lap
    assert not any(result.notice for result in results)


def test_the_record_has_the_pose_of_every_cycle_in_the_frame_of_the_mended_map() -> None:
    mapper, results = repaired()
    poses = np.array(mapper.drive.record.poses)
    assert len(poses) == len(results)
    assert np.hypot(*(poses - true_poses(clean()))[:, :2].T).max() < 0.3


@pytest.mark.parametrize(
    "why", ["it explains too few", "it takes more than it explains", "its boundaries cross"]
)
def test_a_map_that_does_not_explain_the_contradictions_or_is_worse_is_refused(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More are asked for than there are, far cones lay on the curve, or the batch has an objection."""
    take = Closed.take

    def take_worse(phase: Closed, road: Road, drive: Drive, outcome: LapMarginal) -> Step:
        if why == "its boundaries cross":
            return take(phase, road, drive, replace(outcome, objection=why))
        mapped = phase.map_repair._mapped
        mapped[RIGHT] = np.concatenate([mapped[RIGHT], np.full((40, 2), 1e3)])
        return take(phase, road, drive, outcome)

    if why == "it explains too few":
        monkeypatch.setattr(known_loop, "EXPLAINED", 2.0)
    else:
        monkeypatch.setattr(Closed, "take", take_worse)
    mapper, results = map_log(holed(), *map_beginning(holed(), LAP))
    jumps = [result.t for result in results if result.jump is not None]
    assert len(jumps) == 1  # the swap of the open lap
    assert mapper.closed and not any(result.notice for result in results)


# --- the curve that is led anew --------------------------------------------------------------------------


def test_a_curve_is_led_through_new_cones_and_stays_elsewhere() -> None:
    mapper, _ = repaired()
    track, poses = mapper.road.smoother.map, np.array(mapper.drive.record.poses)
    before = sampled(track.state.spline(LEFT), 0.25)
    u = np.array([30.0, 33.0, 36.0, 39.0])
    boundary, points = track.state.boundaries[LEFT], mapper.control_points(LEFT)
    tangent = boundary.evaluate(points, u, 1)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    cones = boundary.evaluate(points, u) + 1.5 * normal
    after = sampled(refitted(track, LEFT, [ContradictedStretch(LEFT, cones[::-1])], poses), 0.25)
    nearest = np.hypot(*(after[:, None] - cones).transpose(2, 0, 1)).min(axis=0)
    assert nearest.max() < 0.3
    away = np.hypot(*(before[:, None] - cones).transpose(2, 0, 1)).min(axis=1) > 8.0
    moved = np.hypot(*(before[away, None] - after).transpose(2, 0, 1)).min(axis=1)
    assert moved.max() < 0.3


def test_a_row_across_a_neck_does_not_replace_the_cones_of_the_way_round() -> None:
    """The first row is one of new cones on a stretch, the second has its ends alone."""
    mapper, _ = repaired()
    track, poses = mapper.road.smoother.map, np.array(mapper.drive.record.poses)
    boundary, points = track.state.boundaries[LEFT], mapper.control_points(LEFT)
    between = boundary.evaluate(points, np.arange(42.0, 63.0, 1.0))
    for u, stays in ((np.arange(30.0, 76.0, 3.0), False), (np.array([30.0, 33.0, 72.0, 75.0]), True)):
        tangent = boundary.evaluate(points, u, 1)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
        cones = boundary.evaluate(points, u) + 1.5 * normal
        after = sampled(refitted(track, LEFT, [ContradictedStretch(LEFT, cones)], poses), 0.25)
        moved = np.hypot(*(between[:, None] - after).transpose(2, 0, 1)).min(axis=1)
        assert bool(moved.max() < 0.3) is stays


def test_a_curve_without_contradictions_stays_to_the_bit() -> None:
    track = repaired()[0].road.smoother.map
    same = refitted(track, RIGHT, [ContradictedStretch(LEFT, np.zeros((3, 2)))], np.zeros((2, 3)))
    assert (same.control_points == track.state.spline(RIGHT).control_points).all()


def test_the_newest_lap_begins_where_it_ends() -> None:
    phi = np.linspace(0.0, 5.0 * np.pi, 500)  # two laps and a half
    poses = np.column_stack([20.0 * np.cos(phi), 20.0 * np.sin(phi), phi])
    lap, stations = newest_lap(poses, 40.0 * np.pi * 1.1)  # the length is known only about
    assert stations[-1] == pytest.approx(40.0 * np.pi, rel=0.01)
    np.testing.assert_array_equal(lap[0], lap[-1])
    assert np.hypot(*(lap[0] - poses[-1, :2])) < 0.5


def test_cones_are_carried_by_the_pose_next_to_them() -> None:
    before = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    after = np.array([[1.0, 0.0, 0.0], [10.0, 2.0, 0.5 * np.pi]])
    points = carried(np.array([[0.0, 3.0], [11.0, 1.0]]), before, after)
    np.testing.assert_allclose(points, [[1.0, 3.0], [9.0, 3.0]], atol=1e-12)


def test_known_gaps_are_gone_after_mending() -> None:
    """The phase has laid out the map with its hole before, and lays out the one that has replaced it."""
    mapper, _ = repaired()
    assert isinstance(mapper.phase, Closed)
    assert mapper.phase.known_loop.of(mapper.road.smoother).with_gaps() == []


# --- a whole drive ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_side_unseen_for_50_m_is_mended_in_the_second_lap() -> None:
    faults = Faults(sensor=SensorFaults(blind=50.0))
    log = simulate(
        generate_track(np.random.default_rng(0)), SimulationSettings(laps=2, faults=faults), seed=0
    )
    result = run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma))
    assert log.truth is not None
    metrics = {lap: lap_metrics(lap_map, log.truth, lap) for lap, lap_map in result.lap_maps}
    assert metrics[1].missed > 0.05
    assert metrics[2].missed <= 0.02
    assert metrics[2].rmse < 0.3
    assert any(record.notice.startswith(REPAIRED) for record in result.cycles)
    assert LOST not in {record.health for record in result.cycles}
