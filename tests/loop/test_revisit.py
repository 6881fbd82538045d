"""Revisits: which places are some, how certain they are, and what they make of the drive of a skidpad."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, MapperSettings
from pathspace_graph.batch.lap import LapMarginal, OpenLap, lap_optimum, solve_lap
from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.batch.start import REVISIT_INTERVAL
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths, relative, to_vehicle
from pathspace_graph.graph.gaussian import keys_of, normal_equations
from pathspace_graph.graph.rows import revisit_rows
from pathspace_graph.graph.variables import Layout
from pathspace_graph.io.log import Log
from pathspace_graph.loop import drive as drive_module
from pathspace_graph.loop import open as open_road
from pathspace_graph.loop.drive import Drive, DriveRecord, Step
from pathspace_graph.loop.lap_solver import Outcome
from pathspace_graph.loop.open import NOT_REVISITED, TOO_LONG, Open, Revisits, earlier_pass
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import GivenFactor
from pathspace_graph.run import CycleResult
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import skidpad

from ..scenes import drives
from ..scenes.batch import information_of
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


def test_a_found_revisit_rests_the_search_for_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts are 3 m apart, and 15 m after one that has found something."""
    found, tried = SimpleNamespace(), list[float]()
    smoother = SimpleNamespace(first_cycle=9, variables=SimpleNamespace(sensor=np.zeros(0)))
    road = SimpleNamespace(path=SimpleNamespace(length=0.0), smoother=smoother)
    record = SimpleNamespace(with_window=lambda _: np.zeros((20, 3)), seen_in=lambda *_: None)
    monkeypatch.setattr(open_road, "earlier_pass", lambda _: tried.append(road.path.length) or 3)
    monkeypatch.setattr(open_road, "newest_place", lambda *_: found if road.path.length > 40.0 else None)
    monkeypatch.setattr(open_road, "revisit_of", lambda *_: found)
    search = Revisits(MapperSettings())
    for length in np.arange(0.0, 70.0, 0.5).tolist():
        road.path.length = length
        search.find(road, record, None)  # type: ignore[arg-type]
    assert tried == [30.0, 33.0, 36.0, 39.0, 42.0, 57.0]


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


def test_the_map_of_a_long_open_road_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_road, "MOST_LAID_ON", 10)
    mapper, results = map_log(drive())
    assert [one.notice for one in results if "not used" in one.notice] == [f"{NOT_REVISITED}: {TOO_LONG}"]
    assert mapper.revisits == () and all(one.jump is None for one in results)


@dataclass(frozen=True)
class Replaced:
    """An open road just before and after a batch has replaced its map."""

    marginal: LapMarginal
    before: Road
    after: Road
    jump: Array


@cache
def replaced() -> list[Replaced]:
    """Return the replacements of a drive, without the steps that follow each."""
    found, take = list[Replaced](), drive_module.take_marginal
    """The priors of the calibrations have changed since each batch began."""

    def take_marginal(road: Road, marginal: LapMarginal, given: Sequence[GivenFactor]) -> Array:
        before, after = road.copy(), road.copy()
        mean, sigma = after.smoother.calibration_prior
        after.smoother.set_calibration_priors(mean + 0.1 * sigma, 0.5 * sigma)
        with pytest.MonkeyPatch.context() as without_steps:
            without_steps.setattr(CurveSmoother, "step", lambda *_: None)
            found.append(Replaced(marginal, before, after, take(after, marginal, given)))
        return take(road, marginal, given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive_module, "take_marginal", take_marginal)
        map_log(drive())
    assert len(found) >= 3
    return found


def test_poses_before_the_end_of_a_batch_are_its_own_and_later_ones_move_rigidly() -> None:
    for one in replaced():
        solved, poses = one.marginal.poses[one.marginal.first_kept :], one.after.poses
        np.testing.assert_allclose(poses[: len(solved)], solved, atol=1e-9)
        earlier = one.before.poses[len(one.before.poses) - len(poses) :]
        for k in range(len(solved), len(poses)):
            driven = relative(earlier[len(solved) - 1], earlier[k])
            np.testing.assert_allclose(relative(solved[-1], poses[k])[:2], driven[:2], atol=1e-9)
        np.testing.assert_allclose(one.jump, poses[-1] - earlier[-1], atol=1e-9)


def test_what_is_fixed_to_the_vehicle_stays_so() -> None:
    """The end that has grown since, its cones, and the driven path have the same place in its frame."""
    grown = 0
    for one in replaced():
        before, after = one.before.poses[-1:], one.after.poses[-1:]
        for label, boundary in one.after.boundaries.items():
            known = one.before.boundaries[label]
            seen = to_vehicle(known.observed, before)
            np.testing.assert_allclose(to_vehicle(boundary.observed, after), seen, atol=1e-9)
            old, new = (road.smoother.map.state.control_points(label) for road in (one.before, one.after))
            spline = one.marginal.splines[label]
            if boundary.confirmed_end == one.marginal.ends[label]:
                np.testing.assert_array_equal(new[: spline.size], spline.control_points)
                continue
            placed = boundary.settled(spline.size, boundary.last_cone(one.marginal.ends[label]))
            grown += len(new) - placed
            np.testing.assert_array_equal(new[:placed], spline.control_points[:placed])
            at = to_vehicle(old[placed:], before)
            np.testing.assert_allclose(to_vehicle(new[placed:], after), at, atol=1e-9)
    assert grown > 10


