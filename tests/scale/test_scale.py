"""Scenes of any size: how the scale is found, and that a log s times as large gives s times the map."""

from __future__ import annotations

import ast
import inspect
import pickle
import re
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph.baselines.filters import CkfMapper
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.errors import InputError, ReadingError, SettingsError
from pathspace_graph.estimators import ONLINE, make_batch, make_online
from pathspace_graph.eval.metrics.measures import measure
from pathspace_graph.eval.metrics.summary import laps_of, summarize
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise, RayNoise
from pathspace_graph.health import Health
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.io.results import RunResult, VehicleState
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.lengths import POSE_LENGTHS, Length, Text, joined, scaled, times
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.plausibility.diagnosis import diagnose, measured_line
from pathspace_graph.plausibility.judge import hints, read_usable_log
from pathspace_graph.run import CycleResult, run_online, split_odometry
from pathspace_graph.scale import SCALES, SCENE_ENOUGH, SCENE_PATIENCE, SceneScale, scale_of, width_and_gap
from pathspace_graph.settings.mapper import BatchSettings, MapperSettings
from pathspace_graph.settings.online import GrowthSettings, LimitSettings
from pathspace_graph.sim.mistakes import in_frame
from pathspace_graph.spline.bspline import BSpline

from ..scenes.drives import ODOMETRY_SIGMA, short_drive
from ..scenes.paths import modules

STANDING = Odometry(np.array([0.0]), np.zeros((1, 3)))
CLOSE = 1e-9
"""Results agree to this share of the map's size."""


def road(width: float, gap: float, label: int | None = None) -> Detections:
    """Five cones on each side of a straight road ahead."""
    x = 1.0 * gap + gap * np.arange(5)
    points = np.concatenate([np.column_stack([x, np.full(5, side * width / 2)]) for side in (1.0, -1.0)])
    labels = np.repeat([LEFT, RIGHT], 5) if label is None else np.full(10, label)
    return Detections(0.0, points, np.tile(1e-4 * np.eye(2), (10, 1, 1)), labels)


def driven(cycle: Detections, speed: float, count: int) -> SceneScale:
    """What a cycle tells that is seen time and again, ten times a second, while the vehicle drives."""
    scene = SceneScale()
    for k in range(count):
        odometry = Odometry(np.array([0.1 * k]), np.array([[speed, 0.0, 0.0]]))
        scene.see(odometry, replace(cycle, t=0.1 * (k + 1)))
    return scene


# --- the scale of a scene --------------------------------------------------------------------------------


def test_width_and_gap_are_those_of_the_rows() -> None:
    assert width_and_gap(road(3.0, 2.0)) == pytest.approx((3.0, 2.0))
    assert width_and_gap(road(3.0, 2.0, UNKNOWN)) == pytest.approx((3.0, 2.0))  # by the sides of the vehicle
    nothing = Detections(0.0, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, int))
    assert np.isnan(width_and_gap(nothing)).all()


def test_a_cone_that_is_detected_twice_is_one() -> None:
    once, rng = road(3.0, 2.0), np.random.default_rng(0)
    points = np.concatenate([once.points_vehicle, once.points_vehicle + rng.normal(0.0, 0.01, (10, 2))])
    twice = Detections(0.0, points, np.tile(once.covariances, (2, 1, 1)), np.tile(once.labels, 2))
    assert width_and_gap(twice) == pytest.approx((3.0, 2.0), abs=0.05)


@pytest.mark.parametrize(
    ("width", "gap", "scale"),
    [
        (3.5, 3.2, 1.0),
        (5.0, 5.0, 1.0),
        (0.35, 0.32, 0.1),
        (1.0, 1.0, 0.3),
        (10.0, 9.0, 3.0),
        (40.0, 30.0, 10.0),
        (15.0, 5.0, 1.0),  # a wide road
        (3.0, 0.3, 1.0),  # dense rows
        (3500.0, 3200.0, 1.0),  # millimetres, which are no scale
    ],
)
def test_the_scale_is_what_width_and_gap_agree_on(width: float, gap: float, scale: float) -> None:
    scene = driven(road(width, gap), speed=2.0 * gap, count=SCENE_ENOUGH + 1)
    assert scene.value == scale
    assert scene.is_final


