"""Sides: what is left of the way driven is left, without colours, and with colours the other way round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd, judge_log
from pathspace_graph.front_end.sides import ConeRow, SideJudge, extend_rows
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT, ORANGE, RIGHT, UNKNOWN
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings, SidesSettings
from pathspace_graph.sim.faults import Faults, SensorFaults, VehicleFaults
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ..scenes.drives import bean_track, detections

Array = NDArray[np.float64]


def drive(faults: Faults | None = None, wrong_colour: float = 0.01) -> Log:
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(speed_start=8.0), faults=faults or Faults())
    settings = replace(settings, sensor=replace(settings.sensor, wrong_colour=wrong_colour))
    return simulate(bean_track(), settings, seed=1)


def labels_of(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """The labels that the front end gives, and the true ones, of all detections of cones."""
    truth = log.truth
    assert truth is not None and truth.associations is not None
    judged = np.concatenate([c.labels for c in judge_log(log, log.noise, MapperSettings()).cycles])
    real = truth.associations >= 0
    return judged[real], truth.cone_labels[truth.associations[real]]


PLACES = np.array([[x, y] for x in (1.0, 2.5, 4.0, 5.5, 7.0) for y in (2.0, -2.0, 4.0, -4.0, 6.0, -6.0)])
"""Thirty cones beside a straight, less than the reach ahead, and farther from each other than one cone is."""


def is_swapped(judge: SideJudge, lap: int, agreeing: int, opposing: int) -> bool:
    """Whether a judge swaps the colours of cones that were not seen before, with so many on either side."""
    points = PLACES[: agreeing + opposing]
    on_side = np.where(points[:, 1] > 0.0, LEFT, RIGHT)
    labels = np.where(np.arange(len(points)) < opposing, LEFT + RIGHT - on_side, on_side)
    cycle = detections(float(lap), points, labels)
    found = judge.update(np.array([20.0 * lap, 0.0, 0.0]), np.array([[5.0, 0.0, 0.0]]), cycle)
    swapped = bool((found == LEFT + RIGHT - labels).all())
    assert swapped or (found == labels).all()
    return swapped


@pytest.mark.parametrize(
    ("agreeing", "opposing", "swapped"),
    [
        (0, 2, False),
        (0, 3, True),
        (3, 3, False),
        (4, 10, False),
        (4, 11, True),
        (20, 2, False),
        (9, 0, False),
    ],
)
def test_colours_are_swapped_by_a_clear_majority(agreeing: int, opposing: int, swapped: bool) -> None:
    """Three cones at least, and more than 2.5 times as many as on the side of their own colour."""
    judge = SideJudge(SidesSettings())
    assert is_swapped(judge, 0, agreeing, opposing) is swapped


def test_a_cone_that_was_first_seen_out_of_reach_votes_later() -> None:
    """Three cones of the other side's colour are 10 m ahead, beyond the reach, and 5 m ahead a second on."""
    judge, points = SideJudge(SidesSettings()), np.array([[10.0, 2.0], [10.0, -2.0], [11.5, 2.0]])
    labels = np.where(points[:, 1] > 0.0, RIGHT, LEFT)
    for k, x in enumerate((0.0, 5.0)):
        judge.update(
            np.array([x, 0.0, 0.0]), np.array([[5.0, 0.0, 0.0]]), detections(k, points - [x, 0.0], labels)
        )
        assert judge.swapped is (k == 1)


@pytest.mark.parametrize(("agreeing", "swapped"), [(7, True), (8, False)])
def test_colours_are_swapped_back_by_as_clear_a_majority(agreeing: int, swapped: bool) -> None:
    """Three cones were on the other side."""
    judge = SideJudge(SidesSettings())
    assert is_swapped(judge, 0, 0, 3)
    assert is_swapped(judge, 1, agreeing, 0) is swapped


def test_right_colours_are_left_as_they_are() -> None:
    log = drive()
    front_end = FrontEnd(MapperSettings(), log.noise)
    for odometry, cycle in split_odometry(log):
        found = front_end.update(odometry, cycle).detections
        np.testing.assert_array_equal(found.labels, cycle.labels)
        assert found.points_vehicle is cycle.points_vehicle and found.covariances is cycle.covariances


def test_one_wrong_colour_in_five_swaps_nothing() -> None:
    log = drive(wrong_colour=0.2)
    given = np.concatenate([cycle.labels for cycle in log.cycles])
    judged = judge_log(log, log.noise, MapperSettings()).cycles
    later = slice(len(log.cycles[0].labels) * 3, None)
    np.testing.assert_array_equal(np.concatenate([c.labels for c in judged])[later], given[later])


def test_blue_on_the_right_is_found_out_at_once() -> None:
    log = drive(Faults(vehicle=VehicleFaults(wrong_way=True)))
    found, true = labels_of(log)
    assert (found != true).mean() < 0.03  # one colour in a hundred is wrong


