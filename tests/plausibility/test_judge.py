"""Hints: each mistake is told with its cause and its figure, and good logs are not accused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.front_end.measurement import twist_noise
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo
from pathspace_graph.labels import KINDS, LEFT, RIGHT, UNKNOWN, Kind
from pathspace_graph.plausibility.judge import hints, is_line, objections, positions_in_metres
from pathspace_graph.settings.checked import override
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.drives import ahead, corridor, detections, exact_log, short_drive
from ..scenes.lines import line_drive
from .good_logs import EDITED, PRESET, SIMULATED, good_log
from .mistakes import MISTAKES, in_frame, late, side_late, with_cycles, with_twists

SAID = {
    "positions in millimetres": ("in millimetres", "multiply x and y by 0.001"),
    "speeds in mm/s": ("in mm/s", "multiply vx and vy by 0.001"),
    "all lengths in millimetres": (
        "positions are in millimetres",
        "speeds are in mm/s",
        "covariances by its square",
    ),
    "yaw rate in degrees per second": ("in degrees per second", "multiply it by 0.017453"),
    "bearings in degrees": ("bearings in degrees were taken for radians",),
    "y to the right": ("y points to the right", "negate column y"),
    "stamps in nanoseconds": ("in nanoseconds", "multiply column t by 1e-09"),
    "stamps of the odometry in nanoseconds": ("in nanoseconds", "multiply column t by 1e-09"),
    "stamps of the detections in nanoseconds": ("in nanoseconds", "multiply column t by 1e-09"),
    "sensor frame: x to the right, y ahead": ("x to the right and y ahead", "y into column x and -x into"),
    "sensor frame: x to the left": ("x to the left and y to the rear", "-y into column x and x into"),
    "sensor frame: x to the rear": ("x to the rear and y to the right", "-x into column x and -y into"),
    "sensor frame: camera, z ahead": ("z ahead, x to the right and y down", "z into column x and -x into"),
    "sensor frame: x and y swapped": ("x and y are swapped", "y into column x and x into column y"),
    "positions in centimetres": ("in centimetres", "multiply x and y by 0.01"),
    "speeds in km/h": ("in km/h", "multiply vx and vy by 0.27778"),
    "yaw rate to the right": ("positive to the right", "negate column wz"),
    "stamps in milliseconds": ("in milliseconds", "multiply column t by 0.001"),
    "speeds always 0": ("the speed is missing: it is 0 m/s",),
    "yaw rate always 0": ("the yaw rate is missing: wz spreads by 0 rad/s", "convert --imu"),
    "odometry is a pose": ("is a pose (x, y, heading)",),
    "odometry of a yaw that wraps": ("a yaw that wraps at a full turn was differenced",),
    "speeds in the map frame, start at 137 degrees": ("along the axes of a fixed frame",),
    "speeds in the map frame": ("along the axes of a fixed frame",),
    "detections in the map frame": ("in the frame of the map",),
    "detections 1 s late": ("about 1 s too late", "--time-offset -1"),
    "detections 1 s late from the middle on": ("the clock of one file jumps or drifts, by 1 s",),
    "sides: the right one 50 ms late": ("the sides disagree by",),
    "covariances in mm^2": ("too large, as in another unit",),
    "covariances of zero": ("too small, as in another unit, or there are none at all",),
    "all labels left": ("not turned into left and right",),
    "y to the right, yaw rate in degrees": ("y points to the right", "multiply it by 0.017453"),
}
"""The hints of each mistake say this, with its figure and its direction."""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_told_by_its_cause_and_its_figure(mistake: str) -> None:
    found = hints(MISTAKES[mistake](short_drive()))
    said = " ".join(f"{hint.likely}; {hint.advice}" for hint in found)
    assert [words for words in SAID[mistake] if words not in said] == [], said
    assert all("\n" not in hint.line for hint in found)


@pytest.mark.parametrize(("most", "told"), [(2, True), (3, False)])
def test_a_sensor_that_sees_too_few_cones_to_check_the_odometry_is_told(most: int, told: bool) -> None:
    log = short_drive()
    few = replace(log, cycles=tuple(c.where(np.arange(len(c.labels)) < most) for c in log.cycles))
    assert np.median([len(cycle.labels) for cycle in few.cycles]) == most
    found = [hint.found for hint in hints(few) if hint.cause == "reach"]
    assert found == (["the typical cycle has 2 detections"] if told else [])


def test_good_logs_are_not_accused() -> None:
    log = short_drive()
    colourless = replace(log, cycles=tuple(replace(c, labels=c.labels * 0 + UNKNOWN) for c in log.cycles))
    for good in (log, colourless, *(edit(log) for edit in EDITED.values())):
        assert hints(good) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*SIMULATED, *PRESET])
def test_a_good_log_of_any_kind_is_not_accused(kind: str) -> None:
    """A range of 5 m shows two cones a cycle, which cannot check the odometry: that is said."""
    expected = ["reach"] if kind == "range of 5 m" else []
    assert [hint.cause for hint in hints(good_log(0, kind))] == expected


def test_the_truth_is_not_read() -> None:
    log = MISTAKES["y to the right"](short_drive())
    assert hints(replace(log, truth=None)) == hints(log)


@pytest.mark.parametrize("turn", [-120.0, -25.0, 12.0, 65.0])
def test_the_angle_of_a_turned_sensor_is_told(turn: float) -> None:
    (found,) = hints(in_frame(short_drive(), turn=np.deg2rad(turn)))
    assert found.cause == "sensor frame"
    told = float(found.likely.split(" by ")[1].split(" degrees")[0])
    assert told == pytest.approx(abs(turn), abs=1.0)
    assert ("to the left" in found.likely) == (turn > 0.0)


@pytest.mark.parametrize("turn", [0.0, 0.5 * np.pi])
def test_the_place_of_a_sensor_is_told(turn: float) -> None:
    *_, found = hints(in_frame(short_drive(), turn=turn, ahead=2.5, left=-1.0))
    assert found.cause == "mounting" and "whose origin is not the vehicle's" in found.likely
    words = found.advice.split()
    assert [float(words[1]), float(words[5].strip(","))] == pytest.approx([2.5, -1.0], abs=0.4)


def test_a_vehicle_that_goes_backward_by_its_odometry_alone_is_told() -> None:
    (found,) = hints(with_twists(short_drive(), (-1.0, -1.0, 1.0)))
    assert (found.cause, found.likely) == ("odometry", "the speed ahead is negative")


# --- weak evidence: nothing is said ----------------------------------------------------------------------


def test_straight_on_a_mirrored_log_cannot_be_told() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(6.0, 10.0), cones, labels)
    assert hints(log) == []
    assert hints(MISTAKES["y to the right"](log)) == []


def test_a_vehicle_at_rest_is_not_accused() -> None:
    cones, labels = corridor(80.0)
    log = exact_log(ahead(0.0, 20.0), cones, labels)
    for mistake in ("y to the right", "sensor frame: x to the left", "speeds in km/h"):
        assert hints(MISTAKES[mistake](log)) == []


def test_a_short_log_is_not_accused() -> None:
    log = short_drive()
    short = replace(
        log,
        odometry=Odometry(log.odometry.t[:60], log.odometry.twist[:60]),
        cycles=tuple(cycle for cycle in log.cycles if cycle.t < 1.0),
    )
    assert hints(MISTAKES["y to the right"](short)) == []


def test_impossible_speeds_are_told_without_detections() -> None:
    odometry = Odometry(0.02 * np.arange(100), np.tile([8e3, 0.0, 40.0], (100, 1)))
    nothing = Detections(0.5, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, int))
    for cycles in ((), (nothing,)):
        found = hints(Log(odometry, cycles, np.ones(3)))
        assert [hint.cause for hint in found] == ["speeds", "yaw rate"]


@pytest.mark.parametrize(("bad", "causes"), [(9, []), (11, ["speeds", "yaw rate"])])
def test_a_few_outliers_among_good_readings_are_no_mistake_of_units(bad: int, causes: list[str]) -> None:
    """Of a hundred readings so many are beyond any vehicle; a tenth of them may be."""
    twist = np.tile([8.0, 0.0, 0.4], (100, 1))
    twist[20 : 20 + bad] = [8e3, 0.0, 40.0]
    found = hints(Log(Odometry(0.02 * np.arange(100), twist), (), np.ones(3)))
    assert [hint.cause for hint in found] == causes


@pytest.mark.parametrize(
    ("column", "step", "likely"),
    [(2, 5.5, "a yaw that wraps"), (2, 4.5, ""), (0, 10.5, "positions that jump"), (0, 9.5, "")],
)
def test_single_rows_that_cannot_be_are_told(column: int, step: float, likely: str) -> None:
    twist = np.tile([8.0, 0.0, 0.4], (100, 1))
    twist[20, column] += step
    found = hints(Log(Odometry(0.02 * np.arange(100), twist), (), np.ones(3)))
    assert [hint.likely[: len(likely)] for hint in found] == ([likely] if likely else [])
    assert all("row 22" in hint.found for hint in found)


@pytest.mark.parametrize(
    ("typical", "said"),
    [
        (0.049, "divided by 1000"),
        (0.051, ""),
        (119.0, ""),
        (121.0, "in centimetres"),
        (2e4, "in millimetres"),
    ],
)
def test_positions_are_told_beyond_what_a_detector_sees(typical: float, said: str) -> None:
    """Nearer than 5 cm or farther than 120 m there are no cones."""
    nothing = Odometry(0.1 * np.arange(10), np.zeros((10, 3)))
    seen = detections(0.5, np.array([[0.9, 0.0], [0.0, 1.0], [1.1, 0.0]]) * typical, np.zeros(3, np.intp))
    log = Log(nothing, (seen,), np.ones(3))
    found = [hint.line for hint in positions_in_metres(log)[1]]
    assert len(found) == bool(said)
    assert all(said in line for line in found)


# --- stamps ----------------------------------------------------------------------------------------------


def test_stamps_that_are_only_fractions_or_whole_seconds_are_told() -> None:
    log = short_drive()
    for change, likely in ((lambda t: t % 1.0, "only the fraction"), (np.floor, "only the whole seconds")):
        spoiled = replace(log, odometry=replace(log.odometry, t=change(log.odometry.t)))
        (found,) = hints(spoiled)
        assert (found.cause, found.file) == ("stamps", "odometry.csv")
        assert likely in found.likely


def test_files_of_different_clocks_are_told() -> None:
    log = short_drive()
    spoiled = replace(log, cycles=tuple(replace(cycle, t=cycle.t + 1.7e9) for cycle in log.cycles))
    (found,) = hints(spoiled)
    assert found.cause == "clocks"
    assert "different clocks" in found.likely


@pytest.mark.parametrize(
    ("first", "last", "said"),
    [
        (0.0, 8.0, ["the last detection is {end} s before the last odometry"]),
        (12.0, 99.0, ["the first detection is 12 s after the first odometry"]),
        (0.0, 99.0, []),
    ],
)
def test_detections_that_do_not_last_for_the_drive_are_told(
    first: float, last: float, said: list[str]
) -> None:
    """The lap takes half a minute; a vehicle that stands meanwhile needs no detections."""
    log = short_drive()
    end = float(log.odometry.t[-1])
    cycles = tuple(cycle for cycle in log.cycles if first <= cycle.t <= last)
    short = replace(log, cycles=cycles)
    assert [hint.found for hint in hints(short)] == [
        one.format(end=f"{end - cycles[-1].t:.3g}") for one in said
    ]
    drives = (log.odometry.t >= first) & (log.odometry.t <= last)
    parked = replace(log.odometry, twist=log.odometry.twist * drives[:, None])
    assert [hint for hint in hints(replace(short, odometry=parked)) if hint.cause == "gaps"] == []


@pytest.mark.parametrize("spacing", [0.25, 4.0])
def test_a_drive_along_lines_is_not_accused_of_moving_cones(spacing: float) -> None:
    assert hints(line_drive(1, spacing)) == []


def test_straight_walls_do_not_say_that_the_vehicle_stands() -> None:
    """From everywhere between them two walls look the same, as if nothing had moved."""
    at, t = np.arange(0.5, 15.0, 0.5), np.arange(0.0, 20.0, 0.1)
    points = np.concatenate([np.column_stack([at, np.full(len(at), side)]) for side in (1.75, -1.75)])
    labels, covariances = np.repeat([LEFT, RIGHT], len(at)), np.tile(0.01 * np.eye(2), (2 * len(at), 1, 1))
    cycles = tuple(Detections(stamp, points, covariances, labels) for stamp in t.tolist())
    odometry = Odometry(t, np.tile([2.5, 0.0, 0.0], (len(t), 1)))
    log = Log(odometry, cycles, np.array([0.1, 0.05, 0.02]), SensorInfo(kind="line"))
    assert hints(log) == []


def test_the_unit_of_the_positions_is_told_of_lines_as_well() -> None:
    """Nothing about it needs cones that stay."""
    found = hints(MISTAKES["positions in millimetres"](line_drive(1, 1.0)))
    assert [hint.cause for hint in found] == ["positions"]


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        ("speeds in the map frame, start at 137 degrees", "odometry"),
        ("sensor frame: x to the rear", "sensor frame"),
    ],
)
def test_a_noise_that_was_measured_by_wrong_odometry_hides_no_mistake(mistake: str, cause: str) -> None:
    """It is as large as that of a drive whose cones seemed to be points of a line."""
    large = RayNoise(np.array([0.7, 0.08])), RayNoise(np.array([0.9, 0.11]))
    noise = MeasuredNoise(np.full(3, 0.01), np.zeros(3), 0.025, *large)
    log = with_cycles(
        MISTAKES[mistake](short_drive()),
        lambda cycle: {"covariances": noise.covariances(cycle.points_vehicle, inflated=False)},
    )
    found = hints(replace(log, odometry_stated=False, detections_stated=False, measured=noise))
    assert [hint.cause for hint in found] == [cause]


def test_a_small_step_of_the_clock_is_told_by_its_size() -> None:
    log = short_drive()
    (found,) = hints(late(log, 0.3, float(log.odometry.t.mean())))
    assert "the clock of one file jumps or drifts, by 0.3 s about" in found.likely


def test_two_cameras_that_disagree_in_time_are_no_sensor_of_lines() -> None:
    """At five cycles a second and with their noise, a lap's cones are not met where they were."""
    settings = override(preset({"sensor": "camera"}), {"laps": 1}, "")
    log = side_late(simulate(generate_track(np.random.default_rng(1)), settings, 1), 0.05)
    (found,) = hints(log)
    assert found.cause == "sides"
    assert 35.0 < float(found.likely.split("by ")[1].split(" ms")[0]) < 65.0