def test_a_vehicle_at_rest_learns_nothing_more() -> None:
    scene = driven(road(0.35, 0.32), speed=0.0, count=50)
    assert scene.value == 0.1
    assert not scene.is_final


def test_a_scale_that_is_final_does_not_change() -> None:
    scene = driven(road(0.35, 0.32), speed=2.0, count=SCENE_ENOUGH)
    for k in range(2 * SCENE_ENOUGH):
        odometry = Odometry(np.array([3.0 + k]), np.array([[10.0, 0.0, 0.0]]))
        scene.see(odometry, replace(road(3.5, 3.2), t=4.0 + k))
    assert (scene.value, scene.is_final) == (0.1, True)


def test_a_scene_without_a_road_is_taken_as_one_of_scale_one_in_the_end() -> None:
    one_side = road(0.35, 0.32).where(np.arange(10) < 5)
    scene = driven(one_side, speed=2.0, count=SCENE_PATIENCE - 1)
    assert not scene.is_final
    scene.see(STANDING, one_side)
    assert (scene.value, scene.is_final) == (1.0, True)


# --- records ---------------------------------------------------------------------------------------------


def scalable() -> list[type]:
    """Every dataclass that says which of its fields are lengths."""
    found = []
    for name, file in modules().items():
        if "LENGTHS: ClassVar" not in file.read_text():
            continue
        module = import_module(f"pathspace_graph.{name}".removesuffix(".__init__"))
        found += [own for own in vars(module).values() if isinstance(own, type) and "LENGTHS" in vars(own)]
    return [one for one in dict.fromkeys(found) if is_dataclass(one)]


@pytest.mark.parametrize("kind", scalable(), ids=lambda kind: kind.__name__)
def test_every_field_that_is_said_to_be_in_metres_has_a_power(kind: Any) -> None:
    """The texts of the fields are held against `LENGTHS`: what is in m, m^2 or m/s changes with the scale."""
    powers = {*kind.LENGTHS, *getattr(kind, "COVARIANCES", {})}
    body = ast.parse(inspect.getsource(kind)).body[0].body  # type: ignore[attr-defined]
    for node, text in pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(text, ast.Expr):
            name, said = ast.unparse(node.target), ast.unparse(text.value)
            in_metres = re.search(r"\bin m\b|\(m\)|\bm\^2|\bm/s|\bm, m\b", said)
            if in_metres and name not in powers and not name.startswith("LENGTHS"):
                pytest.fail(f"{kind.__name__}.{name}: {said}")
    assert powers <= {field.name for field in fields(kind)}


def test_each_number_changes_by_its_own_power() -> None:
    noise = MeasuredNoise(
        np.array([1.0, 2.0, 3.0]), np.ones(3), 0.1, RayNoise(np.array([0.1, 0.2])), sensor=np.arange(5.0)
    )
    larger = scaled(KnownNoise(np.ones(3), measured=noise), 10.0).measured
    assert larger is not None
    assert larger.along is not None
    np.testing.assert_allclose(larger.odometry, [10.0, 20.0, 3.0])
    np.testing.assert_allclose(larger.along.sigma, [1.0, 0.2])
    np.testing.assert_allclose(larger.sensor, [0.0, 10.0, 2.0, 3.0, 40.0])
    state = scaled(VehicleState(np.ones(3), np.ones(2), np.ones((5, 5))), 10.0)
    np.testing.assert_allclose(state.pose, [10.0, 10.0, 1.0])
    np.testing.assert_allclose(state.covariance[0], [100.0, 100.0, 10.0, 10.0, 10.0])
    np.testing.assert_allclose(state.covariance[2:, 2:], 1.0)