@pytest.mark.parametrize("wrong_way", [False, True])
@pytest.mark.parametrize("share", [0.9, 1.0])
def test_sides_are_told_without_colours(share: float, wrong_way: bool) -> None:
    faults = Faults(sensor=SensorFaults(colourless=share), vehicle=VehicleFaults(wrong_way=wrong_way))
    found, true = labels_of(drive(faults))
    known = found != UNKNOWN
    assert known.mean() > 0.7
    assert (found[known] != true[known]).mean() < 0.02


def test_colours_count_again_once_most_of_the_newest_detections_have_one() -> None:
    """Each cycle's share fades by 0.98: after 18 cycles with colours 0.695 of them have none, below 0.7."""
    judge, points, said = SideJudge(SidesSettings()), PLACES[:6], list[bool]()
    sides = np.where(points[:, 1] > 0.0, LEFT, RIGHT)
    for k in range(420):
        labels = np.full(6, UNKNOWN) if k < 400 else sides
        judge.update(np.zeros(3), np.zeros((1, 3)), detections(0.1 * k, points, labels))
        said.append(judge.colourless)
    assert said[0] and said.index(False) == 400 + 17


@pytest.mark.parametrize(("count", "colourless"), [(5, False), (6, True)])
def test_a_few_detections_do_not_tell_that_a_log_has_no_colours(count: int, colourless: bool) -> None:
    judge = SideJudge(SidesSettings())
    judge.update(np.zeros(3), np.zeros((1, 3)), detections(0.0, PLACES[:count], np.full(count, UNKNOWN)))
    assert judge.colourless is colourless


def test_where_colours_are_common_an_unknown_one_stays_unknown() -> None:
    """The large cones of a start line have no colour, and stand beside the boundary."""
    log = drive(Faults(sensor=SensorFaults(colourless=0.4)))
    for given, judged in zip(log.cycles, judge_log(log, log.noise, MapperSettings()).cycles, strict=True):
        np.testing.assert_array_equal(given.labels, judged.labels)


@pytest.mark.parametrize(
    ("own", "other", "follows"), [(9, 1, True), (2, 3, True), (0, 1, True), (2, 4, False), (0, 2, False)]
)
def test_one_wrong_colour_among_ten_excludes_no_cone_from_its_row(
    own: int, other: int, follows: bool
) -> None:
    """The votes of the third cone of the left row may be one more for the right than for the left."""
    judge = SideJudge(SidesSettings())
    points = np.array([[0.0, 1.5], [0.0, -1.5], [4.0, 1.5], [4.0, -1.5], [8.0, 1.5], [8.0, -1.5]])
    for k in range(own + other + 8):
        labels = np.full(6, UNKNOWN)
        if 2 <= k < 2 + own + other:
            labels[4] = LEFT if k < 2 + own else RIGHT
        cycle = detections(0.1 * k, points, labels)
        found = judge.update(np.array([-2.0, 0.0, 0.0]), np.zeros((1, 3)), cycle)
    assert found.tolist()[:4] == [LEFT, RIGHT, LEFT, RIGHT]
    assert found[4] == (LEFT if follows else UNKNOWN)


def test_a_cycle_without_detections_is_possible() -> None:
    log = drive()
    front_end = FrontEnd(MapperSettings(), log.noise)
    odometry, _ = next(split_odometry(log))
    nothing = Detections(0.0, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.intp))
    assert len(front_end.update(odometry, nothing).detections.labels) == 0


def test_colours_beyond_a_lane_of_orange_cones_prove_nothing() -> None:
    """The skidpad is entered past blue cones on the right of its lane, and yellow ones on its left."""
    x = np.arange(1.0, 12.0, 3.0)
    lane = np.concatenate([np.column_stack([x, np.full(4, side)]) for side in (1.5, -1.5)])
    circles = np.array([[6.0, -4.0], [7.0, -5.0], [8.0, -6.0], [6.0, 4.0], [7.0, 5.0], [8.0, 6.0]])
    points = np.concatenate([lane, circles])
    labels = np.array([ORANGE] * 8 + [LEFT] * 3 + [RIGHT] * 3)
    for lane_is_orange in (True, False):
        front_end = FrontEnd(MapperSettings(), KnownNoise(np.array([0.25, 0.12, 0.035])))
        seen = labels if lane_is_orange else np.where(labels == ORANGE, UNKNOWN, labels)
        notices = []
        for k in range(6):
            t, covariances = 0.1 * (k + 1), np.tile(0.01 * np.eye(2), (14, 1, 1))
            cycle = Detections(t, points - [0.2 * (k + 1), 0.0], covariances, seen)
            reading = front_end.update(Odometry(np.array([t - 0.1]), np.array([[2.0, 0.0, 0.0]])), cycle)
            notices.append(reading.notice)
        assert any("swapped" in notice for notice in notices) != lane_is_orange
        assert len(reading.orange.labels) == (8 if lane_is_orange else 0)


# --- rows of cones, by hand -------------------------------------------------------------------------------

THRESHOLD = 0.7
PATH = np.array([[-10.0, 0.0], [0.0, 0.0]])