# --- noise that is stated --------------------------------------------------------------------------------


def with_covariances(log: Log, factor: float) -> Log:
    cycles = [replace(cycle, covariances=factor**2 * cycle.covariances) for cycle in log.cycles]
    return replace(log, cycles=tuple(cycles))


@pytest.mark.parametrize(
    ("factor", "size", "which"), [(0.4, "small", ("vx", "vy", "wz")), (4.0, "large", ("vx", "wz"))]
)
def test_stated_noise_of_odometry_is_contradicted(factor: float, size: str, which: tuple[str, ...]) -> None:
    """A lateral velocity that is stated four times too large may stand for the drift that is assumed."""
    log = short_drive()
    (found,) = hints(replace(log, odometry_sigma=factor * log.odometry_sigma))
    assert (found.cause, found.file) == ("noise", "log.toml")
    assert f"the stated noise is too {size}" in found.likely
    assert tuple(part.split()[0] for part in found.found.split(", ") if "scatters by" in part) == which
    assert found.advice.startswith("--noise measured")


@pytest.mark.parametrize(("factor", "size"), [(0.3, "small"), (4.0, "large")])
def test_stated_covariances_are_contradicted(factor: float, size: str) -> None:
    found = hints(with_covariances(short_drive(), factor))
    assert [(hint.cause, hint.likely) for hint in found] == [("noise", f"the covariances are too {size}")]


