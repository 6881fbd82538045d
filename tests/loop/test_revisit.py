"""Revisits: which places are some, how certain they are, and what they make of the drive of a skidpad."""

from __future__ import annotations

from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, MapperSettings
from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import move_points, to_vehicle
from pathspace_graph.graph.relative import revisit_rows
from pathspace_graph.io.log import Log
from pathspace_graph.loop import revisit as revisit_module
from pathspace_graph.loop.revisit import Revisits, earlier_pass
from pathspace_graph.run import CycleResult
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import skidpad

from ..scenes import drives
from ..scenes.drives import beginning, map_log, path_of, true_poses

STEP = 1.0
SECONDS, PERIOD = 24.0, 0.1
"""The drive of the skidpad ends in the second round."""


along = partial(path_of, STEP)


ROUND = 2.0 * np.pi * 9.125


def test_the_second_round_of_a_circle_that_was_entered_is_a_revisit() -> None:
    entry, on_round = (15.0, 0.0), (ROUND, -1.0 / 9.125)
    assert earlier_pass(along(entry, (0.8 * ROUND, -1.0 / 9.125))) is None
    place = earlier_pass(along(entry, on_round, (20.0, -1.0 / 9.125)))
    assert place is not None
    assert place == pytest.approx(15 + 20, abs=2)
    third = earlier_pass(along(entry, on_round, on_round, (20.0, -1.0 / 9.125)))
    assert third == pytest.approx(15 + 20, abs=3)  # the first pass, not the second


def test_a_lap_that_comes_by_way_of_its_start_is_none() -> None:
    lap = along((200.0, 2.0 * np.pi / 200.0), (60.0, 2.0 * np.pi / 200.0))
    assert earlier_pass(lap) is None


@pytest.mark.parametrize("turn", [np.pi, 0.5 * np.pi])
def test_a_road_that_is_crossed_or_driven_the_other_way_is_none(turn: float) -> None:
    there = along((60.0, 0.0), (turn * 10.0, 0.1), (20.0, 0.0), ((2.0 * np.pi - turn) * 10.0, 0.1))
    crossing = along((60.0, 0.0), (1.5 * np.pi * 10.0, 0.1), (30.0, 0.0))
    assert earlier_pass(crossing) is None
    back = there[::-1] + np.array([0.0, 0.0, np.pi])
    assert earlier_pass(np.concatenate([there, back])) is None


def test_an_opposite_pass_whose_ways_part_is_none() -> None:
    """The vehicle turns in a loop at the end of a road, and drives back on it after another way."""
    way = along((40.0, 0.0), (60.0, 0.0), (1.5 * np.pi * 10.0, 0.1), (20.0, 0.0))
    back = np.array([70.0, 0.5, np.pi])
    elsewhere = along((12.0, 0.0)) + np.array([90.0, 40.0, 0.0])
    passes = np.concatenate([way, elsewhere, back[None]])
    assert earlier_pass(passes) is None
    passes[-1, 2] = 0.0
    assert earlier_pass(passes) == pytest.approx(70, abs=1)


def test_what_is_fixed_to_the_vehicle_stays_so_after_a_jump_that_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Path, tracks and cones move by the motion that takes the newest pose from before to after."""
    before, after = np.array([10.0, 4.0, 0.5]), np.array([12.0, -3.0, 1.7])
    cone, moved = np.array([[15.0, 6.0]]), list[Array]()
    road = SimpleNamespace(
        poses=before[None].copy(), smoother=None, settings=MapperSettings(), move=moved.append
    )

    def solve(*_: object) -> dict[int, Array]:
        road.poses[-1] = after
        return {}

    monkeypatch.setattr(revisit_module, "solve_revisit", solve)
    record, measured = SimpleNamespace(bent=lambda *_: None), SimpleNamespace(factor=lambda: None)
    jump = revisit_module.lay_on(road, record, measured)  # type: ignore[arg-type]
    np.testing.assert_array_equal(jump, after - before)
    seen = to_vehicle(cone, before[None])
    np.testing.assert_allclose(to_vehicle(move_points(moved[0], cone), after[None]), seen, atol=1e-9)


# --- the drive of a skidpad ------------------------------------------------------------------------------


@cache
def drive() -> Log:
    log = simulate(skidpad(), SimulationSettings(), 2)
    return beginning(log, int(SECONDS / PERIOD))


@cache
def mapped() -> tuple[FixedLagMapper, list[CycleResult]]:
    return map_log(drive())


def errors(poses: Array, truth: Array) -> Array:
    """Return the distances (n,) of poses (n, 3) from the true ones (m)."""
    return np.hypot(*(poses - truth[: len(poses)])[:, :2].T)


def test_revisits_are_as_certain_as_they_say() -> None:
    mapper, _ = mapped()
    truth = true_poses(drive())
    assert len(mapper.revisits) >= 3
    for revisit in mapper.revisits:
        assert np.abs(revisit_rows([revisit], truth)[0].residual).max() < 4.0


def test_the_map_is_better_for_them_and_nothing_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, results = mapped()
    truth = true_poses(drive())
    notices = [result.notice for result in results if "driven before" in result.notice]
    assert len(notices) == 1 and not mapper.closed and mapper.failures == 0
    jumps = [result.jump for result in results if result.jump is not None]
    assert len(jumps) == len(mapper.revisits)
    with_them = errors(np.array([result.pose for result in results]), truth)
    smoothed = errors(mapper.corrected_poses, truth)
    monkeypatch.setattr(Revisits, "find", lambda *_: None)
    _, without = map_log(drive())
    alone = errors(np.array([result.pose for result in without]), truth)
    assert with_them[-50:].mean() < 0.5 * alone[-50:].mean()
    assert smoothed.mean() < 0.5 * alone.mean()


def test_the_batch_takes_them_from_the_online_run() -> None:
    log, truth = drive(), true_poses(drive())
    result = BatchMapper(None, log.odometry_sigma, FixedLagMapper).solve(log, "online")
    assert len(result.system.revisits) == len(mapped()[0].revisits)
    assert result.converged
    assert errors(result.trajectory, truth).mean() < 0.2
    ordering = result.optimum.state.variables.layout.ordering
    theirs = result.graph().linearize(result.values()).hessian(ordering)[0]
    ours = result.system.linear_graph(result.optimum).hessian(ordering)[0]
    traces = [np.trace(matrix[-3:-1, -3:-1]) for matrix in (theirs, ours)]
    assert traces[0] == pytest.approx(traces[1])


def test_a_window_that_holds_the_whole_drive_has_none_and_fails_in_no_cycle() -> None:
    settings = MapperSettings(lag=60.0, max_poses=1000)
    log = beginning(drive(), 130)
    mapper, _ = map_log(log, FixedLagMapper(settings, log.odometry_sigma))
    assert mapper.failures == 0 and not mapper.revisits


def test_a_lap_that_closes_has_none() -> None:
    mapper, _ = drives.mapped(drives.exact_lap())
    assert mapper.closed and not mapper.revisits
