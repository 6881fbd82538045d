"""The online mapper: a noisy lap, exact drives with something wrong in them, and odometry alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.accuracy import cone_distances, lap_metrics
from pathspace_graph.eval.metrics.trajectory import position_rms, trajectory_errors
from pathspace_graph.io.log import Detections, Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.mapping.road import Road
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import GaugeSettings, GrowthSettings, MapperSettings, SidesSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.sim.vehicle import integrate

from ..scenes.drives import (
    CYCLE,
    DT,
    ODOMETRY_SIGMA,
    ahead,
    bean_track,
    corridor,
    detections,
    exact_log,
    lap_log,
    map_log,
    noisy,
    true_poses,
)

Array = NDArray[np.float64]


def truth_of(log: Log) -> Truth:
    assert log.truth is not None
    return log.truth


def poses_of(results: list[CycleResult]) -> Array:
    return np.array([result.pose for result in results])


def straightness(track: Map, label: int, y: float, until: float) -> float:
    """Greatest distance (m) of a mapped straight from its line, as far as x = until."""
    boundary = track.boundaries[label]
    assert isinstance(boundary, SplineBoundary)
    low, high = boundary.spline.domain
    points = boundary.spline.evaluate(np.linspace(low, high, 400))
    inside = points[:, 0] < until
    return float(np.abs(points[inside, 1] - y).max())


def reaches(track: Map, label: int, x: float) -> bool:
    boundary = track.boundaries[label]
    assert isinstance(boundary, SplineBoundary)
    return bool(boundary.spline.evaluate(np.array(boundary.spline.domain))[:, 0].max() > x)


# --- a noisy lap -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lap() -> Log:
    settings = TrackGeneratorSettings(lap_length=(200.0, 240.0), cones=120)
    return simulate(generate_track(np.random.default_rng(0), settings), SimulationSettings(laps=1), 0)


@pytest.fixture(scope="module")
def mapped(lap: Log) -> tuple[FixedLagMapper, list[CycleResult]]:
    return map_log(lap)


def test_a_noisy_lap_is_mapped(lap: Log, mapped: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    mapper, results = mapped
    figures = lap_metrics(mapper.map(), truth_of(lap), 1)
    assert figures.rmse < 1.0
    assert figures.missed < 0.05
    t = np.array([result.t for result in results])
    assert position_rms(trajectory_errors(t, poses_of(results), truth_of(lap))) < 2.5
    assert t.tolist() == [cycle.t for cycle in lap.cycles]


def test_boundaries_grow_until_they_close(mapped: tuple[FixedLagMapper, list[CycleResult]]) -> None:
    """Control points a few metres apart along a lap of 200 to 240 m."""
    _, results = mapped
    sizes = np.array([result.sizes for result in results if not result.closed])
    assert (np.diff(sizes, axis=0) >= 0).all()
    assert (sizes[0] == 0).all()
    assert (sizes[-1] > 40).all()
    assert (sizes[-1] < 120).all()


def test_readings_of_what_is_near_are_used(
    lap: Log, mapped: tuple[FixedLagMapper, list[CycleResult]]
) -> None:
    """A boundary reaches a few metres ahead of the vehicle, and the sensor twice as far."""
    used = sum(result.readings for result in mapped[1])
    assert 0.25 < used / sum(len(cycle.labels) for cycle in lap.cycles) <= 1.0


def test_a_map_is_a_copy_with_a_joint_covariance(
    lap: Log, mapped: tuple[FixedLagMapper, list[CycleResult]]
) -> None:
    track = mapped[0].map()
    for boundary in track.boundaries.values():
        assert isinstance(boundary, SplineBoundary)
        np.testing.assert_allclose(boundary.covariance, boundary.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(boundary.covariance)[0] > 0.0
        boundary.spline.control_points[:] = np.nan
    assert np.isfinite(cone_distances(mapped[0].map(), truth_of(lap))).all()


def assert_outline(track: Map, whole: Map) -> None:
    """An outline has the curves or the points of the whole map, to the bit, and no covariance."""
    assert (set(track.boundaries), track.closed) == (set(whole.boundaries), whole.closed)
    for label, boundary in whole.boundaries.items():
        seen = track.boundaries[label]
        assert seen.covariance.shape == (0, 0)
        if isinstance(boundary, SplineBoundary) and isinstance(seen, SplineBoundary):
            np.testing.assert_array_equal(seen.spline.knots, boundary.spline.knots)
            np.testing.assert_array_equal(seen.spline.control_points, boundary.spline.control_points)
        else:
            assert isinstance(boundary, PointBoundary) and isinstance(seen, PointBoundary)
            np.testing.assert_array_equal(seen.points, boundary.points)


@pytest.mark.parametrize("name", ["fixed-lag", "landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_every_estimator_has_an_outline_a_vehicle_and_a_joint_covariance(name: str, lap: Log) -> None:
    estimator = make_online(name, MapperSettings(), lap)
    for odometry, cycle in list(split_odometry(lap))[:50]:
        estimator.update(odometry, cycle)
    assert hasattr(estimator, "outline")
    assert set(estimator.map().boundaries) == {LEFT, RIGHT}
    assert_outline(estimator.outline(), estimator.map())
    assert hasattr(estimator, "vehicle_state")
    state = estimator.vehicle_state()
    assert (state.pose.shape, state.calibration.shape, state.covariance.shape) == ((3,), (2,), (5, 5))
    assert (state.sigmas > 0.0).all()
    joint = estimator.map().joint_covariance
    assert joint is not None
    sizes = np.cumsum([2 * boundary.size for boundary in estimator.map().boundaries.values()])
    for end, boundary in zip(sizes, estimator.map().boundaries.values(), strict=True):
        own = slice(end - 2 * boundary.size, end)
        np.testing.assert_array_equal(joint[own, own], boundary.covariance)


def test_an_outline_does_not_update_the_inactive_map(
    mapped: tuple[FixedLagMapper, list[CycleResult]],
) -> None:
    mapper, _ = mapped
    values = mapper.road.smoother.variables.values
    assert len(mapper.road.smoother.inactive)
    values[mapper.road.smoother.variables.layout.entries(mapper.road.smoother.inactive.keys)] += 1.0
    before = values.copy()
    track = mapper.outline()
    np.testing.assert_array_equal(values, before)
    assert_outline(track, mapper.map())  # the map has updated it, so that nothing is left moved


# --- exact drives ----------------------------------------------------------------------------------------


def test_an_exact_lap_is_mapped_exactly() -> None:
    """What is left is how well an open spline of 3.5 m spacing bends to the rows (radius 9 m and more)."""
    log = lap_log(bean_track(), overrun=0.0)
    mapper, results = map_log(log)
    distances = cone_distances(mapper.map(), truth_of(log))
    assert np.sqrt(np.mean(distances**2)) < 0.1
    assert distances.max() < 0.4
    error = poses_of(results) - true_poses(log)
    assert np.abs(error[:, :2]).max() < 0.25
    assert np.abs(error[:, 2]).max() < 0.02


def test_an_exact_straight_is_mapped_to_its_lines() -> None:
    log = exact_log(ahead(8.0, 8.0), *corridor(100.0))
    mapper, results = map_log(log)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-6)
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, y, 64.0) < 1e-6
        assert reaches(mapper.map(), label, 62.0)


@pytest.mark.parametrize("label", [LEFT, RIGHT])
def test_one_boundary_alone_is_mapped(label: int) -> None:
    cones, labels = corridor(100.0)
    log = exact_log(ahead(8.0, 8.0), cones[labels == label], labels[labels == label])
    mapper, results = map_log(log)
    track = mapper.map()
    assert list(track.boundaries) == [label]
    assert results[-1].sizes[1 - label] == 0
    assert results[-1].sizes[label] > 10
    assert straightness(track, label, 2.0 if label == LEFT else -2.0, 64.0) < 1e-6


def test_unknown_labels_alone_map_nothing_where_sides_are_not_told() -> None:
    cones, labels = corridor(60.0)
    log = exact_log(ahead(8.0, 4.0), cones, np.full_like(labels, UNKNOWN))
    settings = MapperSettings(sides=SidesSettings(colourless=1.0))
    mapper, results = map_log(log, FixedLagMapper(settings, log.odometry_sigma))
    assert mapper.map().boundaries == {}
    assert results[-1].sizes == (0, 0)
    assert all(result.readings == 0 for result in results)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-9)


def test_unknown_labels_alone_are_mapped_on_the_side_where_they_are() -> None:
    cones, labels = corridor(60.0)
    mapper, results = map_log(exact_log(ahead(8.0, 4.0), cones, np.full_like(labels, UNKNOWN)))
    track = mapper.map()
    assert min(results[-1].sizes) > 8
    assert straightness(track, LEFT, 2.0, 30.0) < 1e-6
    assert straightness(track, RIGHT, -2.0, 30.0) < 1e-6


def test_unknown_readings_that_either_curve_would_take_are_left_out() -> None:
    """Rows so near to each other that every gate takes both."""
    cones, labels = corridor(60.0, half_width=0.15)
    labels = np.where(np.arange(len(labels)) % 3 == 0, UNKNOWN, labels)
    mapper, _ = map_log(exact_log(ahead(8.0, 4.0), cones, labels))
    assert set(mapper.boundaries) == {LEFT, RIGHT}
    assert not mapper.road.smoother.map.detections.used[
        mapper.road.smoother.map.detections.label == UNKNOWN
    ].any()


def test_unknown_readings_on_a_curve_are_used() -> None:
    """Every third cone has no colour; the lines are the same."""
    cones, labels = corridor(100.0)
    labels = np.where(np.arange(len(labels)) % 3 == 0, UNKNOWN, labels)
    mapper, _ = map_log(exact_log(ahead(8.0, 8.0), cones, labels))
    detections = mapper.road.smoother.map.detections
    used = detections.used & (detections.label == UNKNOWN)
    assert used.sum() > 10
    y = detections.points_map(used, mapper.road.smoother.variables)[:, 1]
    np.testing.assert_array_equal(detections.boundary[used], np.where(y > 0.0, LEFT, RIGHT))
    for label, line in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, line, 60.0) < 0.02


def test_cones_of_a_start_line_beside_the_boundary_do_not_bend_it() -> None:
    """Two of unknown colour, 0.75 m outside of each row: within three sigmas of it, which is not enough."""
    cones, labels = corridor(100.0)
    gate = np.array([[x, y] for x in (4.7, 7.3) for y in (2.75, -2.75)])
    log = exact_log(
        ahead(8.0, 8.0), np.concatenate([cones, gate]), np.append(labels, np.full(len(gate), UNKNOWN))
    )
    mapper, _ = map_log(log)
    detections = mapper.road.smoother.map.detections
    assert not detections.used[detections.label == UNKNOWN].any()
    for label, line in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, line, 60.0) < 1e-6


@pytest.mark.parametrize("cycles", [1, 2])
def test_a_wrong_colour_seen_once_or_twice_is_not_followed(cycles: int) -> None:
    """A right cone's reading on the left row, ahead of the end of the right curve."""
    log = exact_log(ahead(8.0, 8.0), *corridor(100.0))
    poses = true_poses(log)
    disturbed = list(log.cycles)
    for k in range(20, 20 + cycles):
        wrong = np.array([[32.0, 2.0]]) - poses[k, :2]
        cycle = disturbed[k]
        disturbed[k] = detections(
            cycle.t, np.concatenate([cycle.points_vehicle, wrong]), np.append(cycle.labels, RIGHT)
        )
    mapper, _ = map_log(replace(log, cycles=tuple(disturbed)))
    assert straightness(mapper.map(), RIGHT, -2.0, 64.0) < 0.05
    assert reaches(mapper.map(), RIGHT, 62.0)