def test_noise_that_nobody_has_stated_is_not_contradicted() -> None:
    log = with_covariances(short_drive(), 4.0)
    unstated = replace(
        log, odometry_sigma=0.1 * log.odometry_sigma, odometry_stated=False, detections_stated=False
    )
    assert hints(unstated) == []


def test_rough_motion_does_not_count_as_noise() -> None:
    t = 0.1 * np.arange(300)
    twists = np.column_stack([5.0 + np.sin(2.0 * t), 0.0 * t, 0.3 * np.cos(3.0 * t)])
    log = replace(short_drive(), odometry=Odometry(t, twists), odometry_sigma=np.full(3, 1e-4))
    found = twist_noise(log.odometry)
    assert found is not None
    orders = found[0]
    assert (orders[:, 0].max() > 2.0 * orders[:, 0].min()) and orders[:, 0].min() > 1.5e-4
    assert not any(hint.cause == "noise" and hint.file == "log.toml" for hint in hints(log))


# --- cones, or points of lines ---------------------------------------------------------------------------


PERIOD, SIGMA = 0.1, 0.05
Row = Callable[[int, float], np.ndarray]  # x (k,) of a row's points, vehicle frame, in a cycle at x (m)


def cones(cycle: int, x: float) -> np.ndarray:
    """Cones 4 m apart on the way, as they are seen ahead."""
    ahead = np.arange(0.0, 400.0, 4.0) - x
    return ahead[(ahead > 0.0) & (ahead < 20.0)]


