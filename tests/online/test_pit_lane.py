"""A vehicle that leaves its closed circuit by a lane with cones of its own, and comes back to it."""

from functools import cache

import numpy as np
import pytest

from pathspace_graph.health import LOST
from pathspace_graph.loop.closed import FOUND
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.planning import TrackAhead

from ..scenes.drives import Array, replay, true_poses
from ..scenes.kidnapped import circuit_with_lane

pytestmark = pytest.mark.slow

AFTER = 8.0
"""Time after the lane in which the vehicle is found again (s)."""


@cache
def driven() -> tuple[FixedLagMapper, list[CycleResult], list[TrackAhead], list[Array]]:
    """Return the mapper, and after each cycle its result, what is ahead, and the closed map's points."""
    log, _, back = circuit_with_lane()
    mapper, results, ahead, maps = FixedLagMapper(MapperSettings(), log.odometry_sigma), [], [], []
    for odometry, detections in split_odometry(log):
        if detections.t > back + AFTER:
            break
        results.append(replay(mapper, odometry, detections))
        ahead.append(mapper.ahead(10.0))
        maps.append(mapper.road.smoother.map.state.map_points.copy())
    return mapper, results, ahead, maps


def test_a_vehicle_that_leaves_the_circuit_is_lost_until_it_is_back() -> None:
    """It is searched meanwhile, and there is no track ahead: nobody knows where it is."""
    _, leaves, back = circuit_with_lane()
    _, results, ahead, _ = driven()
    lost = [k for k, r in enumerate(results) if r.health.condition == LOST]
    assert leaves < results[lost[0]].t < leaves + 2.0
    (found,) = [k for k, r in enumerate(results) if r.notice == FOUND]
    assert lost == [*range(lost[0], found)]
    assert back < results[found].t < back + 6.0
    assert {ahead[k].length for k in lost} == {0.0}
    assert ahead[lost[0] - 1].length > 5.0


def test_the_closed_map_stays_as_it_is() -> None:
    _, leaves, back = circuit_with_lane()
    _, results, _, maps = driven()
    before, after = (max(k for k, r in enumerate(results) if r.t < t) for t in (leaves, back))
    assert all(r.closed for r in results[before:])
    assert np.abs(maps[after] - maps[before]).max() < 0.2
    assert np.abs(maps[-1] - maps[before]).max() < 0.3  # it is estimated on once the vehicle is back


def test_the_vehicle_is_at_its_place_when_it_is_back() -> None:
    log, (_, results, _, _) = circuit_with_lane()[0], driven()
    off = [np.hypot(*(r.pose - pose)[:2]) for r, pose in zip(results, true_poses(log), strict=False)]
    assert max(off) < 0.5