def test_standing_still_changes_nothing() -> None:
    """Ten seconds at the same place, seen from there a hundred times, and on."""
    twists = np.concatenate([ahead(8.0, 3.0), ahead(0.0, 10.0), ahead(8.0, 4.0)])
    log = exact_log(twists, *corridor(100.0))
    mapper, results = map_log(log)
    still = [result.sizes for result in results if 4.0 < result.t < 12.9]
    assert len(set(still)) == 1
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-6)
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, y, 56.0) < 1e-6
        assert reaches(mapper.map(), label, 54.0)


def test_standing_still_from_the_start() -> None:
    log = exact_log(np.concatenate([ahead(0.0, 5.0), ahead(8.0, 4.0)]), *corridor(100.0))
    mapper, results = map_log(log)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-6)
    assert all(size > 5 for size in results[-1].sizes)
    assert straightness(mapper.map(), LEFT, 2.0, 32.0) < 1e-6


@pytest.mark.parametrize("gap", [2.0, 5.0])
def test_a_gap_between_cycles_is_bridged(gap: float) -> None:
    """The odometry goes on; the longer gap leaves one pose in the window."""
    log = exact_log(ahead(5.0, 16.0), *corridor(110.0))
    kept = tuple(cycle for cycle in log.cycles if not 4.0 < cycle.t < 4.0 + gap)
    log = replace(log, cycles=kept)
    mapper, results = map_log(log)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-3)
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, y, 78.0) < 0.1
        assert reaches(mapper.map(), label, 76.0)


