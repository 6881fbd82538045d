"""The gate: what is refused, what is dropped, and what is left of the stream of twists."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph import ReadingError
from pathspace_graph.errors import InputError, PathspaceError
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.front_end import gate
from pathspace_graph.front_end.gate import Admitted, Gate
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.log_files import write_log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.mapper import LimitSettings

from ..scenes.drives import ahead, corridor, exact_log

Array = NDArray[np.float64]
LIMITS = LimitSettings()
NEWEST = 1.0, np.array([4.0, 0.1, 0.2])
STAMPS = np.array([1.0, 1.02, 1.06])
TWISTS = np.array([[5.0, 0.0, 0.1], [6.0, 0.0, 0.2], [7.0, 0.0, 0.3]])


NONE = Odometry(np.zeros(0), np.zeros((0, 3)))


def odometry(stamps: Any = STAMPS, twists: Any = TWISTS) -> Odometry:
    return Odometry(stamps, twists)


def detections(t: Any = 1.1, **changes: Any) -> Detections:
    good = Detections(
        t,
        np.array([[5.0, 2.0], [6.0, -2.0], [9.0, 2.0]]),
        np.tile(0.01 * np.eye(2), (3, 1, 1)),
        np.array([0, 1, 2]),
    )
    return replace(good, **changes)


def with_entry(array: np.ndarray[Any, Any], index: Any, value: Any) -> np.ndarray[Any, Any]:
    changed = array.copy()
    changed[index] = value
    return changed


def through(twists: Any = None, cycle: Any = None, newest: Any = NEWEST) -> Admitted:
    return Gate(LIMITS).admit(twists or odometry(), cycle or detections(), *newest)


# --- what is used ----------------------------------------------------------------------------------------


def test_a_good_cycle_goes_through_as_it_is_in_arrays_of_its_own() -> None:
    handed, cycle = odometry(), detections()
    admitted = Gate(LIMITS).admit(handed, cycle, *NEWEST)
    np.testing.assert_array_equal(admitted.odometry.t, STAMPS)
    np.testing.assert_array_equal(admitted.odometry.twist, TWISTS)
    for name in ("t", "points_vehicle", "covariances", "labels"):
        np.testing.assert_array_equal(getattr(admitted.detections, name), getattr(cycle, name))
    for mine, theirs in (
        (admitted.odometry.t, handed.t),
        (admitted.odometry.twist, handed.twist),
        (admitted.detections.points_vehicle, cycle.points_vehicle),
        (admitted.detections.covariances, cycle.covariances),
        (admitted.detections.labels, cycle.labels),
    ):
        assert not np.shares_memory(mine, theirs)
    assert (admitted.dropped, admitted.refused, admitted.notice) == (0, 0, "")


def test_the_first_cycle_may_have_any_stamp_and_no_twist() -> None:
    empty = odometry(np.zeros(0), np.zeros((0, 3)))
    for t in (-5.0, 0.0, 1.7e9):
        assert len(through(empty, detections(t), ()).odometry.t) == 0


def test_plain_lists_and_whole_numbers_are_numbers() -> None:
    admitted = through(odometry([1, 1.05], [[5, 0, 0], [6, 0, 0]]), detections(labels=[0, 1, 2]))
    assert admitted.odometry.twist.dtype == np.float64
    assert admitted.detections.labels.tolist() == [0, 1, 2]


# --- the stream of twists --------------------------------------------------------------------------------


def test_the_twist_measured_last_is_held_until_the_first_one_handed_over() -> None:
    admitted = through(odometry(STAMPS[1:], TWISTS[1:]))
    np.testing.assert_array_equal(admitted.odometry.t, STAMPS)
    np.testing.assert_array_equal(admitted.odometry.twist, [NEWEST[1], *TWISTS[1:]])


def test_without_any_twist_the_one_measured_last_is_held() -> None:
    admitted = through(odometry(np.zeros(0), np.zeros((0, 3))))
    np.testing.assert_array_equal(admitted.odometry.t, [1.0])
    np.testing.assert_array_equal(admitted.odometry.twist, [NEWEST[1]])


def test_what_was_in_force_before_the_newest_cycle_is_left_out() -> None:
    stamps = np.array([0.9, 0.95, 0.98, 1.05])
    twists = np.arange(12.0).reshape(4, 3) / 10.0
    admitted = through(odometry(stamps, twists))
    np.testing.assert_array_equal(admitted.odometry.t, [1.0, 1.05])
    np.testing.assert_array_equal(admitted.odometry.twist, twists[2:])
    np.testing.assert_array_equal(stamps, [0.9, 0.95, 0.98, 1.05])


# --- what is refused -------------------------------------------------------------------------------------


def stamps(row: int, value: float) -> Odometry:
    return odometry(with_entry(STAMPS, row, value))


def twist(row: int, column: int, value: float) -> Odometry:
    return odometry(twists=with_entry(TWISTS, (row, column), value))


MANY = Detections(1.1, np.ones((501, 2)), np.tile(np.eye(2), (501, 1, 1)), np.zeros(501, int))
STAMPED = {
    "a stamp that is none": (None, "number"),
    "NaN as a stamp": (np.nan, "found nan"),
    "infinity as a stamp": (-np.inf, "-inf"),
    "nanoseconds": (1e18, "are in seconds"),
    "milliseconds": (1100.0, "are in seconds"),
    "a minute ahead": (61.2, "at most 30 s after"),
    "backwards": (0.9, "later than the newest"),
    "twice": (1.0, "later than the newest"),
}
DRIVEN = {
    "a twist after the cycle": (odometry(STAMPS + 0.05), "t", 2, "none later than the cycle"),
    "twists out of order": (odometry(STAMPS[[0, 2, 1]]), "t", 2, "later than the one before"),
    "a twist twice": (odometry(STAMPS[[0, 1, 1]]), "t", 2, "later than the one"),
    "NaN as a twist's stamp": (stamps(1, np.nan), "t", 1, "found nan"),
    "NaN as a speed": (twist(1, 0, np.nan), "twist", 1, "vx from -100 to 100 m/s, found nan"),
    "infinite speed": (twist(0, 1, np.inf), "twist", 0, "vy from -100 to 100 m/s, found inf"),
    "no vehicle's speed": (twist(2, 0, -1e5), "twist", 2, "vx from -100 to 100 m/s, found -100000"),
    "no vehicle's turn": (twist(2, 2, 11.0), "twist", 2, "wz from -10 to 10 rad/s, found 11"),
    "fewer twists": (
        odometry(twists=TWISTS[:2]),
        "twist",
        None,
        r"shape \(3, 3\), found .* \(2, 3\)",
    ),
    "twists of two numbers": (odometry(twists=TWISTS[:, :2]), "twist", None, "shape"),
    "words as twists": (odometry(twists=[["a"] * 3] * 3), "twist", None, "numbers"),
    "ragged twists": (odometry(twists=[[1.0], [1.0, 2.0], []]), "twist", None, "different lengths"),
}
SEEN = {
    "points of three": (
        detections(points_vehicle=np.zeros((3, 3))),
        "points_vehicle",
        None,
        r"\(m, 2\)",
    ),
    "too few covariances": (detections(covariances=np.zeros((2, 2, 2))), "covariances", None, "shape"),
    "too few labels": (detections(labels=[0]), "labels", None, "shape"),
    "labels as words": (detections(labels=["left", "right", "left"]), "labels", None, "integers"),
    "labels as numbers": (detections(labels=np.array([0.0, 1.0, 1.0])), "labels", None, "integers"),
    "no such label": (detections(labels=np.array([0, 7, 1])), "labels", 1, "found 7"),
    "too many detections": (MANY, "points_vehicle", None, "at most 500 rows"),
}
Refused = tuple[Any, Any, Any, str, int | None, str]
REFUSED: dict[str, Refused] = {
    "no odometry": (None, detections(), NEWEST, "odometry", None, "Odometry"),
    "no detections": (odometry(), None, NEWEST, "detections", None, "Detections"),
    "nanoseconds at first": (
        odometry(),
        detections(1.7e18),
        (),
        "detections.t",
        None,
        "are in seconds",
    ),
    "at once": (NONE, detections(1.0005), NEWEST, "detections.t", None, "at least 0.001 s after the newest"),
    "a minute without twists": (
        *(odometry(STAMPS + np.array([0.0, 60.0, 60.0])), detections(61.1), NEWEST),
        *("odometry.t", 1, "at most 30 s after the reading at 1 s"),
    ),
    **{
        k: (odometry(), detections(t), NEWEST, "detections.t", None, said) for k, (t, said) in STAMPED.items()
    },
    **{k: (own, detections(), NEWEST, f"odometry.{f}", *said) for k, (own, f, *said) in DRIVEN.items()},
    **{k: (odometry(), own, NEWEST, f"detections.{f}", *said) for k, (own, f, *said) in SEEN.items()},
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_named_with_field_row_and_what_was_expected(name: str) -> None:
    given, cycle, newest, field, row, text = REFUSED[name]
    with pytest.raises(ReadingError, match=text) as caught:
        Gate(LIMITS).admit(given, cycle, *newest)
    assert (caught.value.field, caught.value.row) == (field, row)
    assert field in str(caught.value)
    assert isinstance(caught.value, PathspaceError)
    assert "\n" not in str(caught.value)


def test_an_error_survives_the_way_from_a_worker() -> None:
    error = ReadingError("odometry.twist", "less", 3.0, 2, 1.5)
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) == "cycle at 1.5 s: odometry.twist, row 2: expected less, found 3"
    assert vars(again) == vars(error)


def test_what_is_refused_is_a_setting() -> None:
    wide = LimitSettings(speed=2e5, silence=100.0)
    fast = odometry(twists=with_entry(TWISTS, (2, 0), 1e5))
    assert Gate(wide).admit(fast, detections(61.2), *NEWEST).odometry.twist[2, 0] == 1e5


def test_one_stamp_far_ahead_is_an_error_and_two_that_agree_are_a_vehicle_that_was_silent() -> None:
    gate = Gate(LimitSettings())
    for late in (61.0, 500.0, 961.0):
        with pytest.raises(ReadingError, match="at most 30 s after"):
            gate.admit(odometry(), detections(late), *NEWEST)
    admitted = gate.admit(odometry(), detections(961.1), *NEWEST)
    assert (admitted.detections.t, admitted.refused) == (961.1, 3)
    assert admitted.odometry.t[0] == NEWEST[0]  # the last twist is held meanwhile
    with pytest.raises(ReadingError):
        gate.admit(odometry(), detections(2000.0), 961.1)
    assert gate.admit(odometry(), detections(NEWEST[0] + 0.1), *NEWEST).refused == 1


# --- what is dropped -------------------------------------------------------------------------------------


def turned(x: float, y: float) -> Array:
    """A vector in axes that are turned by 0.5 rad."""
    return np.asarray(rotation(0.5) @ [x, y])


def axes(along: float, across: float) -> Array:
    """The covariance (2, 2) with these standard deviations (m) in axes that are turned by 0.5 rad."""
    return np.asarray(rotation(0.5) @ np.diag(np.square([along, across])) @ rotation(0.5).T)


COVARIANCES = detections().covariances
POINTS = detections().points_vehicle
DROPPED = {
    "NaN": {"points_vehicle": with_entry(POINTS, (1, 0), np.nan)},
    "infinity": {"points_vehicle": with_entry(POINTS, (1, 1), -np.inf)},
    "beyond the sensor": {"points_vehicle": with_entry(POINTS, 1, turned(1.001 * LIMITS.range_max, 0.0))},
    "far beyond the sensor": {"points_vehicle": with_entry(POINTS, (1, 0), 1e200)},
    "too near": {"points_vehicle": with_entry(POINTS, 1, turned(0.999 * gate.MIN_RANGE, 0.0))},
    "at the vehicle": {"points_vehicle": with_entry(POINTS, 1, 0.0)},
    "NaN as a covariance": {"covariances": with_entry(COVARIANCES, (1, 0, 0), np.nan)},
    "infinite covariance": {"covariances": with_entry(COVARIANCES, 1, np.inf)},
    "no covariance": {"covariances": with_entry(COVARIANCES, 1, 0.0)},
    "negative covariance": {"covariances": with_entry(COVARIANCES, 1, -0.01)},
    "indefinite covariance": {"covariances": with_entry(COVARIANCES, (1, slice(None), slice(None)), 0.02)},
    "asymmetric covariance": {"covariances": with_entry(COVARIANCES, (1, 0, 1), 0.005)},
    "long covariance": {"covariances": with_entry(COVARIANCES, 1, axes(1.001 * gate.MAX_SIGMA, 1.0))},
    "thin covariance": {"covariances": with_entry(COVARIANCES, 1, axes(1.0, 0.999 * gate.MIN_SIGMA))},
    "huge covariance": {"covariances": with_entry(COVARIANCES, (1, 0, 0), 1e308)},
    "tiny covariance": {"covariances": with_entry(COVARIANCES, (1, 0, 0), 1e-300)},
}


@pytest.mark.parametrize("name", DROPPED)
def test_a_single_impossible_detection_is_dropped(name: str) -> None:
    admitted = through(cycle=detections(**DROPPED[name]))
    assert admitted.dropped == 1
    np.testing.assert_array_equal(admitted.detections.points_vehicle, POINTS[[0, 2]])
    np.testing.assert_array_equal(admitted.detections.covariances, COVARIANCES[[0, 2]])
    np.testing.assert_array_equal(admitted.detections.labels, [0, 2])
    assert admitted.notice.startswith("1 of 3 detections dropped: expected a ")
    assert admitted.notice.endswith("in row 1")


@pytest.mark.parametrize(
    ("along", "across"),
    [
        (0.999 * gate.MAX_SIGMA, 0.5 * gate.MAX_SIGMA),
        (0.999 * gate.MAX_SIGMA, 1e-3),
        (1.001 * gate.MIN_SIGMA, 1.001 * gate.MIN_SIGMA),
        (0.1, 1.001 * gate.MIN_SIGMA),
    ],
)
def test_long_and_thin_covariances_are_possible_up_to_the_limits(along: float, across: float) -> None:
    covariances = with_entry(COVARIANCES, 1, axes(along, across))
    assert through(cycle=detections(covariances=covariances)).dropped == 0


@pytest.mark.parametrize("distance", [1.001 * gate.MIN_RANGE, 0.999 * LIMITS.range_max])
def test_detections_are_possible_up_to_the_limits_of_the_range(distance: float) -> None:
    points = with_entry(POINTS, 1, turned(distance, 0.0))
    assert through(cycle=detections(points_vehicle=points)).dropped == 0


def test_the_notice_comes_once_in_a_row() -> None:
    gate, bad = Gate(LIMITS), DROPPED["NaN"]
    told = []
    for k, spoilt in enumerate([True, True, False, True]):
        cycle = detections(1.1 + k, **(bad if spoilt else {}))
        told.append(bool(gate.admit(odometry(STAMPS + k), cycle, 1.0 + k).notice))
    assert told == [True, False, False, True]


def test_refused_cycles_are_counted_until_one_is_used() -> None:
    gate = Gate(LIMITS)
    for _ in range(3):
        with pytest.raises(ReadingError):
            gate.admit(odometry(), detections(np.nan), *NEWEST)
    assert gate.admit(odometry(), detections(), *NEWEST).refused == 3
    assert gate.admit(odometry(STAMPS + 1), detections(2.1), 2.0).refused == 0


# --- logs ------------------------------------------------------------------------------------------------


def test_a_log_that_cannot_be_used_is_named_with_the_row_and_the_stamp(tmp_path: Path) -> None:
    log = exact_log(ahead(8.0, 2.0), *corridor(40.0))
    write_log(log, tmp_path / "good")
    assert len(read_plausible_log(tmp_path / "good", LIMITS)[0].cycles) == len(log.cycles)
    twists = with_entry(log.odometry.twist, (37, 2), 1e3)
    write_log(replace(log, odometry=Odometry(log.odometry.t, twists)), tmp_path / "bad")
    with pytest.raises(InputError, match=r"odometry\.csv, row 39: cycle at 0\.8 s: .* found 1000"):
        read_plausible_log(tmp_path / "bad", LIMITS)[0]
    late = tuple(replace(cycle, t=cycle.t + 100.0 * (cycle.t > 0.95)) for cycle in log.cycles)
    stamps = log.odometry.t + 100.0 * (log.odometry.t > 0.95)
    write_log(replace(log, cycles=late, odometry=Odometry(stamps, log.odometry.twist)), tmp_path / "gap")
    with pytest.raises(InputError, match=r"odometry\.csv, row 50: .* at most 30 s after"):
        read_plausible_log(tmp_path / "gap", LIMITS)[0]


def from_two_cameras(log: Log, seconds: float, resolution: float = 0.0) -> Log:
    """The same drive since 1970, whose right cones are seen so much later than the left ones."""
    cycles = []
    for cycle in log.cycles[:-1]:
        for late, label in ((0.0, LEFT), (seconds, RIGHT)):
            t = EPOCH + cycle.t + late
            stamp = round(t / resolution) * resolution if resolution else t
            cycles.append(replace(cycle.where(cycle.labels == label), t=stamp))
    return replace(log, odometry=replace(log.odometry, t=EPOCH + log.odometry.t), cycles=tuple(cycles))


EPOCH = 1_700_000_000.0


@pytest.mark.parametrize(
    ("seconds", "resolution", "of_each"),
    [
        *((0.0, 0.0, 1), (2e-4, 0.0, 1), (5e-4, 0.0, 1), (5e-4, 1e-3, 1), (1e-3, 0.0, 1), (1e-3, 1e-3, 1)),
        *((1.1e-3, 0.0, 2), (2e-3, 1e-3, 2), (3e-3, 0.0, 2)),
    ],
)
def test_messages_of_two_cameras_are_one_cycle_or_each_is_used_at_its_time(
    seconds: float, resolution: float, of_each: int, tmp_path: Path
) -> None:
    log = exact_log(ahead(8.0, 2.0), *corridor(40.0))
    write_log(from_two_cameras(log, seconds, resolution), tmp_path / "log")
    read = read_plausible_log(tmp_path / "log", LIMITS)[0]
    assert len(read.cycles) == of_each * (len(log.cycles) - 1)
    if of_each == 1:
        for cycle, exact in zip(read.cycles, log.cycles[:-1], strict=True):
            assert abs(cycle.t - EPOCH - exact.t) < 6e-4
            assert sorted(cycle.points_vehicle.tolist()) == sorted(exact.points_vehicle.tolist())


def test_a_detector_with_stamps_in_milliseconds_may_give_a_cycle_in_each() -> None:
    """4.201 - 4.2 is less than 0.001 in doubles."""
    assert 4.201 - 4.2 < 1e-3
    assert Gate(LIMITS).admit(NONE, detections(4.201), 4.2).refused == 0


def test_a_laser_scan_is_thinned_evenly_where_points_are_of_lines() -> None:
    """1,080 points along y = 2 become every third of them; as cones they are refused."""
    x = np.linspace(0.1, 20.0, 1080)
    points, covariances = np.column_stack([x, np.full(1080, 2.0)]), np.tile(0.01 * np.eye(2), (1080, 1, 1))
    scan = Detections(4.3, points, covariances, np.zeros(1080, int))
    admitted = Gate(LIMITS, of_lines=True).admit(NONE, scan, 4.2)
    np.testing.assert_array_equal(admitted.detections.points_vehicle, points[::3])
    assert admitted.dropped == 0
    with pytest.raises(ReadingError, match="at most 500 rows, found 1080"):
        Gate(LIMITS).admit(NONE, scan, 4.2)
