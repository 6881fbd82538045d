"""A vehicle that leaves its closed circuit by a lane with cones of its own, and comes back to it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.health import DEGRADED, LOST
from pathspace_graph.loop.lost import NEW_ROAD, Lost
from pathspace_graph.loop.relocalization import FOUND
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.ahead import TrackAhead

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


def test_a_vehicle_that_leaves_the_circuit_is_on_new_road_and_not_lost_for_long() -> None:
    _, leaves, back = circuit_with_lane()
    results = driven()[1]
    lost = [r.t for r in results if r.health.condition == LOST]
    (begins,) = [r.t for r in results if NEW_ROAD in r.notice]
    assert leaves < min(lost) < leaves + 2.0 and begins - min(lost) < 5.0
    on_it = [r.health for r in results if begins <= r.t < back]
    assert {(health.condition, health.reason) for health in on_it} == {(DEGRADED, NEW_ROAD)}
    (found,) = [r.t for r in results if r.notice == FOUND]
    assert back < found < back + 6.0
    assert len(lost) < 6.0 / 0.1


def test_what_is_ahead_is_the_new_road() -> None:
    log, leaves, back = circuit_with_lane()
    _, results, ahead, _ = driven()
    cycles = [k for k, r in enumerate(results) if leaves + 3.0 < r.t < back - 2.0]
    assert np.mean([ahead[k].length > 5.0 for k in cycles]) > 0.95
    truth = log.truth
    assert truth is not None
    lane = truth.poses[(truth.pose_t > leaves) & (truth.pose_t < back), :2]
    for k in cycles:
        points = to_map(ahead[k].points, true_poses(log)[k, None])
        off = np.hypot(*(points[:, None] - lane).transpose(2, 0, 1)).min(axis=1)
        assert off.max(initial=0.0) < 1.0


def test_the_new_road_is_seen_by_the_calibrated_sensor() -> None:
    """The detections are turned by two degrees, which the closed map has learned."""
    log, leaves, back = circuit_with_lane()
    turn = np.deg2rad(2.0)
    c, s = np.cos(turn), np.sin(turn)
    mapper, checked = FixedLagMapper(MapperSettings(), log.odometry_sigma), 0
    for odometry, seen in split_odometry(log):
        turned = replace(seen, points_vehicle=seen.points_vehicle @ np.array([[c, -s], [s, c]]))
        replay(mapper, odometry, turned)
        if isinstance(mapper.phase, Lost) and mapper.phase.new_road is not None:
            roads = mapper.road, mapper.phase.new_road
            known, own = (road.smoother.variables.sensor[0] for road in roads)
            assert abs(known - turn) < np.deg2rad(0.3) and abs(own - known) < np.deg2rad(0.3)
            checked += 1
        if seen.t > 0.5 * (leaves + back):
            break
    assert checked > 10


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