@pytest.mark.parametrize(("since", "until"), [(0.0, 1.0), (3.0, 4.5), (7.0, 8.0)])
def test_cycles_without_detections(since: float, until: float) -> None:
    """At the start, in the middle, at the end."""
    log = exact_log(ahead(6.0, 8.0), *corridor(80.0))
    nothing = detections(0.0, np.zeros((0, 2)), np.zeros(0, np.intp))
    cycles = tuple(replace(nothing, t=c.t) if since <= c.t < until else c for c in log.cycles)
    log = replace(log, cycles=cycles)
    mapper, results = map_log(log)
    assert all(result.readings == 0 for result in results if since <= result.t < until)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-3)
    assert straightness(mapper.map(), LEFT, 2.0, 42.0) < 0.05


def test_a_drive_backwards_ends_well() -> None:
    """Reversing over what is mapped neither grows nor bends it."""
    twists = np.concatenate([ahead(6.0, 5.0), ahead(-3.0, 4.0)])
    log = exact_log(twists, *corridor(80.0))
    mapper, results = map_log(log)
    np.testing.assert_allclose(poses_of(results), true_poses(log), atol=1e-3)
    assert straightness(mapper.map(), LEFT, 2.0, 30.0) < 0.01


# --- odometry alone --------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [0.5, 3.0])
def test_odometry_alone_is_integrated_exactly(lag: float) -> None:
    """Nothing contradicts the chain: every estimate is its sum, however many poses have left the window."""
    rng = np.random.default_rng(0)
    twists = np.column_stack(
        [rng.uniform(-2.0, 12.0, 500), rng.normal(size=500), rng.uniform(-1.0, 1.0, 500)]
    )
    log = exact_log(twists, np.zeros((0, 2)), np.zeros(0, np.intp))
    mapper = FixedLagMapper(MapperSettings(lag=lag), ODOMETRY_SIGMA)
    _, results = map_log(log, mapper)
    expected = integrate(twists[:-1], DT)[::CYCLE]
    np.testing.assert_allclose(poses_of(results), expected, atol=1e-9)
    assert mapper.map().boundaries == {}
    assert len(mapper.poses) == round(lag * 10) + 1


