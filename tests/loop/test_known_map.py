"""A known map: the vehicle finds its place on it and nowhere else, refines, keeps or repairs it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.batch.known_map import FLOOR, KnownMap, map_of_cones
from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import compose
from pathspace_graph.health import DEGRADED, GOOD
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.closed import Closed
from pathspace_graph.loop.known_loop import REPAIRED
from pathspace_graph.loop.open import PLACED, SEEKING, OnOpenMap, Open
from pathspace_graph.online.fixed_lag import FixedLagMapper, _Before
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import acceleration, skidpad, to_map_frame
from pathspace_graph.spline.boundary import sampled

from ..scenes.drives import ODOMETRY_SIGMA, true_poses
from ..scenes.kidnapped import begun_later, laps_log, pear_track
from ..scenes.maps import point_map

Array = NDArray[np.float64]
Results = list[CycleResult]

SIGMA = 0.15
"""Standard deviation of the cones of a known map (m)."""


def pear_map(skew: float = 0.15, moved: float = 0.0) -> Map:
    """The map of the cones of a track; some of the left ones may stand farther out (m)."""
    track = to_map_frame(pear_track(skew))
    left = track.left.copy()
    middle = left.mean(axis=0)
    some = slice(12, 19)
    outward = left[some] - middle
    left[some] += moved * outward / np.hypot(*outward.T)[:, None]
    return map_of_cones(left, track.right, True, SIGMA)


def drive_on(mapper: FixedLagMapper, log: Log, seconds: float = np.inf) -> Results:
    """The results of the cycles of a log's first seconds."""
    results, begin = [], float(log.odometry.t[0])
    for odometry, cycle in split_odometry(log):
        if cycle.t > begin + seconds:
            break
        mapper.wait()
        results.append(mapper.update(odometry, cycle, strict=True))
    return results


def errors(results: Results, log: Log, begin: Array) -> Array:
    """How far the vehicle is from its true places on the map (m), which began at a pose of it."""
    truth = [compose(begin, pose) for pose in true_poses(log)[: len(results)]]
    return np.hypot(*(np.array([result.pose for result in results]) - truth)[:, :2].T)


def placed(results: Results) -> int:
    """The only cycle in which the vehicle was found on the map."""
    (cycle,) = [k for k, result in enumerate(results) if PLACED in result.notice]
    return cycle


@cache
def found_after(t: float) -> tuple[FixedLagMapper, Results, Log, Array]:
    log, begin = begun_later(laps_log(pear_track()), t)
    mapper = FixedLagMapper.on(pear_map(), None, ODOMETRY_SIGMA)
    return mapper, drive_on(mapper, log, 12.0), log, begin


@pytest.mark.parametrize("t", [0.0, 7.0, 12.6])
def test_a_vehicle_that_begins_anywhere_is_found_and_followed(t: float) -> None:
    mapper, results, log, begin = found_after(t)
    first = placed(results)
    assert results[first].t - log.odometry.t[0] < 8.0
    assert mapper.placed_at == results[first].t
    away = errors(results, log, begin)[first:]
    assert np.sqrt(np.mean(away**2)) < 0.12
    assert isinstance(mapper.phase, Closed)
    assert mapper.closed


def test_until_it_is_found_the_vehicle_maps_a_road_of_its_own() -> None:
    _, results, log, _ = found_after(7.0)
    first = placed(results)
    assert not any(result.closed for result in results[:first])
    assert errors(results[:first], log, np.zeros(3)).max() < 0.3
    assert {result.health.reason for result in results[5:first]} == {SEEKING}
    assert results[first].health.condition == DEGRADED
    assert results[first + 20].health.condition == GOOD


def test_the_path_of_before_is_laid_on_the_map() -> None:
    mapper, results, log, begin = found_after(7.0)
    first = placed(results)
    stamps = np.array([result.t for result in results[:first]])
    truth = np.array([compose(begin, pose) for pose in true_poses(log)[:first]])
    assert np.hypot(*(mapper.smoothed(stamps) - truth)[:, :2].T).max() < 0.4


