"""Growth: what a curve begins with, what extends it, what colours decide, and how it is taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.eval.metrics.accuracy import mapped_points, true_curve
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping import growth
from pathspace_graph.mapping.growth import _uncrossed, check_order, end_of, undisputed
from pathspace_graph.mapping.path import END_BEHIND, Candidates, End, PathAhead
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import GrowthSettings, MapperSettings
from pathspace_graph.spline.boundary import Boundary

from ..scenes.drives import DT, ahead, corridor, detections, exact_log, map_log, true_poses
from ..scenes.maps import boundary_through

Array = NDArray[np.float64]

ROUND = 0.005 * np.eye(2)
"""A tentative detection has this covariance (m^2)."""


# --- contradicting colours -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen() -> FixedLagMapper:
    """One cycle at the origin: 2 left, 1 right and 3 unknown readings about (10, 0), 1 and 1 about (0, 8)."""
    points = [[9.8, 0.0], [10.2, 0.0], [10.0, 0.3], *[[10.0, -0.1]] * 3, [0.0, 8.0], [0.1, 8.0]]
    labels = [LEFT, LEFT, RIGHT, *[UNKNOWN] * 3, LEFT, RIGHT]
    mapper = FixedLagMapper()
    log = exact_log(ahead(0.0, 1.0), np.zeros((0, 2)), np.zeros(0, np.intp))
    cycle = detections(0.0, np.array(points), np.array(labels, np.intp))
    return map_log(replace(log, cycles=(cycle,)), mapper)[0]


@pytest.mark.parametrize(("label", "expected"), [(LEFT, [True, True, True]), (RIGHT, [False, True, True])])
def test_a_place_is_of_the_label_that_most_readings_around_it_have(
    seen: FixedLagMapper, label: int, expected: list[bool]
) -> None:
    """Two to one, one to one, and nothing at all; those of unknown colour have no say."""
    places = np.array([[10.0, 0.0], [0.0, 8.0], [5.0, 5.0]])
    assert undisputed(seen.road.smoother.map, label, places, 1.0).tolist() == expected


def test_readings_farther_away_than_the_radius_have_no_say(seen: FixedLagMapper) -> None:
    """Of those about (10, 0) only the right one is within 0.25 m of (10, 0.5)."""
    place = np.array([[10.0, 0.5]])
    assert undisputed(seen.road.smoother.map, RIGHT, place, 0.25).tolist() == [True]
    assert undisputed(seen.road.smoother.map, LEFT, place, 0.25).tolist() == [False]


def miscoloured(log: Log, every: int) -> Log:
    """Every so manieth reading of each cone has the other boundary's label."""
    assert log.truth is not None
    cones, times = KDTree(log.truth.cones), np.zeros(len(log.truth.cones), np.intp)
    cycles = []
    for cycle, pose in zip(log.cycles, true_poses(log), strict=True):
        cycles.append(_flip(cycle, pose, cones, times, every))
    return replace(log, cycles=tuple(cycles))


def _flip(cycle: Detections, pose: Array, cones: KDTree, times: NDArray[np.intp], every: int) -> Detections:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    of = cones.query(cycle.points_vehicle @ np.array([[c, s], [-s, c]]) + pose[:2])[1]
    times[of] += 1
    return replace(cycle, labels=np.where(times[of] % every == 0, LEFT + RIGHT - cycle.labels, cycle.labels))


def farthest(mapper: FixedLagMapper, log: Log) -> float:
    """Greatest distance (m) of anything mapped from the true curve of its colour."""
    assert log.truth is not None
    return max(
        float(KDTree(true_curve(log.truth, label)).query(mapped_points(boundary))[0].max())
        for label, boundary in mapper.map().boundaries.items()
    )


def weaving(speed: float, seconds: float) -> Array:
    """Twists (N, 3) of a drive whose present turn always leads across one of the rows, within 7 m."""
    t = DT * np.arange(round(seconds / DT))
    return np.column_stack([np.full_like(t, speed), np.zeros_like(t), 1.2 * np.cos(2 * np.pi * t / 1.5)])