def line(cycle: int, x: float) -> np.ndarray:
    """Points 4 m apart whose phase is another one in each cycle."""
    return np.mod(1.7 * cycle**2, 4.0) + np.arange(0.0, 20.0, 4.0)


def beams(cycle: int, x: float) -> np.ndarray:
    """Points of a wall at fixed places of the vehicle's frame."""
    return np.arange(1.0, 21.0, 3.7)


def drive(row: Row, speed: float = 10.0, across: float = 0.0) -> Log:
    """A straight drive between two rows, whose points are off them by up to `across` (m)."""
    rng, cycles = np.random.default_rng(0), []
    for cycle in range(250):
        rows = [(row(cycle, speed * PERIOD * cycle), side) for side in (2.0, -2.0)]
        points = np.concatenate([np.column_stack([own, np.full(len(own), side)]) for own, side in rows])
        points[:, 1] += across * rng.uniform(-1.0, 1.0, len(points))
        labels = np.repeat([LEFT, RIGHT], [len(own) for own, _ in rows])
        covariances = np.tile(SIGMA**2 * np.eye(2), (len(points), 1, 1))
        cycles.append(Detections(cycle * PERIOD, points, covariances, labels))
    t = PERIOD * np.arange(250)
    odometry = Odometry(t, np.tile([speed, 0.0, 0.0], (250, 1)))
    return Log(odometry, tuple(cycles), np.full(3, SIGMA))


