"""Contradictions: which cones beside a closed map count, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.known_loop import CERTAIN, SETTLE, SIGHTINGS, Loop, MapRepair, is_mapped
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import detections

Array = NDArray[np.float64]

SETTINGS = MapperSettings()
LATER = 100.0
"""The vehicle has passed everything at this stamp (s)."""


def lane(gap: tuple[float, float] | None = None) -> Loop:
    """Two straight boundaries along x, 4 m apart; the left one may have a gap."""
    x = np.arange(0.0, 100.0, 0.25)
    left, right = np.column_stack([x, np.full(len(x), 2.0)]), np.column_stack([x, np.full(len(x), -2.0)])
    mapped = np.ones(len(x), bool) if gap is None else (x < gap[0]) | (x > gap[1])
    curves = {LEFT: KDTree(left), RIGHT: KDTree(right)}
    begins = dict.fromkeys((LEFT, RIGHT), 0.0)
    return Loop(curves, {LEFT: mapped, RIGHT: mapped}, begins)


def seen(
    cones: Sequence[Sequence[float]],
    label: int = LEFT,
    times: int = SIGHTINGS,
    found: MapRepair | None = None,
    sigmas: tuple[float, float] = (0.1, 0.1),
) -> MapRepair:
    """Contradictions after cones were detected from a vehicle that stands at the origin; it has no map."""
    mapper = FixedLagMapper()
    found = found or MapRepair(SETTINGS)
    smoother, points = mapper.road.smoother, np.array(cones, float)
    smoother.variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    smoother.times.append(0.0)
    own = to_vehicle(points, np.zeros((len(points), 3)))
    for number in range(times):
        cycle = detections(0.1 * number, own, np.full(len(points), label))
        cycle = replace(cycle, covariances=np.tile(np.diag(sigmas) ** 2, (len(points), 1, 1)))
        new = smoother.map.detections.append(cycle, 0)
        found.observe(smoother.map, lane(), new, cycle.t)
    return found


ROW = [[40.0, 5.0], [45.0, 5.0], [50.0, 5.0]]
"""Three left cones that stand 3 m beside the left boundary."""


def test_a_row_of_cones_beside_the_boundary_is_a_stretch() -> None:
    (stretch,) = seen(ROW).stretches(lane(), LATER)
    assert stretch.label == LEFT
    np.testing.assert_allclose(stretch.cones[np.argsort(stretch.cones[:, 0])], ROW)


@pytest.mark.parametrize(
    ("cones", "why"),
    [
        (ROW[:2], "too few"),
        ([[40.0, 2.5], [45.0, 2.5], [50.0, 2.5]], "they lie on the curve"),
        ([[40.0, -2.3], [45.0, -2.3], [50.0, -2.3]], "they are of the other boundary, in a wrong colour"),
        ([[20.0, 5.0], [45.0, 5.0], [70.0, 5.0]], "they stand in no row"),
    ],
)
def test_other_cones_are_not(cones: list[list[float]], why: str) -> None:
    assert seen(cones).stretches(lane(), LATER) == [], why


def test_a_cone_that_is_seen_less_often_does_not_count() -> None:
    assert seen(ROW, times=SIGHTINGS - 1).stretches(lane(), LATER) == []


def test_detections_that_are_smeared_along_their_ray_do_not_count() -> None:
    assert seen(ROW, sigmas=(1.01 * CERTAIN, 0.1)).stretches(lane(), LATER) == []
    assert len(seen(ROW, sigmas=(0.99 * CERTAIN, 0.1)).stretches(lane(), LATER)) == 1


def test_there_are_none_until_the_vehicle_has_passed_all_of_them() -> None:
    found, last = seen(ROW), 0.1 * (SIGHTINGS - 1)
    assert found.stretches(lane(), last + 0.9 * SETTLE) == []
    assert len(found.stretches(lane(), last + 1.1 * SETTLE)) == 1


def test_the_colour_that_was_seen_more_often_at_a_place_counts() -> None:
    both = seen(ROW, RIGHT, 2 * SIGHTINGS, found=seen(ROW, LEFT))
    assert [stretch.label for stretch in both.stretches(lane(), LATER)] == [RIGHT]


def test_cones_in_a_gap_count_wherever_the_bridge_over_it_is() -> None:
    cones = [[40.0, 2.1], [45.0, 2.1], [50.0, 2.1]]
    assert len(seen(cones).stretches(lane(gap=(38.0, 52.0)), LATER)) == 1
    assert seen(cones).stretches(lane(gap=(60.0, 80.0)), LATER) == []


def test_nothing_is_left_once_the_map_was_replaced() -> None:
    found = seen(ROW)
    found.tracks.clear()
    assert found.stretches(lane(), LATER) == []


def test_a_gap_is_where_neighbours_are_much_farther_apart_than_others() -> None:
    """Cones at 5, 10, 15, 40 and 45 on 50 m: the gap is from 15 to 40, less a margin of 1 m at both ends."""
    cones = np.array([5.0, 60.0, 15.0, -10.0, 45.0])  # parameters may be of any lap
    u = np.array([0.0, 12.0, 15.5, 16.5, 38.5, 39.5, 47.0, 66.5])
    expected = [True, True, True, False, False, True, True, False]
    assert is_mapped(u, cones, 50.0, 3.0, 1.0).tolist() == expected
    assert is_mapped(u, cones, 50.0, 6.0, 1.0).all()
    assert is_mapped(u, cones[:1], 50.0, 3.0, 1.0).all()