@pytest.mark.failing
@pytest.mark.parametrize("left_out", [1, 3])
def test_twists_of_cycles_that_are_left_out_are_not_lost(
    left_out: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However a cycle fails, the next pose is the integral of all twists."""
    rng, works = np.random.default_rng(0), Road.predict
    twists = np.column_stack([rng.uniform(2.0, 12.0, 200), rng.normal(size=200), rng.uniform(-1.0, 1.0, 200)])
    log = exact_log(twists, np.zeros((0, 2)), np.zeros(0, np.intp))
    bad = {cycle.t for cycle in log.cycles[20 : 20 + left_out]}

    def fails(road: Road, motion: MeasuredMotion, orange: Detections) -> None:
        works(road, motion, orange)
        if orange.t in bad:
            raise np.linalg.LinAlgError("no convergence")

    monkeypatch.setattr(Road, "predict", fails)
    mapper, results = map_log(log)
    assert [result.t for result in results if "the cycle is not used" in result.notice] == sorted(bad)
    expected, used = integrate(twists[:-1], DT)[::CYCLE], np.ones(len(results), bool)
    used[20 : 20 + left_out] = False
    np.testing.assert_allclose(poses_of(results)[used], expected[used], atol=1e-9)
    assert len(mapper.road.smoother.times) <= used.sum()


def test_a_first_cycle_after_the_first_odometry_starts_where_it_has_driven() -> None:
    """The map frame is the vehicle at the first odometry stamp, not at the first cycle."""
    log = exact_log(ahead(8.0, 3.0), np.zeros((0, 2)), np.zeros(0, np.intp))
    _, results = map_log(replace(log, cycles=log.cycles[10:]))
    np.testing.assert_allclose(results[0].pose, [8.0, 0.0, 0.0], atol=1e-9)


def test_no_twist_at_all_is_a_pose_at_the_origin() -> None:
    mapper = FixedLagMapper(odometry_sigma=ODOMETRY_SIGMA)
    empty = Odometry(np.zeros(0), np.zeros((0, 3)))
    nothing = Detections(0.0, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.intp))
    np.testing.assert_array_equal(mapper.update(empty, nothing).pose, np.zeros(3))


# --- settings --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_splines_of_any_degree(degree: int) -> None:
    settings = MapperSettings()
    settings = replace(settings, spline=replace(settings.spline, degree=degree), gauge=GaugeSettings())
    log = exact_log(ahead(8.0, 6.0), *corridor(80.0))
    mapper, _ = map_log(log, FixedLagMapper(settings, ODOMETRY_SIGMA))
    for label, y in ((LEFT, 2.0), (RIGHT, -2.0)):
        assert straightness(mapper.map(), label, y, 48.0) < 1e-6
        assert reaches(mapper.map(), label, 46.0)


def test_the_window_holds_the_lag() -> None:
    log = exact_log(ahead(8.0, 4.0), *corridor(60.0))
    mapper = FixedLagMapper(MapperSettings(lag=1.0), ODOMETRY_SIGMA)
    counts = []
    for odometry, cycle in split_odometry(log):
        mapper.update(odometry, cycle)
        counts.append(len(mapper.poses))
    assert counts == [min(k, 11) for k in range(1, len(log.cycles) + 1)]


def test_a_cycle_in_which_a_curve_grows_takes_its_own_number_of_steps() -> None:
    """The poses are the same to the bit until a curve grows; where one begins, one step is the optimum."""
    log = noisy(exact_log(ahead(8.0, 2.0), *corridor(60.0)), seed=1)
    _, once = map_log(log, FixedLagMapper(MapperSettings(steps_grown=1), ODOMETRY_SIGMA))
    _, twice = map_log(log, FixedLagMapper(MapperSettings(steps_grown=2), ODOMETRY_SIGMA))
    same = (poses_of(once) == poses_of(twice)).all(axis=1)
    begins, grows, *_ = [k for k, (a, b) in enumerate(pairwise(once), 1) if a.sizes != b.sizes]
    assert once[begins].sizes == (5, 5) and int(same.argmin()) == grows


# --- looking changes nothing -----------------------------------------------------------------------------


def test_looking_at_the_map_changes_nothing() -> None:
    log = exact_log(ahead(8.0, 5.0), *corridor(80.0))
    rng = np.random.default_rng(0)
    cycles = tuple(
        replace(c, points_vehicle=c.points_vehicle + 0.1 * rng.normal(size=c.points_vehicle.shape))
        for c in log.cycles
    )
    pairs = list(split_odometry(replace(log, cycles=cycles)))
    looked, left_alone = FixedLagMapper(), FixedLagMapper()
    for odometry, cycle in pairs:
        left_alone.update(odometry, cycle)
        looked.update(odometry, cycle)
        looked.map()
        looked.graph().error(looked.values())
        looked.road.smoother.linear_graph()
        looked.marginal_covariance([looked.pose_key(looked.road.smoother.next_cycle - 1)])
    left_alone.road.smoother.refresh()
    np.testing.assert_array_equal(
        looked.road.smoother.variables.values, left_alone.road.smoother.variables.values
    )


def test_a_setting_out_of_range_is_named() -> None:
    with pytest.raises(SettingsError, match=r"growth\.merge_radius: expected a positive number, found -1"):
        GrowthSettings(merge_radius=-1.0)
    with pytest.raises(SettingsError, match=r"^lag: expected a positive number, found nan"):
        MapperSettings(lag=float("nan"))


# --- orange cones ----------------------------------------------------------------------------------------


def test_orange_cones_are_points_of_the_map_and_change_nothing_else() -> None:
    cones, labels = corridor(60.0)
    gate = np.array([[20.0, 3.0], [20.0, -3.0], [24.0, 0.0]])
    orange = np.array([BIG_ORANGE, BIG_ORANGE, ORANGE])
    plain = exact_log(ahead(6.0, 5.0), cones, labels)
    both = exact_log(ahead(6.0, 5.0), np.concatenate([cones, gate]), np.append(labels, orange))
    (known, without), (found, with_orange) = map_log(plain), map_log(both)
    np.testing.assert_array_equal(poses_of(without), poses_of(with_orange))
    track = found.map()
    np.testing.assert_allclose(track.points[BIG_ORANGE].points, gate[:2], atol=0.05)
    np.testing.assert_allclose(track.points[ORANGE].points, gate[2:], atol=0.05)
    assert found.outline().points.keys() == track.points.keys()
    assert known.map().points == {}
    assert [b.size for b in known.map().boundaries.values()] == [b.size for b in track.boundaries.values()]


def test_orange_cones_of_a_gate_stay_where_they_are_when_the_loop_closes() -> None:
    track = bean_track()
    start, side = track.start, np.array([-np.sin(track.start[2]), np.cos(track.start[2])])
    along = np.array([np.cos(start[2]), np.sin(start[2])])
    gate = start[:2] + 6.0 * along + np.outer([2.6, -2.6], side)
    labels = np.array([BIG_ORANGE, BIG_ORANGE])
    log = lap_log(replace(track, other=gate, other_labels=labels), overrun=25.0)
    mapper, results = map_log(log)
    assert results[-1].closed
    truth = truth_of(log)
    np.testing.assert_allclose(
        mapper.map().points[BIG_ORANGE].points, truth.cones[truth.cone_labels == BIG_ORANGE], atol=0.1
    )
