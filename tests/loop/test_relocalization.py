"""Finding back: a vehicle that is put down elsewhere on a closed map is told to be lost, and found."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.factors.arrays import BoolArray
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.factors.se2 import compose, to_vehicle
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.graph.gaussian import factorize, marginalize
from pathspace_graph.graph.smoother import forget_poses
from pathspace_graph.graph.variables import Layout, pose_keys
from pathspace_graph.health import DEGRADED, GOOD, LOST, Evidence, Health
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.closed import FOUND, LEAST_PATH, WIDENING, Lost, Search, restart_window
from pathspace_graph.loop.known_loop import KnownLoop, evidence_of
from pathspace_graph.mapping.smoother import Gating
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.places.find import STRETCH, KnownRoad, Place
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import ODOMETRY_SIGMA, Mapped, detections, map_beginning, map_log, replay, true_poses
from ..scenes.kidnapped import laps_log, pear_track, put_down
from ..shared.copied import copied

Array = NDArray[np.float64]

SECOND_LAP = 20.0
"""The vehicle is put down elsewhere at this stamp (s), early in its second lap."""


NOTHING = Gating(np.zeros(0, np.intp), np.zeros(0, bool), np.zeros(0))
"""No detection was tested."""


@cache
def three_laps() -> Log:
    return laps_log(pear_track())


def put_down_on(distance: float) -> tuple[Log, Mapped]:
    """Returns the log of a vehicle that is put down farther on (m), and a mapper as it was until then."""
    log = put_down(three_laps(), SECOND_LAP, distance)
    return log, map_beginning(three_laps(), round(10.0 * SECOND_LAP))


@cache
def clean() -> tuple[Log, FixedLagMapper, list[CycleResult]]:
    log = laps_log(pear_track(), laps=2)
    return log, *map_log(log, FixedLagMapper(None, log.noise))


def apart(log: Log, results: list[CycleResult]) -> Array:
    """Returns the distance (n,) of each cycle's position from the true one, in m."""
    return np.hypot(*(np.array([r.pose[:2] for r in results]) - true_poses(log)[:, :2]).T)


def reading_of(seen_again: BoolArray) -> Reading:
    """Returns a reading of a moving vehicle that says which of its detections (m,) were seen before."""
    odometry, nothing = Odometry(np.zeros(1), np.array([[8.0, 0.0, 0.0]])), np.zeros(0, np.intp)
    front_end = FrontEnd(MapperSettings(), KnownNoise(ODOMETRY_SIGMA))
    reading = front_end.update(odometry, detections(0.1, np.zeros((0, 2)), nothing))
    return replace(reading, seen_again=seen_again)


def test_a_clean_drive_is_good_in_every_cycle() -> None:
    _, _, results = clean()
    assert {result.health.condition for result in results} == {GOOD}
    assert FOUND not in {result.notice for result in results}


@pytest.mark.parametrize("distance", [5.0, 30.0])
def test_a_vehicle_that_is_put_down_farther_on_is_lost_and_found(distance: float) -> None:
    log, before = put_down_on(distance)
    results = map_log(log, *before)[1]
    conditions, stamps = [r.health.condition for r in results], [r.t for r in results]
    lost = stamps[conditions.index(LOST)]
    assert SECOND_LAP < lost < SECOND_LAP + 5.0
    (found,) = [k for k, result in enumerate(results) if result.notice == FOUND]
    jump = results[found].jump
    assert jump is not None and np.hypot(*jump[:2]) > 1.0
    assert conditions[found] == DEGRADED and set(conditions[found + 12 :]) == {GOOD}
    assert stamps[found] < lost + 6.0
    assert set(conditions[conditions.index(LOST) : found]) == {LOST}  # and not on new road
    assert apart(log, results)[found:].max() < 1.0
    assert results[found].stages["loop"] > 0.0


def test_the_map_does_not_move_while_the_vehicle_is_lost() -> None:
    log, (mapper, before) = put_down_on(30.0)
    assert log.truth is not None
    rmse_before = lap_metrics(mapper.map(), log.truth, 0).rmse
    known = list[Array]()
    for odometry, cycle in islice(split_odometry(log), len(before), None):
        result = replay(mapper, odometry, cycle)
        if result.notice == FOUND:
            break
        if result.health.condition == LOST:
            assert result.readings == 0
            known.append(np.concatenate([mapper.control_points(label) for label in (LEFT, RIGHT)]))
    assert len(known) > 10
    # the first steps bring the map back to what is known without the detections that were taken out of use
    moved = np.abs(np.diff(known, axis=0)).max(axis=(1, 2))
    assert moved[-5:].max() < 0.01
    assert lap_metrics(mapper.map(), log.truth, 0).rmse < 1.1 * rmse_before