@pytest.mark.parametrize("every", [4, 3])
def test_a_boundary_is_not_led_over_cones_of_which_most_readings_have_the_other_colour(every: int) -> None:
    log = miscoloured(exact_log(weaving(8.0, 8.0), *corridor(100.0)), every)
    mapper, _ = map_log(log)
    assert farthest(mapper, log) < 1.0


# --- where a curve ends ----------------------------------------------------------------------------------


def test_an_end_nearer_to_an_older_stretch_of_the_path_does_not_follow_that() -> None:
    """An older stretch ran against this one, 3 m to the left of it; what was sighted beside it is its own."""
    mapper, _ = map_log(exact_log(ahead(8.0, 5.0), *corridor(100.0)))
    boundary, tentative = mapper.boundaries[LEFT], mapper.road.growth.tentative
    confirmed, size = boundary.confirmed_end, boundary.size
    tentative.clear()
    for t in (5.0, 5.1, 5.2):
        points = np.array([[36.0, 1.0], [32.0, 1.0], [28.0, 1.0]])
        tentative.add(points, np.tile(ROUND, (3, 1, 1)), np.full(3, LEFT), t)
    x = mapper.poses[-1, 0]
    corners = np.array([[60.0, 3.0], [0.0, 3.0], [0.0, 0.0], [x, 0.0], [x + 7.0, 0.0]])
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    stations = np.union1d(np.arange(0.0, along[-1], 0.3), along)  # the path is stored in such steps
    points = np.column_stack([np.interp(stations, along, corners[:, k]) for k in range(2)])
    path = PathAhead(points, stations, float(along[3]))
    assert mapper.road.growth.expand(mapper.road.smoother, path) == (frozenset(), "")
    assert (boundary.confirmed_end, boundary.size) == (confirmed, size)


# --- growth by hand --------------------------------------------------------------------------------------


@pytest.fixture
def alone() -> FixedLagMapper:
    """A mapper at the origin, heading along x, that has seen nothing."""
    log = exact_log(ahead(0.0, 0.3), np.zeros((0, 2)), np.zeros(0, np.intp))
    return map_log(log, FixedLagMapper())[0]


def along_x(driven: float = 0.0, begin: float = -10.0) -> PathAhead:
    """Returns a path along x, on which the vehicle is at x = `driven` and sees 7 m ahead."""
    x = np.arange(begin, driven + 7.01, 0.5)
    return PathAhead(np.column_stack([x, np.zeros(len(x))]), x - begin, driven - begin)


def track(mapper: FixedLagMapper, *points: tuple[float, float], label: int = LEFT, times: int = 3) -> None:
    """Makes tentative tracks at points, detected so many times."""
    for k in range(times):
        labels = np.full(len(points), label)
        mapper.road.growth.tentative.add(
            np.array(points), np.tile(ROUND, (len(points), 1, 1)), labels, 0.1 * k
        )


def grow(mapper: FixedLagMapper, path: PathAhead) -> list[tuple[float, float]]:
    """Expands the curves along a path; returns the cones of the left one, to a centimetre."""
    mapper.road.growth.expand(mapper.road.smoother, path)
    observed = mapper.boundaries[LEFT].observed if LEFT in mapper.boundaries else []
    return [(round(float(x), 2), round(float(y), 2)) for x, y in observed]


def test_a_curve_begins_with_two_confirmed_tracks_in_the_order_of_the_path(alone: FixedLagMapper) -> None:
    track(alone, (1.0, 2.0))
    assert grow(alone, along_x()) == []
    track(alone, (4.0, 2.0), times=2)
    assert grow(alone, along_x()) == []
    track(alone, (-2.0, 2.2), (4.0, 2.0), times=3)
    assert grow(alone, along_x()) == [(-2.0, 2.2), (1.0, 2.0), (4.0, 2.0)]
    assert RIGHT not in alone.boundaries
    assert len(alone.road.growth.tentative.points) == 0
    assert len(alone.road.smoother.map.state.pose_u[LEFT]) == len(alone.poses)