def row(side: float, *candidates: tuple[float, float], end: float = 0.0) -> ConeRow:
    """Returns a row along x that ends 2 m to the left or to the right of (end, 0)."""
    line = np.array([[-10.0, 2.0 * side], [end, 2.0 * side]])
    return ConeRow(side, line, np.array([1.0, 0.0]), np.array(candidates).reshape(-1, 2))


def chosen(left: ConeRow, right: ConeRow, driven: np.ndarray = PATH) -> tuple[list[int], list[int]]:
    extend_rows(left, right, driven, THRESHOLD)
    return left.chosen, right.chosen


def test_rows_extend_rows_in_the_order_of_the_track() -> None:
    left, right = row(1.0, (8.0, 2.0), (4.0, 2.0), (12.0, 2.0)), row(-1.0, (4.5, -2.0), (9.0, -2.0))
    assert chosen(left, right) == ([1, 0, 2], [0, 1])
    np.testing.assert_allclose(left.line[-1], [12.0, 2.0])
    np.testing.assert_allclose(left.direction, [1.0, 0.0])


@pytest.mark.parametrize(
    ("candidate", "follows"),
    [
        ((4.0, 2.0), True),
        ((0.5, 2.0), False),
        ((10.9, 2.0), True),
        ((11.1, 2.0), False),
        ((-0.3, 4.0), True),
        ((-2.0, 3.0), False),
        ((4.0, -0.6), False),
        ((4.0, -3.0), False),
    ],
    ids=["next", "at the end", "gap", "too far", "turn", "back", "narrow", "across the other row"],
)
def test_what_may_come_next(candidate: tuple[float, float], follows: bool) -> None:
    """The other row is known up to (9, -2)."""
    assert chosen(row(1.0, candidate), row(-1.0, (4.5, -2.0), (9.0, -2.0)))[0] == [0] * follows


def test_a_row_of_another_stretch_behind_the_next_cone_is_left_out() -> None:
    """Widths may grow from 4 m to 1.8 * 4 + 1 = 8.2 m beside a known row, and the near row is cheaper."""
    assert chosen(row(1.0, (5.0, 6.1), (4.0, 2.1)), row(-1.0, end=9.0))[0][:1] == [1]
    assert chosen(row(1.0, (5.0, 6.1)), row(-1.0, end=9.0))[0] == [0]
    assert chosen(row(1.0, (5.0, 6.3)), row(-1.0, end=9.0))[0] == []


def test_no_row_crosses_the_driven_path() -> None:
    """An older stretch of the drive ran 4 m to the left."""
    older = np.array([[20.0, 4.0], [-20.0, 4.0], [-20.0, 0.0], [0.0, 0.0]])
    assert chosen(row(1.0, (3.0, 5.0)), row(-1.0), older)[0] == []
    assert chosen(row(1.0, (3.0, 3.5)), row(-1.0), older)[0] == [0]


# --- cones without colours ---------------------------------------------------------------------------------


def begun(points: Array, half_width: float = 1.75) -> tuple[ConeRow, ConeRow]:
    """Two rows that begin beside a vehicle at the origin, which heads along x."""
    left, right = (np.array([[-8.0, side], [0.0, side]]) for side in (half_width, -half_width))
    ahead = np.array([1.0, 0.0])
    return ConeRow(1.0, left, ahead, points), ConeRow(-1.0, right, ahead, points)


def bend(radius: float, half_width: float, gap: float, angle: float) -> tuple[Array, Array]:
    """Both rows (k, 2) of a left bend about (0, radius), whose cones are `gap` apart on the outer side."""
    phi = np.arange(gap, angle * (radius + half_width), gap) / (radius + half_width)
    rows = [
        np.column_stack([r * np.sin(phi), radius - r * np.cos(phi)])
        for r in (radius - half_width, radius + half_width)
    ]
    return rows[0], rows[1]


def extended(left: Array, right: Array, half_width: float = 1.75) -> tuple[list[int], list[int]]:
    points = np.concatenate([left, right])
    rows = begun(points, half_width)
    extend_rows(*rows, np.array([[-8.0, 0.0], [0.0, 0.0]]), 0.7)
    return rows[0].chosen, rows[1].chosen


@pytest.mark.parametrize("radius", [6.0, 9.0, 25.0, 1e4])
@pytest.mark.parametrize("half_width", [1.5, 2.0, 3.0])
def test_both_rows_of_a_bend_are_followed_to_their_ends(radius: float, half_width: float) -> None:
    left, right = bend(radius, half_width, 3.5, min(1.5, 15.0 / radius))
    found = extended(left, right, half_width)
    assert found == (list(range(len(left))), list(range(len(left), len(left) + len(right))))


def test_a_row_with_a_missing_cone_does_not_lead_across_the_track() -> None:
    """The next cone of the right row is 7 m ahead; the cone across is 4.4 m away, and is of the left row."""
    left = np.array([[4.0, 1.75], [8.0, 1.75], [12.0, 1.75]])
    right = np.array([[7.0, -1.75], [11.0, -1.75]])
    assert extended(left, right) == ([0, 1, 2], [3, 4])
