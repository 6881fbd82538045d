"""Scans, dense clouds and polylines become points along the boundaries of the driven path."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.convert.messages import ALONE, DENSE, Points, points_of
from pathspace_graph.convert.recording import ReckonedPath, lines_of, spaced_apart
from pathspace_graph.convert.settings import Frames, LabelRule
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.io.log_files import read_log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.ros.node import MessageStream

from ..scenes.corridor import MOUNTING, RANGE_MAX, Corridor, corridor, write_json_lines
from .bags import Messages

RULE = LabelRule()
AHEAD = Odometry(np.arange(0.0, 10.01, 0.1), np.tile([1.0, 0.0, 0.0], (101, 1)))
"""Ten metres along x at 1 m/s."""


@pytest.fixture(scope="module")
def messages() -> Messages:
    return Messages()


def scan(messages: Messages, t: float, ranges: Any, angle_min: float, increment: float) -> Any:
    return messages.make(
        "sensor_msgs/msg/LaserScan",
        header=messages.header(t),
        angle_min=angle_min,
        angle_max=angle_min + increment * (len(ranges) - 1),
        angle_increment=increment,
        range_min=0.1,
        range_max=RANGE_MAX,
        ranges=np.array(ranges, np.float32),
        intensities=np.zeros(0, np.float32),
    )


# --- messages --------------------------------------------------------------------------------------------


def test_the_beams_of_a_scan_are_points_where_they_have_hit(messages: Messages) -> None:
    ranges = [2.0, np.inf, np.nan, 0.05, 0.1, 10.5, 3.0, -np.inf, 10.0]
    found = points_of(scan(messages, 1.0, ranges, -np.pi / 2, np.pi / 8), RULE)
    forward = 3.0 * np.sqrt(0.5)
    expected = [[0.0, -2.0], [0.1, 0.0], [forward, forward], [0.0, 10.0]]
    np.testing.assert_allclose(found.points, expected, atol=1e-6)
    assert found.labels.tolist() == [UNKNOWN] * 4
    assert found.lines.tolist() == [DENSE] * 4
    assert np.isnan(found.covariances).all()


def test_strips_of_markers_are_polylines_and_other_markers_are_not(messages: Messages) -> None:
    strip = messages.marker(1.0, (1.0, 0.0), (0.0, 0.0, 1.0), kind=4)
    strip.points = [messages.vector("Point", x, 2.0) for x in (0.0, 4.0)]
    cone = messages.marker(1.0, (7.0, -2.0), (1.0, 1.0, 0.0))
    found = points_of(messages.markers([cone, strip]), RULE)
    np.testing.assert_array_equal(found.points, [[7.0, -2.0], [1.0, 2.0], [5.0, 2.0]])
    assert found.lines.tolist() == [ALONE, 1, 1]
    assert found.labels.tolist() == [RIGHT, LEFT, LEFT]


def test_lists_of_points_and_arrays_are_polylines() -> None:
    """Lane markings come as lists of points, as poses, or as an array for each coordinate."""
    point = lambda x, y: SimpleNamespace(x=x, y=y)  # noqa: E731
    pose = lambda x, y: SimpleNamespace(pose=SimpleNamespace(position=point(x, y)))  # noqa: E731
    message = SimpleNamespace(
        left_lanes=[SimpleNamespace(points=[point(1.0, 2.0), point(3.0, 2.0)])],
        lanes=[
            SimpleNamespace(id=3, waypoints=[pose(1.0, -2.0), pose(3.0, -2.5), pose(5.0, -2.0)]),
            SimpleNamespace(x=np.array([1.0, 2.0]), y=np.array([5.0, 6.0]), type="solid"),
        ],
    )
    found = points_of(message, RULE)
    np.testing.assert_array_equal(found.points[:, 0], [1.0, 3.0, 1.0, 3.0, 5.0, 1.0, 2.0])
    assert found.lines.tolist() == [0, 0, 1, 1, 1, 2, 2]
    assert found.labels.tolist() == [LEFT, LEFT, *[UNKNOWN] * 5]


# --- spacing ---------------------------------------------------------------------------------------------


def test_dense_points_are_thinned_by_bearing_to_a_spacing() -> None:
    # a wall 2 m to the right from behind to ahead: bearings grow with x
    x = np.arange(-1.0, 1.0, 0.1)
    wall = np.column_stack([x, np.full(20, -2.0)])
    kept = spaced_apart(wall[::-1], 0.35, np.ones(20, bool))
    np.testing.assert_allclose(wall[::-1][kept][:, 0], [-1.0, -0.6, -0.2, 0.2, 0.6], atol=1e-12)
    assert spaced_apart(wall, 0.35, np.zeros(20, bool)).tolist() == []


def test_thinning_does_not_choose_by_range() -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(-1.0, 1.0, 2001)
    ranges = 2.0 + 0.05 * rng.standard_normal(2001)
    points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    kept = spaced_apart(points, 0.05, np.ones(2001, bool))
    assert np.hypot(*points[kept].T).mean() == pytest.approx(2.0, abs=0.015)
    apart = np.linalg.norm(points[kept][:, None] - points[kept], axis=2) + np.eye(len(kept))
    assert apart.min() >= 0.05


# --- sides -----------------------------------------------------------------------------------------------


def test_the_distance_to_the_left_of_the_way_is_that_of_the_stretch_around_the_vehicle() -> None:
    path = ReckonedPath.of(AHEAD, 0.01)
    points = np.array([[2.0, 1.5], [2.0, -1.0], [-3.0, 1.0], [-6.0, 1.0], [6.0, 1.0]])
    # at 5 s the vehicle is at x = 5: the last two points are beyond the ends of the way
    np.testing.assert_allclose(path.lateral(5.0, points), [1.5, -1.0, 1.0, np.nan, np.nan], atol=1e-3)


def test_a_stretch_that_comes_near_later_does_not_decide_a_side() -> None:
    """The way goes along x for 10 m, turns left by half a circle of 3 m, and comes back 6 m beside."""
    rate = 100.0
    straight, bend = np.zeros(1000), np.full(round(np.pi * 300), 1.0 / 3.0)
    turn = np.concatenate([straight, bend, straight])
    twists = np.column_stack([np.ones(len(turn)), np.zeros(len(turn)), turn])
    path = ReckonedPath.of(Odometry(np.arange(len(turn)) / rate, twists), 0.02)
    # 3.8 m to the left, nearer to the way back, is left of the way there, and of the way back as well
    there = path.lateral(2.0, np.array([[0.0, 3.8]]))
    np.testing.assert_allclose(there, [3.8], atol=0.02)
    # ahead in the bend, the outer wall is to the right of the way that is driven later
    ahead = path.lateral(8.0, np.array([[6.5, 2.0]]))
    assert ahead[0] == pytest.approx(-(np.hypot(4.5, -1.0) - 3.0), abs=0.02)


def test_sides_are_those_of_the_way_and_what_is_far_is_left_out() -> None:
    row = np.column_stack([np.arange(0.0, 4.0, 0.5), np.full(8, 1.0)])
    points = np.concatenate([row, row * [1.0, -1.0], [[1.0, 5.0]]])
    scan = Points.of(points, np.full(17, UNKNOWN), lines=DENSE)
    notes: Counter[str] = Counter()
    found = lines_of(np.array([1.0, 2.0, 3.0]), Points.joined([scan] * 3), AHEAD, Frames(), 0.5, notes)
    for one in found.apart(3):
        assert len(one.labels) == 16
        np.testing.assert_array_equal(one.labels == LEFT, one.points[:, 1] > 0.0)
        np.testing.assert_array_equal(one.labels == RIGHT, one.points[:, 1] < 0.0)
    assert notes["points of lines were too far from the driven path, and were left out"] == 3
    mirrored = lines_of(np.array([1.0]), scan, AHEAD, Frames(y="right"), 0.5, notes)
    np.testing.assert_array_equal(mirrored.labels == RIGHT, mirrored.points[:, 1] > 0.0)


def test_of_parallel_markings_the_nearest_ones_bound_the_lane_in_all_their_dashes() -> None:
    def line(begin: float, end: float, y: float) -> np.ndarray:
        return np.array([[begin, y], [end, y]])

    lines = [line(0.0, 2.0, 1.7), line(3.0, 5.0, 1.9), line(0.0, 5.0, 5.2), line(0.0, 5.0, -1.8)]
    vertices = Points.of(np.concatenate(lines), np.full(8, UNKNOWN), lines=np.repeat(range(4), 2))
    found = lines_of(np.array([2.0]), vertices, AHEAD, Frames(), 1.0, Counter())
    assert found.points[:, 1].tolist() == [1.7] * 3 + [1.9] * 3 + [-1.8] * 6
    assert found.labels.tolist() == [LEFT] * 6 + [RIGHT] * 6


def test_a_polyline_before_the_begin_of_the_path_has_no_side_and_is_kept() -> None:
    vertices = Points.of([[-4.0, 1.7], [-2.0, 1.7]], np.full(2, UNKNOWN), lines=[0, 0])
    found = lines_of(np.array([0.0]), vertices, AHEAD, Frames(), 1.0, Counter())
    assert found.labels.tolist() == [UNKNOWN] * 3


def test_a_scan_that_arrives_is_thinned_and_the_estimator_tells_its_sides(messages: Messages) -> None:
    stream = MessageStream()
    for t in (0.0, 0.1):
        stream.take_odometry(messages.odometry(t, (1.0, 0.0, 0.0)), 0.0)
    ((_, cycle),) = stream.take_detections(scan(messages, 0.1, np.full(361, 4.0), -np.pi, np.pi / 180), 0.0)
    # 0.15 of 4 m apart on a circle of 4 m: 9 beams have a chord of 0.63 m
    assert len(cycle.labels) == 40
    np.testing.assert_allclose(np.hypot(*cycle.points_vehicle.T), 4.0)
    assert set(cycle.labels.tolist()) == {UNKNOWN}


# --- whole records ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Corridor:
    return corridor(laps=1)


NOISE = ["--sigma-odometry", "0.05", "0.02", "0.03", "--sigma-range", "0.02", "--sigma-range-growth", "0"]
MOUNTED = ["--mounting", *map(str, MOUNTING)]


def converted(source: Path, out: Path, *options: str) -> Log:
    assert main(["convert", str(source), "--out", str(out), *MOUNTED, *NOISE, *options]) == 0
    return read_log(out)


def of_wall(points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """The distances (m,) of points to a wall, whose vertices are 0.6 m apart."""
    begin, step = wall[:-1], np.diff(wall, axis=0)
    offset = points[:, None] - begin
    part = np.clip((offset * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - part[..., None] * step, axis=2).min(axis=1))


def test_the_walls_of_a_corridor_have_their_sides(scene: Corridor, tmp_path: Path) -> None:
    file = write_json_lines(scene, tmp_path / "car.jsonl")
    log = converted(file, tmp_path / "log", "--from", "jsonl")
    assert log.sensor.kind == "line"
    counts = [len(cycle.labels) for cycle in log.cycles]
    assert 30 < np.mean(counts) < 100
    poses = dict(zip(scene.scan_t.round(6).tolist(), scene.poses, strict=True))
    known = 0
    for cycle in log.cycles[::10]:
        x, y, theta = poses[round(cycle.t, 6)]
        c, s = np.cos(theta), np.sin(theta)
        points = cycle.points_vehicle @ np.array([[c, s], [-s, c]]) + [x, y]
        to_left, to_right = of_wall(points, scene.left), of_wall(points, scene.right)
        assert np.minimum(to_left, to_right).max() < 0.1
        labelled = cycle.labels != UNKNOWN
        known += int(labelled.sum())
        true = np.where(to_left < to_right, LEFT, RIGHT)
        np.testing.assert_array_equal(cycle.labels[labelled], true[labelled])
    assert known > 0.9 * sum(counts[::10])


def test_json_lines_hold_polylines(tmp_path: Path) -> None:
    lines = [json.dumps({"t": 0.1 * k, "twist": [2.0, 0.0, 0.0]}) for k in range(60)]
    markings = [
        {"points": [[0.0, 1.5], [8.0, 1.5]], "label": "yellow"},
        {"points": [[0.0, -1.5], [8.0, -1.5]]},
    ]
    lines += [json.dumps({"t": 0.1 * k, "polylines": markings}) for k in range(1, 20)]
    (tmp_path / "drive.jsonl").write_text("\n".join(lines))
    log = converted(tmp_path / "drive.jsonl", tmp_path / "log", "--from", "jsonl", "--spacing", "2")
    points, labels = log.cycles[3].points_vehicle, log.cycles[3].labels
    np.testing.assert_allclose(points[:5] - [MOUNTING[0], 0.0], [[x, 1.5] for x in (0, 2, 4, 6, 8)])
    # a label of the record stays, also where the way says something else
    assert labels.tolist() == [RIGHT] * 10
    (tmp_path / "drive.jsonl").write_text('{"t": 0.0, "polylines": [{"label": "left"}]}')
    options = ["--from", "jsonl", "--out", str(tmp_path / "bad")]
    assert main(["convert", str(tmp_path / "drive.jsonl"), *options]) == 2


def test_points_at_the_sensor_itself_have_a_spacing() -> None:
    scan = Points.of(np.zeros((3, 2)), np.full(3, UNKNOWN), lines=DENSE)
    found = lines_of(np.array([1.0]), scan, AHEAD, Frames(), None, Counter())
    assert len(found.labels) == 1


def test_a_column_numbers_the_polylines_of_a_csv_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odometry = "t,vx,wz\n" + "".join(f"{0.1 * k:.1f},1.0,0.0\n" for k in range(90))
    rows = [(x, y, name) for name, y in (("a", 1.0), ("b", -1.0)) for x in (0.0, 3.0)]
    found = "t,x,y,lane\n" + "".join(
        f"{0.1 * k:.1f},{x},{y},{name}\n" for k in range(10, 20) for x, y, name in rows
    )
    (tmp_path / "odometry.csv").write_text(odometry)
    (tmp_path / "detections.csv").write_text(found)
    options = ["--from", "csv", "--columns", "line=lane", "--spacing", "1"]
    log = converted(tmp_path, tmp_path / "log", *options)
    assert log.cycles[0].labels.tolist() == [LEFT] * 4 + [RIGHT] * 4
    assert "80 points of lines are 1 m apart (--spacing), of 40 that were recorded" in capsys.readouterr().out
    refused = ["convert", str(tmp_path), "--from", "csv", "--out", str(tmp_path / "bad"), "--spacing", "0"]
    assert main(refused) == 2
    assert "spacing: expected a positive number, found 0" in capsys.readouterr().err


def test_polylines_beside_cones_are_left_out_unless_a_spacing_is_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [json.dumps({"t": 0.1 * k, "twist": [1.0, 0.0, 0.0]}) for k in range(40)]
    entry = {"detections": [{"x": 2.0, "y": 1.0}], "polylines": [{"points": [[0.0, -1.0], [4.0, -1.0]]}]}
    lines += [json.dumps({"t": 0.1 * k, **entry}) for k in range(1, 9)]
    (tmp_path / "drive.jsonl").write_text("\n".join(lines))
    log = converted(tmp_path / "drive.jsonl", tmp_path / "log", "--from", "jsonl")
    assert log.sensor.kind == "cones"
    assert {len(cycle.labels) for cycle in log.cycles} == {1}
    assert "16 points of polylines beside cones were left out" in capsys.readouterr().out
    log = converted(tmp_path / "drive.jsonl", tmp_path / "other", "--from", "jsonl", "--spacing", "1")
    assert log.sensor.kind == "line"
    assert {len(cycle.labels) for cycle in log.cycles} == {6}
