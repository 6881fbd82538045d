"""The kind of a sensor: things that stay where they are, or points of a line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.front_end.front_end import OF_LINES, FrontEnd
from pathspace_graph.front_end.kind import KindJudge, kind_of, with_kind
from pathspace_graph.io.log import Detections, Odometry, SensorInfo
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.lines import line_drive

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


def drive(left: Row, right: Row, speed: float = SPEED, across: float = 0.0) -> KindJudge:
    """Judge of a straight drive between two rows, whose points are off them by up to `across` (m)."""
    judge, rng = KindJudge(), np.random.default_rng(0)
    for cycle in range(250):
        x = speed * PERIOD * cycle
        rows = [(row(cycle, x), side) for row, side in ((left, 2.0), (right, -2.0))]
        points = np.concatenate([np.column_stack([own, np.full(len(own), side)]) for own, side in rows])
        points[:, 1] += across * rng.uniform(-1.0, 1.0, len(points))
        labels = np.repeat([LEFT, RIGHT], [len(own) for own, _ in rows])
        covariances = np.tile(SIGMA**2 * np.eye(2), (len(points), 1, 1))
        twist = np.array([[speed, 0.0, 0.0]])
        odometry = Odometry(np.array([max(cycle - 1, 0) * PERIOD]), twist)
        judge.see(odometry, Detections(cycle * PERIOD, points, covariances, labels))
    return judge


@pytest.mark.parametrize(
    ("left", "right", "kind"),
    [
        (cones, cones, "cones"),
        (line, line, "line"),
        (beams, beams, "line"),
        (cones, line, "line-right"),
        (line, cones, "line-left"),
    ],
)
def test_each_side_is_judged_by_whether_its_points_stay(left: Row, right: Row, kind: str) -> None:
    assert drive(left, right).kind == kind


def test_at_rest_nothing_is_told() -> None:
    assert drive(cones, beams, speed=0.0).kind is None


def test_points_that_lie_on_no_line_are_none_of_a_line() -> None:
    assert drive(line, line, across=1.0).kind is None


@pytest.mark.parametrize("spacing", [0.25, 1.0, 4.0])
def test_a_drive_along_lines_of_any_spacing_is_told(spacing: float) -> None:
    assert kind_of(line_drive(1, spacing)) == "line"


def test_a_setting_comes_before_the_log_and_the_log_before_its_readings() -> None:
    log = line_drive(1, 1.0)
    stated = replace(log, sensor=SensorInfo(kind="cones"))
    found = {
        "by readings": with_kind(MapperSettings(), log),
        "by the log": with_kind(MapperSettings(), stated),
        "by a setting": with_kind(MapperSettings(kind="line-left"), stated),
    }
    kinds = {name: (settings.kind, settings.lines, settings.stations) for name, settings in found.items()}
    assert kinds == {
        "by readings": ("line", (LEFT, RIGHT), False),
        "by the log": ("cones", (), True),
        "by a setting": ("line-left", (LEFT,), False),
    }


def test_a_live_mapper_tells_once_that_it_takes_lines_for_cones() -> None:
    log = line_drive(1, 1.0)
    notices = {}
    for kind in (None, "line"):
        front_end = FrontEnd(MapperSettings(kind=kind), log.noise)
        readings = [front_end.update(*cycle).notice for cycle in list(split_odometry(log))[:160]]
        notices[kind] = [notice for notice in readings if notice]
    assert notices == {None: [OF_LINES.format("line")], "line": []}