def test_two_places_that_look_alike_are_not_told_apart() -> None:
    log = put_down(laps_log(pear_track(skew=0.0)), SECOND_LAP, 12.0)
    log = replace(log, cycles=log.cycles[: round(10.0 * (SECOND_LAP + 15.0))])
    _, results = map_log(log, FixedLagMapper(None, log.noise))
    assert results[-1].health.condition == LOST
    assert FOUND not in {result.notice for result in results}


def test_the_uncertainty_of_the_position_is_that_of_the_last_step() -> None:
    smoother = clean()[1].road.smoother
    assert smoother.last_step is not None
    newest = smoother.last_step.layout.keys[-1:]
    covariance = smoother.last_step.covariance(newest)[:2, :2]
    sigma = evidence_of(smoother, NOTHING, KnownLoop(), reading_of(np.zeros(0, bool))).sigma
    np.testing.assert_allclose(sigma, np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def test_detections_across_the_infield_are_explained_by_the_map_and_ghosts_are_not() -> None:
    mapper = copied(clean()[1])
    smoother, table = mapper.road.smoother, mapper.road.smoother.map.detections
    left = mapper.boundaries[LEFT].spline(mapper.control_points(LEFT))
    far = left.evaluate(np.array([20.0, 45.0]))
    ghosts = np.array([[200.0, 0.0], [0.0, 200.0]])
    seen = to_vehicle(np.concatenate([far, ghosts]), np.tile(mapper.poses[-1], (4, 1)))
    rows = table.append(detections(0.0, seen, np.full(4, LEFT)), smoother.next_cycle - 1)
    tested = Gating(np.arange(rows.start, rows.stop), np.zeros(4, bool), np.full(4, 9.0))
    before = smoother.variables.values.copy()
    evidence = evidence_of(smoother, tested, KnownLoop(), reading_of(np.ones(4, bool)))
    assert (evidence.offered, evidence.explained, evidence.used) == (4, 2, 0)
    np.testing.assert_array_equal(smoother.variables.values, before)
    once = evidence_of(smoother, tested, KnownLoop(), reading_of(np.array([True, True, True, False])))
    assert (once.offered, once.explained) == (3, 2)


def test_a_wrong_colour_says_nothing_about_the_vehicle() -> None:
    """Detections on the right curve that are called left, and one on the left curve."""
    mapper = copied(clean()[1])
    smoother, table = mapper.road.smoother, mapper.road.smoother.map.detections
    right, left = (mapper.boundaries[b].spline(mapper.control_points(b)) for b in (RIGHT, LEFT))
    points = np.concatenate([right.evaluate(np.array([10.0, 40.0])), left.evaluate(np.array([20.0]))])
    seen = to_vehicle(points, np.tile(mapper.poses[-1], (3, 1)))
    rows = table.append(detections(0.0, seen, np.full(3, LEFT)), smoother.next_cycle - 1)
    tested = Gating(np.arange(rows.start, rows.stop), np.zeros(3, bool), np.full(3, 9.0))
    evidence = evidence_of(smoother, tested, KnownLoop(), reading_of(np.ones(3, bool)))
    assert (evidence.offered, evidence.explained) == (1, 1)


# --- the search alone ------------------------------------------------------------------------------------


@cache
def known_road(has_cones: bool) -> KnownRoad:
    """The map of a clean drive, with its cones or without."""
    track = clean()[1].road.smoother.map
    return KnownRoad.of(track.state.splines, track.cones if has_cones else None)


def searched(has_cones: bool, away: Array, cycles: slice) -> list[Place | None]:
    """The results of a search along true poses, all moved by a motion (3,)."""
    log, mapper, _ = clean()
    search, found = Search(mapper.road, known_road(has_cones)), list[Place | None]()
    search._tried = -np.inf
    for pose, cycle in zip(true_poses(log)[cycles], log.cycles[cycles], strict=True):
        search.observe(compose(away, pose), cycle)
        found.append(search.find())
    return found


@pytest.mark.parametrize("has_cones", [True, False])
def test_a_vehicle_is_found_wherever_its_odometry_has_it(has_cones: bool) -> None:
    """By its cones after 60 m, without cones on the curves alone."""
    log, cycles = clean()[0], slice(140, 215)
    found = searched(has_cones, np.array([25.0, -8.0, 1.2]), cycles)
    sure = [k for k, place in enumerate(found) if place is not None]
    assert sure
    for k in sure:
        place = found[k]
        assert place is not None
        off = place.pose - true_poses(log)[cycles][k]
        np.testing.assert_allclose(off[:2], 0.0, atol=0.5)
        np.testing.assert_allclose(np.sin(off[2]), 0.0, atol=0.05)


def test_nothing_is_found_before_the_path_has_a_shape() -> None:
    log = clean()[0]
    found = searched(True, np.zeros(3), slice(150, 175))
    driven = np.hypot(*np.diff(true_poses(log)[150:175, :2], axis=0).T).cumsum()
    assert all(place is None for place in found[: int(driven.searchsorted(LEAST_PATH))])


def test_the_prior_of_a_place_that_was_found_has_three_times_its_sigmas() -> None:
    """Its detections are used once more, in the window: without them, only the prior is left."""
    smoother = copied(clean()[1].road.smoother)
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.002], [0.0, 0.002, 0.01]])
    pose = smoother.map.state.poses[-1] + [0.1, -0.05, 0.01]
    jump = restart_window(smoother, smoother.next_cycle - 5, Place(pose, np.linalg.inv(covariance), 9.0))
    assert np.hypot(*jump[:2]) < 0.3
    smoother.map.detections.release(np.arange(len(smoother.map.detections)))
    newest = pose_keys(np.array([smoother.next_cycle - 1]))
    np.testing.assert_allclose(smoother.covariance(newest), WIDENING**2 * covariance, atol=1e-6)