def test_a_text_has_metres_of_the_scene() -> None:
    area = Text("{area:g} m^2 of {name}", area=Length(2.0, power=2), name="a 3 m mast")
    assert scaled(Health("lost", area), 10.0).reason == "200 m^2 of a 3 m mast"
    both = joined(["", area, Text("{far:.2f} m away", far=Length(3.0)), ""])
    assert both == "2 m^2 of a 3 m mast; 3.00 m away"
    said = CycleResult(0.0, np.zeros(3), (0, 0), 0, False, notice=both)
    assert scaled(said, 0.1).notice == "0.02 m^2 of a 3 m mast; 0.30 m away"
    for copy in (deepcopy(both), pickle.loads(pickle.dumps(both))):
        assert scaled(replace(said, notice=copy), 10.0).notice == "200 m^2 of a 3 m mast; 30.00 m away"


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_every_message_of_a_mapper_is_in_metres_of_its_log(scale: float) -> None:
    """Notices about dropped detections and about a curve that is full, and refused lengths and noise."""
    log = scaled(short_drive(), scale)
    cycles = [replace(cycle, points_vehicle=cycle.points_vehicle.copy()) for cycle in log.cycles[:60]]
    cycles[5].points_vehicle[0] = [400.0 * scale, 0.0]
    small = replace(MapperSettings(scale=scale), growth=GrowthSettings(max_size=8))
    mapper = FixedLagMapper(small, log.odometry_sigma)
    result = run_online(replace(log, cycles=tuple(cycles)), mapper)
    notices = "; ".join(record.notice for record in result.cycles if record.notice)
    assert f"from {0.01 * scale:g} to {300.0 * scale:g} m, found [{400.0 * scale:g}, 0] in row 0" in notices
    assert f"left boundary grows no further, with 8 control points on {15.5 * scale:.3g} m" in notices
    with pytest.raises(SettingsError, match=f"least {0.01 * scale:g} m, found {1e-3 * scale:g}$"):
        mapper.ahead(10.0 * scale, 1e-3 * scale)
    with pytest.raises(SettingsError, match=r"found \[1.0, -1.0, 1.0\]"):
        FixedLagMapper(small, np.array([1.0, -1.0, 1.0]))


@settings(max_examples=20, deadline=None)
@given(st.floats(0.01, 100.0))
def test_there_and_back_is_the_same_log(factor: float) -> None:
    log = short_drive()
    again = scaled(scaled(log, factor), 1.0 / factor)
    np.testing.assert_allclose(again.odometry.twist, log.odometry.twist, rtol=1e-12)
    for one, other in zip(again.cycles, log.cycles, strict=True):
        np.testing.assert_allclose(one.points_vehicle, other.points_vehicle, rtol=1e-12)
        np.testing.assert_allclose(one.covariances, other.covariances, rtol=1e-12)
    assert scaled(log, 1.0) is log


# --- estimators ------------------------------------------------------------------------------------------


def assert_alike(found: RunResult, known: RunResult, scale: float) -> None:
    """A result is that of a scene `scale` times as large, to rounding."""
    assert found.scale == scale
    assert found.map.closed == known.map.closed
    assert found.laps == known.laps
    size = scale * np.ptp(known.trajectory[:, :2])
    weights = np.array([scale, scale, 1.0])
    np.testing.assert_allclose(found.trajectory, known.trajectory * weights, rtol=0.0, atol=CLOSE * size)
    assert (found.smoothed is None) == (known.smoothed is None)
    if known.smoothed is not None:
        np.testing.assert_allclose(found.smoothed, known.smoothed * weights, rtol=0.0, atol=CLOSE * size)
    for label, boundary in known.map.boundaries.items():
        other = found.map.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        assert isinstance(other, SplineBoundary)
        points = boundary.spline.control_points
        np.testing.assert_allclose(other.spline.control_points, scale * points, rtol=0.0, atol=CLOSE * size)
        largest = scale**2 * np.abs(boundary.covariance).max()
        np.testing.assert_allclose(
            other.covariance, scale**2 * boundary.covariance, rtol=0.0, atol=1e-6 * largest
        )


ANSWERS = ("map", "outline", "readings", "vehicle_state", "noise_used", "window_poses")
"""Methods of an estimator that return what has lengths."""