def test_a_curve_begins_on_its_own_side_within_reach_and_not_too_far_from_the_path(
    alone: FixedLagMapper,
) -> None:
    track(alone, (1.0, -2.0), (3.0, -2.0), (1.0, 11.0), (4.0, 11.0), (7.5, 2.0), (10.0, 2.0))
    assert grow(alone, along_x()) == []
    assert grow(alone, along_x(3.5)) == [(7.5, 2.0), (10.0, 2.0)]


@pytest.mark.parametrize(
    ("point", "extends"),
    [
        ((6.0, 2.0), True),
        ((4.6, 2.0), False),
        ((4.2, 2.9), False),
        ((3.0, 3.0), False),
        ((6.0, 3.9), True),
        ((6.0, 4.2), False),
        ((6.0, -0.5), False),
        ((7.4, 2.0), False),
    ],
    ids=["next", "at the end", "beside the end", "behind", "wider", "too wide", "other side", "out of reach"],
)
def test_a_curve_is_extended_by_what_comes_next(
    alone: FixedLagMapper, point: tuple[float, float], extends: bool
) -> None:
    """The end is at (4, 2): the next cone is at least 0.7 m away, 0.3 m on, and at most 1.9 m farther out."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    assert len(grow(alone, along_x())) == 2
    track(alone, point)
    found = grow(alone, along_x())
    assert found[2:] == ([point] if extends else [])
    boundary = alone.boundaries[LEFT]
    length = 4.0 + np.hypot(point[0] - 4.0, point[1] - 2.0) * extends
    assert boundary.confirmed_end == pytest.approx(length, abs=0.05)


def test_an_end_that_the_vehicle_has_passed_follows_the_path(alone: FixedLagMapper) -> None:
    """It is more than 2 m behind with nothing ahead, and is carried on to 1 m behind the vehicle."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    grow(alone, along_x())
    boundary = alone.boundaries[LEFT]
    grow(alone, along_x(5.9))
    assert boundary.confirmed_end == pytest.approx(4.0)
    grow(alone, along_x(8.0))
    end = boundary.evaluate(alone.control_points(LEFT), np.array([boundary.confirmed_end]))[0]
    np.testing.assert_allclose(end, [7.0, 2.0], atol=0.3)
    assert len(boundary.observed) == 2


def test_cones_that_were_passed_in_another_order_are_counted(alone: FixedLagMapper) -> None:
    """The curve went (0, 2), (4, 2), (12, 2), (8, 2): after 9 m the third has not been passed yet."""
    boundary, _ = boundary_through(np.array([[0.0, 2.0], [4.0, 2.0], [12.0, 2.0], [8.0, 2.0]]))
    nothing = np.zeros((0, 2))
    counts = [check_order(boundary, along_x(x), nothing)[0] for x in (3.0, 7.0, 9.0, 13.0)]
    assert counts == [4, 4, 2, 2]
    in_order, _ = boundary_through(np.array([[0.0, 2.0], [4.0, 2.0], [8.0, 2.0], [12.0, 2.0]]))
    assert check_order(in_order, along_x(13.0), nothing)[0] == 4


