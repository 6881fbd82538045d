"""The road: what moves with it, and what a copy of it shares with no other."""

from __future__ import annotations

import numpy as np

from pathspace_graph.factors.se2 import move_points
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings

MOTION = np.array([1.0, 2.0, 0.3])
SEEN = np.array([[4.0, 1.5], [8.0, 1.5]])


def road_with_cones() -> Road:
    """A road that has driven two metres, and has seen two cones that no curve explains."""
    road = Road(MapperSettings())
    for x in (0.0, 1.0, 2.0):
        road.path.update(np.array([x, 0.0, 0.0]))
    road.growth.tentative.add(SEEN, np.tile(0.01 * np.eye(2), (2, 1, 1)), np.array([LEFT, LEFT]), 0.0)
    return road


def test_what_is_no_variable_moves_with_the_open_map() -> None:
    road = road_with_cones()
    driven = road.path.points
    road.move(MOTION)
    np.testing.assert_allclose(road.path.points, move_points(MOTION, driven), atol=1e-12)
    np.testing.assert_allclose(road.growth.tentative.points, move_points(MOTION, SEEN), atol=1e-12)


def test_a_copy_moves_alone() -> None:
    road = road_with_cones()
    other, driven = road.copy(), road.path.points
    other.move(MOTION)
    np.testing.assert_array_equal(road.path.points, driven)
    np.testing.assert_array_equal(road.growth.tentative.points, SEEN)
    np.testing.assert_allclose(other.growth.tentative.points, move_points(MOTION, SEEN), atol=1e-12)
