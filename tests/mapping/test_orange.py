"""Orange cones: a place has as many as its cycles detect together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import BIG_ORANGE, ORANGE
from pathspace_graph.mapping.tracks import OrangeDetections, orange_cones
from pathspace_graph.settings.mapper import GrowthSettings

Array = NDArray[np.float64]

NOTHING = np.zeros(0)  # a sensor without errors

SETTINGS = GrowthSettings(sightings=3, merge_radius=1.0)

CONES = np.array([[5.0, 1.0], [5.0, -1.0], [8.0, 0.0]])
LABELS = np.array([BIG_ORANGE, BIG_ORANGE, ORANGE])


Seen = tuple[Array, Detections]
"""The pose of a cycle, and what is detected in it."""


def seen_from(pose: Array) -> Seen:
    """The cones as a vehicle sees them, exactly, of which it is told a standard deviation of 0.2 m."""
    local = (CONES - pose[:2]) @ rotation(pose[2])
    return pose, Detections(0.0, local, np.tile(0.04 * np.eye(2), (3, 1, 1)), LABELS)


def of_cycles(cycles: Sequence[Seen]) -> OrangeDetections:
    found = OrangeDetections()
    for cycle, (pose, seen) in enumerate(cycles):
        found.add(seen, cycle, np.zeros(3), pose)
    return found


def merged(seen: OrangeDetections, sensor: Array = NOTHING) -> dict[int, PointBoundary]:
    return orange_cones(seen, sensor, SETTINGS, 0.1)


def test_orange_cones_are_points_once_they_were_seen_often_enough() -> None:
    seen = [seen_from(np.array([cycle, 0.0, 0.1 * cycle])) for cycle in range(3)]
    assert merged(of_cycles([])) == merged(of_cycles(seen[:2])) == {}
    found = merged(of_cycles(seen))
    np.testing.assert_allclose(
        sorted(found[BIG_ORANGE].points.tolist()), sorted(CONES[:2].tolist()), atol=1e-12
    )
    np.testing.assert_allclose(found[ORANGE].points, CONES[2:], atol=1e-12)
    np.testing.assert_allclose(found[ORANGE].covariance, (1.15 * 0.04 / 3 + 0.01) * np.eye(2), atol=1e-12)


def test_orange_cones_are_placed_by_corrected_poses() -> None:
    """The drive had drifted by a metre in its last two cycles, and its heading by 0.1 rad."""
    wrong, true = np.array([0.0, 1.0, 0.1]), [np.array([cycle, 0.0, 0.0]) for cycle in range(4)]
    cones = of_cycles([(pose + wrong * (k >= 2), seen_from(pose)[1]) for k, pose in enumerate(true)])
    before = cones.copy()
    cones.place(2, np.array(true[2:]))
    np.testing.assert_allclose(merged(cones)[ORANGE].points, CONES[2:], atol=1e-12)
    np.testing.assert_array_equal(before.pose[-1], true[3] + wrong)  # a copy stays as it was


def test_orange_cones_move_with_the_map_behind_the_vehicle() -> None:
    cones, motion = of_cycles([seen_from(np.zeros(3))] * 3), np.array([1.0, 2.0, 0.5 * np.pi])
    cones.move(motion)
    np.testing.assert_allclose(merged(cones)[ORANGE].points, [[1.0, 10.0]], atol=1e-12)
    cones.place(7, np.zeros((0, 3)))  # nothing is known of their cycles
    np.testing.assert_allclose(merged(cones)[ORANGE].points, [[1.0, 10.0]], atol=1e-12)


def test_errors_of_the_sensor_are_taken_out_of_orange_cones() -> None:
    """Ranges are a tenth too long, to first order."""
    found = merged(of_cycles([seen_from(np.zeros(3))] * 3), np.array([0.0, 0.0, 0.0, 0.1, 0.0]))
    np.testing.assert_allclose(found[ORANGE].points, [[7.2, 0.0]], atol=1e-12)


def test_only_the_newest_detections_of_orange_cones_are_remembered() -> None:
    """Three a cycle: of the oldest cycle of those that are kept all stay."""
    cones, cycles = OrangeDetections(), OrangeDetections.MOST // 3 + 20
    for cycle in range(cycles):
        cones.add(seen_from(np.zeros(3))[1], cycle, np.zeros(3), np.zeros(3))
    assert 0 <= len(cones) - OrangeDetections.MOST < 3
    assert cones.cycle[-1] == cycles - 1 and len(cones.pose) == len(cones)


def gate(spacing: float) -> Array:
    """Places of a start gate: a pair of cones on each side, 4 m apart."""
    return np.array([[x, y] for x in (0.0, spacing) for y in (2.0, -2.0)])


def driven_by(
    truth: Array, drifts: list[float], sigmas: tuple[float, float], told: float = 1.0
) -> list[Seen]:
    """Detect cones in passes whose poses have drifted along the road, each with a chance of `told`."""
    rng, found, count = np.random.default_rng(3), list[Seen](), len(truth)
    for number, drift in enumerate(drifts):
        slow = rng.normal(0.0, 0.3, truth.shape) * sigmas
        for k in range(20):
            points = truth + slow + rng.normal(0.0, 1.0, truth.shape) * sigmas
            points[:, 0] += 10.0 + drift
            covariances = np.tile(np.diag(np.square(sigmas)), (count, 1, 1))
            cycle = Detections(20.0 * number + 0.2 * k, points, covariances, np.full(count, BIG_ORANGE))
            cycle = cycle.where(rng.random(count) < told)
            found.append((np.array([-10.0, 0.0, 0.0]), cycle))
    return found


@pytest.mark.parametrize("spacing", [0.8, 1.0, 1.5])
@pytest.mark.parametrize("sigmas", [(0.05, 0.05), (0.15, 0.15), (0.2, 0.2), (0.35, 0.1)])
@pytest.mark.parametrize("told", [1.0, 0.85])
def test_a_gate_of_pairs_has_four_cones_however_often_it_is_passed(
    spacing: float, sigmas: tuple[float, float], told: float
) -> None:
    """A fifth of a metre of drift from pass to pass is what a localized vehicle has at most."""
    seen = driven_by(gate(spacing), [0.0, 0.2, -0.2, 0.1], sigmas, told)
    found = merged(of_cycles(seen))[BIG_ORANGE].points
    assert len(found) == 4
    apart = np.hypot(*(found[:, None] - gate(spacing)).transpose(2, 0, 1))
    assert sorted(apart.argmin(axis=1).tolist()) == [0, 1, 2, 3]
    assert (apart.min(axis=1) < 0.1 + sigmas[0]).all()


def test_a_cone_that_is_detected_twice_now_and_then_is_one() -> None:
    seen = driven_by(gate(1.0), [0.0], (0.1, 0.1))
    for k in range(0, 20, 3):
        pose, once = seen[k]
        seen[k] = pose, once.with_others(once.where(np.arange(4) < 1))
    assert len(merged(of_cycles(seen))[BIG_ORANGE].points) == 4


def test_cones_along_a_lane_are_places_of_their_own() -> None:
    """The vehicle passes ten cones that are 3 m apart, and sees those from 2 to 12 m ahead."""
    rng, lane, seen = np.random.default_rng(0), 3.0 * np.arange(10.0), list[Seen]()
    for cycle in range(60):
        x = 0.5 * cycle - 5.0
        ahead = lane[(lane > x + 2.0) & (lane < x + 12.0)] - x
        points = np.column_stack([ahead, np.ones(len(ahead))]) + rng.normal(0.0, 0.1, (len(ahead), 2))
        covariances = np.tile(0.01 * np.eye(2), (len(ahead), 1, 1))
        detections = Detections(0.1 * cycle, points, covariances, np.full(len(ahead), ORANGE))
        seen.append((np.array([x, 0.0, 0.0]), detections))
    found = merged(of_cycles(seen))[ORANGE].points
    np.testing.assert_allclose(np.sort(found[:, 0]), lane, atol=0.1)


def test_a_false_cone_of_a_few_vague_detections_is_no_point() -> None:
    seen = Detections(0.0, np.array([[30.0, 1.0]]), 0.9**2 * np.eye(2)[None], np.array([BIG_ORANGE]))
    assert merged(of_cycles([(np.zeros(3), seen)] * 4)) == {}