def test_cones_of_a_second_round_are_not_taken_for_those_of_the_first() -> None:
    """On a circle of 50 m the path of the first round is nearer to the cones ahead than the arc."""
    radius, step = 50.0 / (2.0 * np.pi), 2.5

    def on_circle(arc: Array, out: float) -> Array:
        angle = arc / radius
        return np.column_stack([np.sin(angle), -np.cos(angle)]) * (radius + out)

    stations = np.arange(0.0, 66.0, 0.5)
    offset = np.where(stations > 52.0, 0.4, 0.0)  # the arc is predicted too far inside
    points = np.array([on_circle(s[None], -o)[0] for s, o in zip(stations, offset, strict=True)])
    beside = np.zeros((0, 2))
    for driven in np.arange(5.0, 52.0, 2.0):
        now, cones = stations <= driven + 12.0, on_circle(np.arange(0.0, driven + 10.0, step), 2.0)
        boundary, _ = boundary_through(cones)
        kept, beside = check_order(boundary, PathAhead(points[now], stations[now], driven), beside)
        assert kept == len(cones)
    np.testing.assert_allclose(beside[:20, 0], step * np.arange(20), atol=0.5)


def test_a_curve_that_grows_far_in_one_cycle_remembers_each_cone_as_itself() -> None:
    """The newest 25 m begin at cones that were never located: what is known is of the first two."""
    boundary, _ = boundary_through(np.column_stack([np.arange(0.0, 61.0, 4.0), np.full(16, 2.0)]))
    known = np.array([[0.0, 2.0], [4.0, 2.0]])
    kept, beside = check_order(boundary, along_x(13.0, begin=0.0), known)
    assert kept == 16
    np.testing.assert_array_equal(beside[:2], known)
    assert np.isnan(beside[2:9]).all()
    np.testing.assert_allclose(beside[9:, 0], np.arange(36.0, 61.0, 4.0), atol=1e-9)


def test_a_curve_that_is_taken_back_goes_through_its_cones_in_the_right_order(alone: FixedLagMapper) -> None:
    """The curve was led past (12, 2) first and then back to (8, 2)."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    grow(alone, along_x())
    track(alone, (12.0, 2.0))
    assert grow(alone, along_x(6.0)) == [(0.0, 2.0), (4.0, 2.0), (12.0, 2.0)]
    boundary = alone.boundaries[LEFT]
    boundary.add_cones(np.array([[8.0, 2.0]]), np.array([boundary.confirmed_end + 4.0]))
    boundary.confirmed_end += 4.0
    assert grow(alone, along_x(13.0)) == [(0.0, 2.0), (4.0, 2.0), (8.0, 2.0), (12.0, 2.0)]
    assert boundary.confirmed_end == pytest.approx(12.0, abs=0.05)


# --- the order of the drive --------------------------------------------------------------------------------


def hairpin() -> Log:
    """Forth, half around and back, 5 m beside; the inner row that leads there lacks its last two cones.

    From afar the row that comes back is what goes on from the one that leads there.
    """
    straight, radius, half = 36.0, 2.5, 1.8
    twists = np.concatenate([ahead(5.0, straight / 5.0), turn(5.0, radius), ahead(5.0, 5.0)])
    x = np.arange(0.0, straight + 0.1, 4.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 5)[1:-1]
    outer = np.concatenate(
        [
            np.column_stack([x, np.full(len(x), -half)]),
            np.array([straight, radius]) + (radius + half) * np.column_stack([np.cos(angle), np.sin(angle)]),
            np.column_stack([x[::-1], np.full(len(x), 2.0 * radius + half)]),
        ]
    )
    inner = np.concatenate(
        [
            np.column_stack([x[:-2], np.full(len(x) - 2, half)]),
            np.column_stack([x[::-1], np.full(len(x), 2.0 * radius - half)]),
        ]
    )
    labels = np.repeat([LEFT, RIGHT], [len(inner), len(outer)]).astype(np.intp)
    return exact_log(twists, np.concatenate([inner, outer]), labels)


def turn(speed: float, radius: float) -> Array:
    """Twists (N, 3) of half a turn to the left."""
    steps = round(np.pi * radius / speed / DT)
    return np.tile([speed, 0.0, np.pi / steps / DT], (steps, 1))


def backwards(mapper: FixedLagMapper, log: Log) -> float:
    """How far (m) a curve of the graph goes back between two neighbours of a row, at most."""
    assert log.truth is not None
    cones = log.truth.cones[log.truth.cone_labels == LEFT]
    spline = mapper.boundaries[LEFT].spline(mapper.control_points(LEFT))
    u = np.linspace(*spline.domain, 4000)
    distance, nearest = KDTree(spline.evaluate(u)).query(cones)
    nearest = u[nearest[distance < 1.0]]  # the others lie beyond an end
    return float(np.max(-np.diff(nearest), initial=0.0))


def test_an_end_led_on_in_the_wrong_order_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a curve without that goes wrong for good depends on round-off."""
    taken, take_back = list[int](), Boundary.take_back

    def counted(self: Boundary, kept: int) -> None:
        taken.append(kept)
        take_back(self, kept)

    monkeypatch.setattr(Boundary, "take_back", counted)
    log = hairpin()
    mapper, _ = map_log(log)
    assert backwards(mapper, log) < 0.5
    assert mapper.road.growth.taken_back == len(taken) > 0


