"""The kind of a sensor: things that stay where they are, or points of a line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo
from pathspace_graph.labels import KINDS, LEFT, RIGHT, Kind
from pathspace_graph.plausibility.judge import hints, is_line, objections
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import short_drive
from ..scenes.lines import line_drive

SPEED, PERIOD, SIGMA = 10.0, 0.1, 0.05
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


def drive(left: Row, right: Row, speed: float = SPEED, across: float = 0.0) -> Log:
    """A straight drive between two rows, whose points are off them by up to `across` (m)."""
    rng, cycles = np.random.default_rng(0), []
    for cycle in range(250):
        x = speed * PERIOD * cycle
        rows = [(row(cycle, x), side) for row, side in ((left, 2.0), (right, -2.0))]
        points = np.concatenate([np.column_stack([own, np.full(len(own), side)]) for own, side in rows])
        points[:, 1] += across * rng.uniform(-1.0, 1.0, len(points))
        labels = np.repeat([LEFT, RIGHT], [len(own) for own, _ in rows])
        covariances = np.tile(SIGMA**2 * np.eye(2), (len(points), 1, 1))
        cycles.append(Detections(cycle * PERIOD, points, covariances, labels))
    t = PERIOD * np.arange(250)
    odometry = Odometry(t, np.tile([speed, 0.0, 0.0], (250, 1)))
    return Log(odometry, tuple(cycles), np.full(3, SIGMA))


@pytest.mark.parametrize(
    ("left", "right", "told"),
    [(cones, cones, False), (line, line, True), (beams, beams, True)],
)
def test_points_that_stay_are_cones(left: Row, right: Row, told: bool | None) -> None:
    assert is_line(drive(left, right)) is told


def test_at_rest_nothing_is_told() -> None:
    assert is_line(drive(beams, beams, speed=0.0)) is None


def test_points_that_lie_on_no_line_are_none_of_a_line() -> None:
    assert is_line(drive(line, line, across=1.0)) is None


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


@pytest.mark.parametrize(("stated", "told"), [(None, True), ("cones", True), ("line", False)])
def test_lines_that_are_not_said_to_be_some_get_a_hint(stated: Kind | None, told: bool) -> None:
    log = replace(line_drive(1, 1.0), sensor=SensorInfo(kind=stated))
    found = [hint for hint in hints(log) if hint.cause == "kind"]
    assert [hint.advice for hint in found] == ['state kind = "line", or map with --kind line'] * told
    assert bool(objections(found)) is told


@pytest.mark.parametrize(("stated", "told"), [(None, False), ("cones", False), ("line", True)])
def test_cones_that_are_said_to_be_lines_get_a_hint(stated: Kind | None, told: bool) -> None:
    log = replace(short_drive(), sensor=SensorInfo(kind=stated))
    assert ["kind" in hint.cause for hint in hints(log)] == [True] * told