def test_the_driven_path_is_laid_on_the_map() -> None:
    """Most of it was driven before the vehicle was found, after 4 s."""
    log, begin = begun_later(laps_log(pear_track()), 7.0)
    mapper = FixedLagMapper.on(pear_map(), None, ODOMETRY_SIGMA)
    first = placed(drive_on(mapper, log, 4.5))
    truth = np.array([compose(begin, pose) for pose in true_poses(log)])
    assert mapper.road.path.stations[0] == 0.0 and first >= 30
    assert KDTree(truth[:, :2]).query(mapper.road.path.points)[0].max() < 1.0


def test_on_the_map_of_another_track_the_vehicle_is_never_found() -> None:
    log = laps_log(pear_track())
    mapper = FixedLagMapper.on(pear_map(skew=0.35), None, ODOMETRY_SIGMA)
    results = drive_on(mapper, replace(log, cycles=log.cycles[:180]))
    assert mapper.placed_at is None
    assert errors(results, log, np.zeros(3)).max() < 1.0


def test_of_two_places_that_look_the_same_none_is_taken() -> None:
    log = laps_log(pear_track(skew=0.0), laps=2)
    mapper = FixedLagMapper.on(pear_map(skew=0.0), None, ODOMETRY_SIGMA)
    drive_on(mapper, log, 10.0)
    assert mapper.placed_at is None


def test_a_start_chooses_between_two_places_that_look_the_same() -> None:
    log = laps_log(pear_track(skew=0.0), laps=2)
    start = np.array([0.5, -0.3, 0.1])
    mapper = FixedLagMapper.on(pear_map(skew=0.0), None, ODOMETRY_SIGMA, start=start)
    results = drive_on(mapper, log, 10.0)
    first = placed(results)
    assert results[first].t <= 2.0
    assert errors(results, log, np.zeros(3))[first + 30 :].max() < 0.4


def test_the_map_is_the_prior_and_what_is_seen_refines_it() -> None:
    before = KnownMap.of(pear_map()).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(before)), np.hypot(SIGMA, FLOOR))
    mapper = found_after(0.0)[0]
    keys = np.concatenate([mapper.control_keys(label) for label in (LEFT, RIGHT)])
    after = mapper.marginal_covariance(keys.tolist())
    assert np.sqrt(np.diag(after)).max() < 1.01 * np.hypot(SIGMA, FLOOR)
    assert np.median(np.sqrt(np.diag(after))) < 0.9 * SIGMA


def test_a_map_that_is_kept_stays_as_it_is() -> None:
    log, known = laps_log(pear_track()), pear_map(moved=0.8)
    mapper = FixedLagMapper.on(known, None, ODOMETRY_SIGMA, start=np.zeros(3), keep=True)
    drive_on(mapper, log, 20.0)
    assert mapper.placed_at is not None
    for label in (LEFT, RIGHT):
        spline = known.splines[label]
        np.testing.assert_allclose(mapper.control_points(label), spline.distinct_control_points, atol=0.02)


def test_cones_that_were_moved_since_are_led_through() -> None:
    """Seven cones of the left boundary stand 2.5 m from where the map has them."""
    log = laps_log(pear_track())
    mapper = FixedLagMapper.on(pear_map(moved=2.5), None, ODOMETRY_SIGMA)
    results = drive_on(mapper, log)
    assert any(REPAIRED in result.notice for result in results)
    cones = to_map_frame(pear_track()).left
    before = KDTree(sampled(pear_map(moved=2.5).splines[LEFT], 0.1)).query(cones)[0]
    after = KDTree(sampled(mapper.map().splines[LEFT], 0.1)).query(cones)[0]
    assert before.max() > 1.5
    assert after.max() < 0.4


@pytest.mark.parametrize("event", [skidpad, acceleration])
def test_the_events_of_the_rules_are_driven_from_their_start(event: object) -> None:
    track = event()  # type: ignore[operator]
    log = simulate(track, SimulationSettings(), seed=5)
    known = map_of_cones(*track.rows, False, SIGMA)
    mapper = FixedLagMapper.on(known, None, log.odometry_sigma, start=track.start)
    results = drive_on(mapper, log)
    first = placed(results)
    away = errors(results, log, track.start)[first:]
    assert results[first].t < 3.0
    assert np.sqrt(np.mean(away**2)) < 0.15
    assert isinstance(mapper.phase, OnOpenMap)
    assert not mapper.closed