def assert_same(found: Any, known: Any) -> None:
    """Two records agree in all of their numbers, to rounding; what holds no numbers isn't compared."""
    assert type(found) is type(known)
    if is_dataclass(known):
        for field in fields(known):
            assert_same(getattr(found, field.name), getattr(known, field.name))
    elif isinstance(known, dict) and known:
        assert found.keys() == known.keys()
        for key in known:
            assert_same(found[key], known[key])
    elif isinstance(known, BSpline):
        assert_same(found.control_points, known.control_points)
    elif isinstance(known, float | np.ndarray) and np.size(known):
        largest = np.nanmax(np.abs(known), initial=0.0)
        np.testing.assert_allclose(found, known, rtol=0.0, atol=1e-6 * largest)


def online(log: Log, scale: float | None) -> RunResult:
    return run_online(log, FixedLagMapper(MapperSettings(scale=scale), log.noise))


@cache
def of_scale_one() -> RunResult:
    return online(short_drive(), 1.0)


@pytest.mark.parametrize("scale", [0.37, 10.0])
def test_a_log_s_times_as_large_gives_s_times_the_map(scale: float) -> None:
    assert_alike(online(scaled(short_drive(), scale), scale), of_scale_one(), scale)


def test_a_batch_of_a_log_s_times_as_large_is_s_times_as_large() -> None:
    log = short_drive()
    known = BatchMapper(MapperSettings(), log.noise, FixedLagMapper).solve(log)
    larger = scaled(log, 3.0)
    found = make_batch("spline", MapperSettings(), larger).solve(larger)
    assert_alike(found, known, 3.0)
    assert found.settings["scale"] == 3.0
    np.testing.assert_allclose(found.vehicle.pose, known.vehicle.pose * [3.0, 3.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(
        found.pose_covariances[-1], known.pose_covariances[-1] * np.outer([3, 3, 1], [3, 3, 1]), rtol=1e-3
    )


@pytest.mark.parametrize("name", ["spline", "landmark-batch"])
def test_a_batch_with_a_given_scale_begins_with_an_online_run_at_scale_one(name: str) -> None:
    log = replace(short_drive(), cycles=short_drive().cycles[:60])
    own = BatchSettings(start="online")
    one, ten = (
        make_batch(name, MapperSettings(scale=s, batch=own), scaled(log, s)).solve(scaled(log, s))
        for s in (1.0, 10.0)
    )
    weights = np.array([10.0, 10.0, 1.0])
    np.testing.assert_allclose(ten.trajectory, one.trajectory * weights, rtol=0.0, atol=1e-5)
    assert ten.map.size == one.map.size > 0


@pytest.mark.parametrize("name", ONLINE)
def test_an_estimator_for_a_log_is_made_for_its_scale(name: str) -> None:
    """From the first pose on, and whatever it is asked for, it is the one of scale 1 times the scale."""
    log = short_drive()
    log = replace(log, cycles=log.cycles[:60])
    small = scaled(log, 0.1)
    known = run_online(log, make_online(name, MapperSettings(scale=1.0), log))
    found = run_online(small, make_online(name, MapperSettings(), small))
    assert found.scale == found.settings["scale"] == 0.1
    np.testing.assert_allclose(found.trajectory, known.trajectory * [0.1, 0.1, 1.0], rtol=0.0, atol=1e-8)
    assert found.map.size == known.map.size


@pytest.mark.parametrize("name", ["fixed-lag", "landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_what_an_estimator_is_asked_for_has_the_size_of_the_scene(name: str) -> None:
    """Lengths of all that a method returns are ten times those at scale 1, or a tenth of them."""
    log = short_drive()
    log = replace(log, cycles=log.cycles[:60])
    one, ten = (make_online(name, MapperSettings(scale=s), scaled(log, s)) for s in (1.0, 10.0))
    for cycle, larger in zip(split_odometry(log), split_odometry(scaled(log, 10.0)), strict=True):
        known, found = one.update(*cycle), ten.update(*larger)
        assert_same(replace(found, stages={}), scaled(replace(known, stages={}), 10.0))
    asked = {name for name in ANSWERS if hasattr(one, name)}
    assert asked >= {"map", "outline", "vehicle_state", "noise_used"}
    for method in asked:
        known, found = getattr(one, method)(), getattr(ten, method)()
        assert_same(found, times(known, POSE_LENGTHS, 10.0))
    if isinstance(one, FixedLagMapper):
        assert_same(ten.ahead(50.0, 10.0), scaled(one.ahead(5.0), 10.0))


def test_the_smoothed_drive_has_the_size_of_the_scene() -> None:
    log = short_drive()
    one, ten = (FixedLagMapper(MapperSettings(scale=s)) for s in (1.0, 10.0))
    t = np.array([log.cycles[0].t])
    for mapper in (one, ten):
        mapper.drive.record.stamps.append(float(t[0]))
        mapper.drive.record.corrected = np.array([[2.0, 3.0, 0.5]])
    np.testing.assert_allclose(one.smoothed(t), [[2.0, 3.0, 0.5]])
    np.testing.assert_allclose(ten.smoothed(t), [[20.0, 30.0, 0.5]])


def test_a_mapper_that_is_given_no_scale_takes_scenes_as_they_are() -> None:
    log = short_drive()
    known = online(replace(log, cycles=log.cycles[:40]), 1.0)
    found = online(replace(log, cycles=log.cycles[:40]), None)
    np.testing.assert_array_equal(found.trajectory, known.trajectory)
    assert found.scale == 1.0


@pytest.mark.parametrize("kind", [FixedLagMapper, LandmarkFixedLag, CkfMapper])
def test_a_wrong_shape_is_refused_at_any_scale(kind: Any) -> None:
    estimator = kind(MapperSettings(scale=0.1), ODOMETRY_SIGMA)
    twists = Odometry(np.array([0.0]), np.zeros((1, 2)))
    with pytest.raises(ReadingError):
        estimator.update(twists, road(0.3, 0.3))


@given(seed=st.integers(0, 10**6), strange=st.sampled_from([0.0, np.nan, np.inf, 1e308, 1e-308, -1e5]))
@settings(max_examples=20, deadline=None)
def test_no_detections_break_the_search_for_a_scale(seed: int, strange: float) -> None:
    """Cones anywhere tell one of the scales, at which a mapper can be made."""
    rng, scene = np.random.default_rng(seed), SceneScale()
    cycles = []
    for k in range(8):
        points = rng.normal(0.0, 10.0 ** rng.uniform(-1.0, 1.5), (12, 2))
        points[rng.integers(12), rng.integers(2)] = strange
        covariances = np.tile(1e-4 * np.eye(2), (12, 1, 1))
        cycle = Detections(0.1 * (k + 1), points, covariances, rng.integers(0, 3, 12))
        cycles.append((Odometry(np.array([0.1 * k]), np.array([[5.0, 0.0, 0.1]])), cycle))
        scene.see(*cycles[-1])
    assert scene.value in SCALES
    mapper = FixedLagMapper(MapperSettings(scale=scene.value), ODOMETRY_SIGMA)
    for one in cycles:
        assert np.isfinite(mapper.update(*one).pose).all()


def test_a_log_is_read_by_the_limits_of_its_scene(tmp_path: Path) -> None:
    log = scaled(short_drive(), 0.1)
    log.odometry.twist[7, 0] = 12.0
    write_log(log, tmp_path / "log")
    with pytest.raises(InputError, match=r"vx from -10 to 10 m/s, found 12$") as error:
        read_usable_log(tmp_path / "log", LimitSettings())
    assert error.value.row == 7 + 2


def test_a_refusal_has_the_lengths_of_the_scene() -> None:
    mapper = FixedLagMapper(MapperSettings(scale=0.1), ODOMETRY_SIGMA)
    fast = Odometry(np.array([0.0]), np.array([[12.0, 0.0, 0.0]]))
    with pytest.raises(ReadingError, match=r"vx from -10 to 10 m/s, found 12"):
        mapper.update(fast, replace(road(0.3, 0.3), t=0.1))
    turning = Odometry(np.array([0.0]), np.array([[1.0, 0.0, 60.0]]))
    with pytest.raises(ReadingError, match=r"wz from -10 to 10 rad/s, found 60"):
        mapper.update(turning, replace(road(0.3, 0.3), t=0.1))


# --- metrics ---------------------------------------------------------------------------------------------


def test_metrics_are_those_of_scale_one_times_the_scale() -> None:
    log = short_drive()
    known, larger = of_scale_one(), scaled(log, 10.0)
    found = run_online(larger, make_online("fixed-lag", MapperSettings(), larger))
    first, second = summarize(known, log), summarize(found, scaled(log, 10.0))
    assert second["scale"] == scale_of(scaled(log, 10.0)) == 10.0
    assert second["ate"] == pytest.approx(10.0 * first["ate"], rel=1e-6)
    assert second["final"]["rmse"] == pytest.approx(10.0 * first["final"]["rmse"], rel=1e-6)
    assert second["final"]["missed"] == first["final"]["missed"]
    assert len(laps_of(found, scaled(log, 10.0))) == len(laps_of(known, log))
    over_scale = measure(found, scaled(log, 10.0))[-1].values
    assert over_scale["rmse"] == pytest.approx(measure(known, log)[-1].values["rmse"], rel=1e-6)


def test_a_small_scene_is_no_mistake_of_a_log() -> None:
    assert hints(scaled(short_drive(), 0.1)) == []


@pytest.mark.parametrize(("scale", "ahead"), [(0.1, "add 0.2"), (10.0, "add 2")])
def test_advice_on_the_mounting_is_in_metres_of_the_log(scale: float, ahead: str) -> None:
    (found,) = hints(in_frame(scaled(short_drive(), scale), ahead=2.5 * scale, left=-1.0 * scale))
    assert found.advice.startswith(ahead)
    words = found.advice.split()
    assert [float(words[1]), float(words[5].strip(","))] == pytest.approx(
        [2.5 * scale, -scale], abs=0.4 * scale
    )
    place = re.search(r"sensor were at x = (\S+) m, y = (\S+) m of the vehicle", found.found).groups()
    assert [float(one) for one in place] == pytest.approx([2.5 * scale, -scale], abs=0.4 * scale)


def test_a_hint_on_the_stated_noise_has_the_numbers_of_the_log() -> None:
    log = scaled(short_drive(), 0.1)
    stated = 0.4 * log.odometry_sigma
    (found,) = hints(replace(log, odometry_sigma=stated))
    said = re.findall(r"(v\w|wz) scatters by (\S+) (\S+), and (\S+) is stated", found.found)
    assert [(name, unit) for name, _, unit, _ in said] == [("vx", "m/s"), ("vy", "m/s"), ("wz", "rad/s")]
    assert [float(number) for *_, number in said] == pytest.approx(stated, rel=0.06)
    assert [float(number) for _, number, *_ in said] == pytest.approx(log.odometry_sigma, rel=0.5)


def test_a_diagnosis_of_a_small_scene_is_by_the_prior_at_scale_one() -> None:
    """A sensor that is 0.05 m off in a scene of 1:10 is 0.5 m off by the prior of 0.1 m: five sigmas."""
    settings = {"calibration": {"sigma_lateral": 0.1}}
    sensor = {"sensor": np.array([0.0, 0.05, 0.0, 0.0, 0.0]), "sensor_covariance": np.eye(5)}
    (line,) = diagnose(VehicleState(np.zeros(3), np.zeros(2), np.eye(5), **sensor), settings, 0.1)
    assert line == "the sensor sits 0.05 m too far to the left (uncertain)"
    noise = MeasuredNoise(
        np.full(3, 0.02),
        np.ones(3),
        0.1,
        *2 * [RayNoise(np.array([0.01, 0.01]))],
        sensor=np.array([0.0, 0.02, 0.0, 0.0, 0.0]),
        sensor_sigma=np.full(5, 1e-3),
    )
    assert measured_line(noise, 0.1).endswith(
        "detections 0.02 m along and 0.02 m across the ray at 1 m; the sensor sits 0.02 m too far to the left"
    )