# --- the bound -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "constants",
    [{"MAX_SIZE": 10}, {"LENGTH_DRIVEN": 0.01, "LENGTH_FREE": 25.0}],
    ids=["size", "length"],
)
def test_an_open_curve_has_a_bound_and_it_is_said_once_for_each_boundary(
    constants: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in constants.items():
        monkeypatch.setattr(growth, name, value)
    cones, labels = corridor(100.0)
    log = exact_log(ahead(6.0, 12.0), cones, labels)
    mapper, results = map_log(log, FixedLagMapper())
    notices = sorted("; ".join(result.notice for result in results if result.notice).split("; "))
    assert [notice.split(" boundary ")[0] for notice in notices] == ["the open left", "the open right"]
    assert all("grows no further, with" in notice for notice in notices)
    for boundary in mapper.boundaries.values():
        assert 20.0 < boundary.confirmed_end < 40.0  # one extension is through several cones
    assert max(results[-1].sizes) <= 14


# --- no end is carried on for ever -----------------------------------------------------------------------


def blind_after(seconds: float, length: float) -> Log:
    """A drive of some length (m) beside a corridor, whose cones are not seen any more after a time (s)."""
    log = exact_log(ahead(20.0, length / 20.0), *corridor(length))
    nothing = detections(0.0, np.zeros((0, 2)), np.zeros(0, np.intp))
    cycles = tuple(c if c.t < seconds else replace(nothing, t=c.t) for c in log.cycles)
    return replace(log, cycles=cycles)


def test_a_stranded_end_is_carried_on_a_bounded_way_and_that_is_said_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(GrowthSettings, "max_unseen", 60.0)
    mapper, results = map_log(blind_after(2.0, 200.0), FixedLagMapper())
    for boundary in mapper.boundaries.values():
        assert 50.0 < boundary.unseen <= 60.0
    notices = [result.notice for result in results if result.notice]
    assert len([text for text in notices if "left boundary grows no further" in text]) == 1
    assert len([text for text in notices if "right boundary grows no further" in text]) == 1


def test_one_cycle_that_leads_very_far_does_not_take_the_curve_along() -> None:
    """Half a minute at 100 m/s is within the limits of a vehicle."""
    log = exact_log(ahead(8.0, 4.0), *corridor(60.0))
    mapper, results = map_log(log)
    t, before = results[-1].t, results[-1].sizes
    nothing = detections(t + 29.0, np.zeros((0, 2)), np.zeros(0, np.intp))
    stamps = np.arange(t, t + 29.0, DT)
    twists = np.column_stack([99.0 + 1e-4 * np.arange(len(stamps)), np.zeros((len(stamps), 2))])
    result = mapper.update(Odometry(stamps, twists), nothing)
    assert result.pose[0] > 2000.0
    assert result.sizes == before


def test_the_window_holds_a_bounded_number_of_poses() -> None:
    log = exact_log(ahead(8.0, 3.0), *corridor(40.0))
    mapper, _ = map_log(log, FixedLagMapper(MapperSettings(max_poses=7)))
    assert len(mapper.poses) == 7


# --- what is certain, and what lies across a line ----------------------------------------------------------


def far_track(mapper: FixedLagMapper, point: tuple[float, float], sigma: float, times: int) -> None:
    """Adds sightings of a cone on the left whose ranges, along x, have this standard deviation (m)."""
    covariance = np.diag([sigma**2, 0.05**2])[None]
    for k in range(times):
        mapper.road.growth.tentative.add(np.array([point]), covariance, np.array([LEFT]), 0.1 * k)


def test_an_uncertain_cone_extends_a_curve_once_it_is_certain(alone: FixedLagMapper) -> None:
    """Three sightings of 1.2 m know it to 0.69 m, and nine to 0.4 m; then one from nearby."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    assert len(grow(alone, along_x())) == 2
    far_track(alone, (6.5, 2.0), 1.2, 3)
    assert len(grow(alone, along_x())) == 2
    far_track(alone, (6.5, 2.0), 1.2, 5)
    assert alone.road.growth.tentative.counts.tolist() == [8]
    assert len(grow(alone, along_x())) == 2
    far_track(alone, (6.5, 2.0), 0.3, 1)
    assert grow(alone, along_x())[2:] == [(6.5, 2.0)]


@pytest.mark.parametrize(("driven", "grown"), [(7.0, [(8.0, 2.0)]), (5.5, [])])
def test_an_uncertain_cone_blocks_growth_only_until_it_was_passed(
    alone: FixedLagMapper, driven: float, grown: list[tuple[float, float]]
) -> None:
    """The cone at x = 6 m is known to 0.69 m, the one at 8 m well."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    assert len(grow(alone, along_x())) == 2
    far_track(alone, (6.0, 2.0), 1.2, 3)
    track(alone, (8.0, 2.0))
    assert grow(alone, along_x(driven))[2:] == grown


def test_a_curve_does_not_begin_through_uncertain_cones(alone: FixedLagMapper) -> None:
    far_track(alone, (0.0, 2.0), 1.2, 3)
    far_track(alone, (4.0, 2.0), 1.2, 3)
    assert grow(alone, along_x()) == []
    track(alone, (0.0, 2.0), (4.0, 2.0), times=1)
    assert grow(alone, along_x()) == [(0.0, 2.0), (4.0, 2.0)]


def uncrossed(mapper: FixedLagMapper, path: PathAhead, *points: tuple[float, float]) -> list[int]:
    """Which of candidates at points the left curve reaches from its end at (4, 2) without crossing a line."""
    places = np.array(points)
    found = Candidates(places, np.arange(len(places)), places[:, 0], places[:, 1])
    end = End(np.array([4.0, 2.0]), 4.0, 2.0)
    return _uncrossed(mapper.road.smoother.map.state, LEFT, path, end, found).tolist()


@pytest.fixture
def between(alone: FixedLagMapper) -> FixedLagMapper:
    """Curves from x = 0 to 4 m, 2 m beside the x axis on either side."""
    track(alone, (0.0, 2.0), (4.0, 2.0))
    track(alone, (0.0, -2.0), (2.0, -2.0), (4.0, -2.0), label=RIGHT)
    assert len(grow(alone, along_x())) == 2 and RIGHT in alone.boundaries
    return alone


def test_a_cone_across_the_path_driven_is_not_reached_and_none_after_it(between: FixedLagMapper) -> None:
    """The vehicle is at x = 8 m: the second cone is reached across the path at x = 7.2 m, or at 11 m."""
    assert uncrossed(between, along_x(8.0), (6.0, 2.0), (8.5, -2.0), (12.0, 2.0)) == [0]
    assert uncrossed(between, along_x(8.0), (6.0, 2.0), (9.0, 2.0), (13.0, -2.0)) == [0, 1, 2]
    assert uncrossed(between, along_x(6.0), (6.0, 2.0), (8.5, -2.0), (12.0, 2.0)) == [0, 1, 2]


def test_a_cone_across_the_other_boundary_is_not_reached(between: FixedLagMapper) -> None:
    """The vehicle has not come to x = 0 yet, so only the right boundary lies between."""
    path = along_x(-6.0)
    assert uncrossed(between, path, (3.0, -1.0), (3.5, -3.0)) == [0]
    assert uncrossed(between, path, (6.0, -1.0), (6.0, -3.0)) == [0, 1]


def test_a_cone_across_the_curve_itself_is_not_reached(between: FixedLagMapper) -> None:
    boundary = between.boundaries[LEFT]
    boundary.observed = np.array([(0.0, 2.0), (4.0, 5.0), (7.0, 2.0), (4.0, 2.0)])
    assert uncrossed(between, along_x(-6.0), (6.0, 6.0)) == []
    assert uncrossed(between, along_x(-6.0), (3.0, 1.0)) == [0]


def test_a_curve_that_runs_along_its_own_beginning_again_goes_on(between: FixedLagMapper) -> None:
    """On the second lap the loop is still open, and the same cones are seen a few centimetres beside."""
    boundary = between.boundaries[LEFT]
    lap = [(0.0, 2.05), (4.0, 1.95), (8.0, 2.05), (12.0, 2.0), (20.0, 20.0), (-20.0, 20.0), (0.0, 1.95)]
    boundary.observed = np.array([*lap, (4.0, 2.0)])
    lengths = np.hypot(*np.diff(boundary.observed, axis=0).T)
    boundary.cone_parameters = np.append(0.0, np.cumsum(lengths))
    boundary.confirmed_end = boundary.cone_parameters[-1]
    assert uncrossed(between, along_x(-6.0), (8.0, 1.98), (12.0, 2.03)) == [0, 1]


# --- the side of an end ------------------------------------------------------------------------------------


def test_one_wrong_cone_at_the_end_leads_no_farther(alone: FixedLagMapper) -> None:
    """The newest cones are 2, 2 and 3.4 m beside the path: the next may be 2.7 m and a step away."""
    track(alone, (-4.0, 2.0), (0.0, 2.0), (4.0, 3.4))
    assert len(grow(alone, along_x())) == 3
    end = end_of(alone.road.smoother.map.state, LEFT, along_x(), 5.0)
    assert end.side == pytest.approx(2.7, abs=0.05)  # of the cones and the end, four values
    assert end.position == pytest.approx([4.0, 3.4], abs=0.05)


def test_an_end_that_was_carried_on_around_a_bend_has_the_side_that_it_has(alone: FixedLagMapper) -> None:
    """The newest cones are far behind then, where the end of the path does not run beside them.

    The path goes straight on to x = 12 m and half around a circle of 15 m, and the curve 2 m to its left. The
    end's place is searched on the newest stretch of the path, as in growth.
    """
    angle = np.linspace(0.0, np.pi, 80)[1:]
    bend = np.array([12.0, 15.0]) + 15.0 * np.column_stack([np.sin(angle), -np.cos(angle)])
    straight = np.column_stack([np.arange(0.0, 12.1, 0.5), np.zeros(25)])
    points = np.concatenate([straight, bend])
    inner = np.concatenate([np.add(straight, [0.0, 2.0]), [12.0, 15.0] + (bend - [12.0, 15.0]) * 13.0 / 15.0])
    stations = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    path = PathAhead(points, stations, float(stations[-1]))
    boundary, control_points = boundary_through(inner)
    state = alone.road.smoother.map.state
    state.add_boundary(LEFT, boundary, control_points)
    boundary.observed = np.array([[x, 2.0] for x in (0.0, 4.0, 8.0, 12.0)])
    assert end_of(state, LEFT, path, END_BEHIND).side == pytest.approx(2.0, abs=0.1)