@pytest.mark.parametrize("is_whole", [False, True])
def test_an_open_map_grows_past_a_tentative_end(is_whole: bool) -> None:
    """The map is of half a lap, and the drive goes on."""
    log, track = laps_log(pear_track()), to_map_frame(pear_track())
    begin = int(np.hypot(*track.left.T).argmin())
    half = [np.roll(row, -begin, axis=0)[: len(row) // 2] for row in (track.left, track.right)]
    known = map_of_cones(*half, False, SIGMA)
    if not is_whole:
        tentative = {
            label: replace(one, confirmed_until=one.spline.domain[1] - 1.0)
            for label, one in known.boundaries.items()
            if isinstance(one, SplineBoundary)
        }
        known = replace(known, boundaries=tentative)
    mapper = FixedLagMapper.on(known, None, ODOMETRY_SIGMA, start=np.zeros(3))
    results = drive_on(mapper, log, 7.0 if is_whole else 13.0)
    assert isinstance(mapper.phase, OnOpenMap)
    away = errors(results, log, np.zeros(3))
    assert away.max() < 0.5
    ends = [boundary.confirmed_end for boundary in mapper.boundaries.values()]
    if is_whole:
        assert max(ends) < 60.0  # the half lap has about 52 m
    else:
        assert min(ends) > 70.0


def test_a_failed_cycle_is_taken_back_whole() -> None:
    """A mapper that is given back what it was before each cycle ends with the bits of one that is not."""
    log = laps_log(pear_track())
    ways = [FixedLagMapper.on(pear_map(), None, ODOMETRY_SIGMA) for _ in range(2)]
    for cycle in islice(split_odometry(log), 90):
        ways[1]._go_back(_Before.of(ways[1]))
        for mapper in ways:
            mapper.update(*cycle, strict=True)
    assert [type(mapper.phase) for mapper in ways] == [Closed, Closed]
    np.testing.assert_array_equal(ways[0].poses, ways[1].poses)
    np.testing.assert_array_equal(ways[0].control_points(LEFT), ways[1].control_points(LEFT))


def test_a_failed_search_leaves_the_road_alone() -> None:
    """The road of its own is the one of a mapper without a known map, to the last bit."""
    log = laps_log(pear_track())
    log = replace(log, cycles=log.cycles[:60])
    seeking = FixedLagMapper.on(pear_map(skew=0.35), None, ODOMETRY_SIGMA)
    alone = FixedLagMapper(None, ODOMETRY_SIGMA)
    for one in (seeking, alone):
        drive_on(one, log)
    assert isinstance(alone.phase, Open)
    np.testing.assert_array_equal(seeking.poses, alone.poses)
    np.testing.assert_array_equal(seeking.control_points(LEFT), alone.control_points(LEFT))


@pytest.mark.parametrize(("shift", "crosses"), [(0.0, False), (6.0, True)])
def test_boundaries_cross_but_for_a_level_crossing_of_their_road(shift: float, crosses: bool) -> None:
    """A figure of eight 80 m long, with 4 m between its boundaries, or with the right one shifted."""
    phi = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    line = 40.0 * np.column_stack([np.sin(phi), 0.5 * np.sin(2.0 * phi)])
    tangent = np.column_stack([np.cos(phi), np.cos(2.0 * phi)])
    left = 2.0 * np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    known = map_of_cones(line + left, line - left + [0.0, shift], True, SIGMA)
    assert KnownMap.of(known).crosses == crosses


def test_what_cannot_be_a_known_map_is_refused() -> None:
    whole = pear_map()
    bare = {label: SplineBoundary(one.spline, NO_COVARIANCE) for label, one in whole.boundaries.items()}  # type: ignore[union-attr]
    for track, expected in (
        (point_map(), "a known map: expected a curve as left boundary, found points in no order"),
        (replace(whole, boundaries={LEFT: whole.left}), "expected a curve as right boundary, found none"),
        (replace(whole, boundaries=bare), "a known map: expected a map with covariances, found one without"),
    ):
        with pytest.raises(SettingsError, match=expected):
            FixedLagMapper.on(track)