def test_what_has_shown_that_a_vehicle_is_lost_says_nothing_once_it_is_found() -> None:
    mapper = copied(clean()[1])
    road, drive, t = mapper.road, mapper.drive, mapper.road.smoother.times[-1]
    wrong = Evidence(t, offered=20, closed=True, sigma=0.1)
    right = Evidence(t + 0.1, offered=10, explained=10, used=10, closed=True, sigma=0.1)
    drive.monitor.restart()
    lost = Lost(mapper.phase, road, drive.monitor.update(wrong))
    search: Any = SimpleNamespace(find=lambda: Place(road.poses[-1], np.eye(3), 9.0), first_cycle=0)
    lost.search = search
    nothing = reading_of(np.zeros(0, bool))
    assert drive.copy().monitor.update(right).condition == LOST
    step = lost.step(road, drive, nothing, 0.0)
    assert step.phase is mapper.phase and step.notice == FOUND
    assert drive.monitor.update(right) == Health(GOOD)


def test_the_remembered_path_has_a_bound() -> None:
    log, mapper, _ = clean()
    search = Search(mapper.road, known_road(True))
    for pose, cycle in zip(true_poses(log), log.cycles, strict=True):
        search.observe(pose, cycle)
    poses = np.array(search._poses)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() <= STRETCH


def test_forgetting_the_poses_keeps_all_that_the_prior_knows_of_the_map() -> None:
    smoother = copied(clean()[1].road.smoother)
    smoother.reactivate()
    window = pose_keys(np.arange(smoother.first_cycle, smoother.next_cycle))
    others = np.setdiff1d(smoother.layout.keys, window)
    before = factorize(marginalize(smoother.prior, window), Layout(others)).covariance(others)
    first = smoother.next_cycle - 10
    forget_poses(smoother, first)
    assert smoother.first_cycle == first and len(smoother.times) == 10
    np.testing.assert_allclose(factorize(smoother.prior, Layout(others)).covariance(others), before)
    covariance = np.diag([0.04, 0.09, 0.01])
    smoother.add_pose_prior(smoother.next_cycle - 1, covariance)
    smoother.map.detections.release(np.arange(len(smoother.map.detections)))
    np.testing.assert_allclose(smoother.covariance(window[-1:]), covariance, atol=1e-9)