@pytest.mark.parametrize(
    ("row", "how", "told"),
    [
        (cones, {}, False),
        (line, {}, True),
        (beams, {}, True),
        (beams, {"speed": 0.0}, None),  # at rest
        (line, {"across": 1.0}, None),  # on no line
    ],
)
def test_points_that_stay_are_cones(row: Row, how: dict[str, float], told: bool | None) -> None:
    assert is_line(drive(row, **how)) is told


@pytest.mark.parametrize(
    ("kind", "stated", "advice"),
    [
        ("line", None, ['state kind = "line", or map with --kind line']),
        ("line", "cones", ['state kind = "line", or map with --kind line']),
        ("line", "line", []),
        ("cones", None, []),
        ("cones", "cones", []),
        ("cones", "line", ['state kind = "cones", or map with --kind cones']),
    ],
)
def test_another_kind_of_sensor_than_the_stated_one_is_told(
    kind: Kind, stated: Kind | None, advice: list[str]
) -> None:
    log = line_drive(1, 1.0) if kind == "line" else short_drive()
    found = hints(replace(log, sensor=SensorInfo(kind=stated)))
    assert [hint.advice for hint in found if hint.cause == "kind"] == advice
    assert bool(objections(found)) is bool(advice)


@pytest.mark.parametrize("spacing", [0.25, 1.0, 4.0])
def test_a_drive_along_lines_of_any_spacing_is_told(spacing: float) -> None:
    assert is_line(line_drive(1, spacing))


def test_a_setting_comes_before_the_log_and_cones_are_the_default() -> None:
    known = {
        (setting, stated): MapperSettings(kind=setting).with_kind(stated)
        for setting, stated in product((None, *KINDS), repeat=2)
    }
    assert all(one.kind == (setting or stated or "cones") for (setting, stated), one in known.items())
    assert all(one.stations != one.of_lines for one in known.values())
