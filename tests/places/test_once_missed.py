"""What once no test noticed: passes of a road in the other direction, which are no earlier ones."""

from __future__ import annotations

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import path_lengths, to_vehicle
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.places.find import SURE_ODDS, Place, beside, find_return
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import path_of

ROAD = path_of(0.5, (40.0, 0.0))
BACK = ROAD[::-1] + np.array([0.0, 0.8, np.pi])  # 0.8 m to the left of the road


def test_a_place_beside_a_pass_in_the_other_direction_is_beside_none() -> None:
    place = Place(ROAD[30] + np.array([0.1, 0.3, 0.2]), np.eye(3), SURE_ODDS)
    for pose, cycle in ((ROAD, 30), (BACK, None)):
        assert beside(place, pose, np.ones(len(pose), bool)) == cycle


def test_cones_are_laid_on_the_pass_in_the_same_direction_though_another_is_nearer() -> None:
    """On the way back there, 300 m later, the vehicle has seen nothing. Its odometry is off by 0.5 m."""
    again, way = ROAD[10:60], np.array([[20.0, 150.0, 0.0]])
    true = np.concatenate([ROAD, way, BACK, way, again])
    poses = true + np.repeat([0.0, 0.5], [len(true) - len(again), len(again)])[:, None] * [0.0, 1.0, 0.0]
    last = path_lengths(poses)[len(true) - len(again) - 1]
    cones = np.random.default_rng(0).uniform([0.0, -5.0], [40.0, 5.0], (20, 2))

    def seen_in(cycles: IntArray) -> DetectionColumns:
        return DetectionColumns.of([seen_at(k) for k in range(cycles[0], cycles[-1] + 1)], int(cycles[0]))

    def seen_at(cycle: int) -> Detections:
        points = to_vehicle(cones, true[cycle : cycle + 1])
        near = (np.hypot(*points.T) < 12.0) & (np.cos(true[cycle, 2]) > 0.0)
        covariances: Array = np.tile(0.02 * np.eye(2), (near.sum(), 1, 1))
        return Detections(0.0, points[near], covariances, np.flatnonzero(near) % 2)

    found = find_return(seen_in, poses, float(last), MapperSettings())
    assert found is not None
    np.testing.assert_allclose(found[0].pose, true[-1], atol=0.1)
    assert found[1] == 59
