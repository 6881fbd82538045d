"""Growth: whose a place is where colours contradict each other, and where along the way a curve ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.eval.metrics.curves import mapped_points, true_curve
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.path import PathAhead
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.online.growth import undisputed
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import DT, ahead, corridor, detections, exact_log, map_log, true_poses

Array = NDArray[np.float64]


# --- whose a place is ------------------------------------------------------------------------------------


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
    assert undisputed(seen.smoother, label, places, 1.0).tolist() == expected


def test_readings_farther_away_than_the_radius_have_no_say(seen: FixedLagMapper) -> None:
    """Of those about (10, 0) only the right one is within 0.25 m of (10, 0.5)."""
    place = np.array([[10.0, 0.5]])
    assert undisputed(seen.smoother, RIGHT, place, 0.25).tolist() == [True]
    assert undisputed(seen.smoother, LEFT, place, 0.25).tolist() == [False]


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
    boundary, tentative = mapper.boundaries[LEFT], mapper.growth.tentative[LEFT]
    confirmed, size = boundary.confirmed_end, boundary.size
    tentative.clear()
    for t in (5.0, 5.1, 5.2):
        tentative.add(np.array([[36.0, 1.0], [32.0, 1.0], [28.0, 1.0]]), np.full(3, 0.01), t)
    x = mapper.poses[-1, 0]
    points = np.array([[60.0, 3.0], [0.0, 3.0], [0.0, 0.0], [x, 0.0], [x + 7.0, 0.0]])
    stations = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    assert (
        mapper.growth.expand(mapper.smoother, PathAhead(points, stations, float(stations[3]))) == frozenset()
    )
    assert (boundary.confirmed_end, boundary.size) == (confirmed, size)


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
    """How far (m) a curve goes back between two neighbours of a row, at most."""
    assert log.truth is not None
    cones = log.truth.cones[log.truth.cone_labels == LEFT]
    spline = mapper.map().boundaries[LEFT].spline
    u = np.linspace(*spline.domain, 4000)
    nearest = u[KDTree(spline.evaluate(u)).query(cones)[1]]
    return float(np.max(-np.diff(nearest), initial=0.0))


def test_an_end_led_on_in_the_wrong_order_is_taken_back() -> None:
    log = hairpin()
    mapper, _ = map_log(log)
    assert backwards(mapper, log) < 0.5
    settings = MapperSettings()
    never = replace(settings, growth=replace(settings.growth, recall=0.1))
    assert backwards(map_log(log, FixedLagMapper(never, log.odometry_sigma))[0], log) > 2.0