def test_the_prior_is_the_marginal_with_the_present_priors_of_the_calibrations() -> None:
    for one in replaced():
        smoother, marginal = one.after.smoother, one.marginal
        layout = Layout(np.sort(keys_of(smoother.prior)))
        information, vector = normal_equations(smoother.prior, layout)
        own, expected = slice(0, len(marginal.calibration)), information_of(marginal).copy()
        (mean, sigma), (mean_then, sigma_then) = smoother.calibration_prior, marginal.calibration_prior
        expected[own, own] += np.diag(sigma**-2.0 - sigma_then**-2.0)
        scale = np.sqrt(np.diagonal(expected))
        assert np.abs((information - expected) / np.outer(scale, scale)).max() < 1e-9
        right = information_of(marginal) @ marginal.mean
        right[own] += mean / sigma**2 - mean_then / sigma_then**2
        reference = smoother.variables.reference[smoother.variables.layout.entries(layout.keys)]
        off = reference + np.linalg.solve(information, vector) - np.linalg.solve(expected, right)
        assert off @ information @ off < 1e-6


def test_a_curve_that_was_taken_back_meanwhile_keeps_its_map(monkeypatch: pytest.MonkeyPatch) -> None:
    take = Open.take

    def taken_back(self: Open, road: Road, drive: Drive, outcome: Outcome) -> Step:
        road.growth.taken_back += 1
        return take(self, road, drive, outcome)

    monkeypatch.setattr(Open, "take", taken_back)
    mapper, results = map_log(drive())
    assert not mapper.revisits and all(result.jump is None for result in results)
    assert any(result.notice == f"{NOT_REVISITED}: a curve was taken back" for result in results)


@cache
def sent() -> tuple[FixedLagMapper, list[OpenLap]]:
    """Return the mapper after the drive, and what its batches got."""
    laps, record = list[OpenLap](), DriveRecord.lap

    def lap(self: DriveRecord, *arguments: Any, **options: Any) -> OpenLap:
        laps.append(record(self, *arguments, **options))
        return laps[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DriveRecord, "lap", lap)
        mapper, _ = map_log(drive())
    return mapper, laps


def test_a_batch_has_all_revisits_so_far_some_metres_apart() -> None:
    mapper, laps = sent()
    count = len(mapper.revisits)
    assert [len(lap.revisits) for lap in laps[:count]] == [*range(1, count + 1)]
    driven = path_lengths(true_poses(drive()))[[one.later for one in mapper.revisits]]
    assert np.diff(driven).min() > REVISIT_INTERVAL - 1.0


def test_an_open_road_is_solved_as_the_window_has_it() -> None:
    """On its own knots, with the window's standard deviation across a curve and its confirmed ends."""
    lap = sent()[1][0]
    assert lap.start is not None and lap.start.is_open
    system, at, _ = lap_optimum(lap)
    assert system.settings == lap.settings
    for label, boundary in at.state.boundaries.items():
        assert boundary.confirmed_end == lap.start.ends[label] < boundary.tables.high
        np.testing.assert_array_equal(boundary.knots, lap.start.splines[label].knots)


@pytest.mark.parametrize("gaps", [0, 1, -1])
def test_a_revisit_that_is_off_by_a_gap_of_cones_is_refused(gaps: int) -> None:
    """No closed curve speaks against it: it contradicts the odometry, and the revisits before it."""
    _, laps = sent()
    for lap in laps[:2]:
        newest, *earlier = lap.revisits
        moved = replace(newest, local=newest.local + np.array([4.0 * gaps, 0.0, 0.0]))
        solved = solve_lap(replace(lap, revisits=(moved, *earlier)))
        assert ("sigmas from the odometry" in solved.objection) == (gaps != 0)


def test_a_marginal_leaves_the_slide_of_an_open_end_to_the_window() -> None:
    """Hardly anything is known of it: growth places the last control points again."""
    for one in replaced():
        covariance, at = np.linalg.inv(information_of(one.marginal)), len(one.marginal.calibration)
        for spline in one.marginal.splines.values():
            at += 2 * spline.size
            along = spline.tangent_unit(np.array(spline.domain[1:]))[0]
            assert along @ covariance[at - 2 : at, at - 2 : at] @ along > 1.0**2


def test_the_batch_takes_them_from_the_online_run() -> None:
    log, truth = drive(), true_poses(drive())
    result = BatchMapper(None, log.odometry_sigma, FixedLagMapper).solve(log, "online")
    assert len(result.system.revisits) == len(mapped()[0].revisits)
    assert result.converged
    assert errors(result.trajectory, truth).mean() < 0.2
    ordering = result.optimum.state.variables.layout.ordering
    theirs = result.graph().linearize(result.values()).hessian(ordering)[0]
    at = result.system.evaluate(result.optimum.state, hold=True)
    ours = result.system.linear_graph(at).hessian(ordering)[0]
    traces = [np.trace(matrix[-3:-1, -3:-1]) for matrix in (theirs, ours)]
    assert traces[0] == pytest.approx(traces[1])


def test_a_window_that_holds_the_whole_drive_has_none_and_fails_in_no_cycle() -> None:
    settings = MapperSettings(lag=60.0, max_poses=1000)
    log = beginning(drive(), 180)
    mapper, _ = map_log(log, FixedLagMapper(settings, log.odometry_sigma))
    assert mapper.failures == 0 and not mapper.revisits


def test_a_lap_that_closes_has_none() -> None:
    mapper, _ = drives.mapped(drives.exact_lap())
    assert mapper.closed and not mapper.revisits
