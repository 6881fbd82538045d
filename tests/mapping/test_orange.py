"""Orange cones: points that are merged in each pass; the best pass says which stand at a place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BIG_ORANGE, ORANGE
from pathspace_graph.mapping.orange import OrangeCones, Sighting
from pathspace_graph.settings.online import GrowthSettings

from ..oracles.copied import copied
from ..scenes.digest import digest

Array = NDArray[np.float64]

SETTINGS = GrowthSettings(sightings=3, merge_radius=1.0, forget_after=6.0)

CONES = np.array([[5.0, 1.0], [5.0, -1.0], [8.0, 0.0]])
LABELS = np.array([BIG_ORANGE, BIG_ORANGE, ORANGE])


def seen_from(pose: Array, cycle: int) -> Sighting:
    """The cones as a vehicle sees them, exactly, of which it is told a standard deviation of 0.2 m."""
    local = (CONES - pose[:2]) @ rotation(pose[2])
    detections = Detections(0.1 * cycle, local, np.tile(0.04 * np.eye(2), (3, 1, 1)), LABELS)
    return Sighting(cycle, pose, np.zeros(3), detections)


def test_orange_cones_are_points_once_they_were_seen_often_enough() -> None:
    cones = OrangeCones(SETTINGS, 0.1)
    for cycle in range(2):
        cones.add(seen_from(np.array([cycle, 0.0, 0.1 * cycle]), cycle), np.zeros(0))
    assert cones.points() == {}
    cones.add(seen_from(np.array([2.0, 0.0, 0.2]), 2), np.zeros(0))
    found = cones.points()
    np.testing.assert_allclose(found[BIG_ORANGE].points, CONES[:2], atol=1e-12)
    np.testing.assert_allclose(found[ORANGE].points, CONES[2:], atol=1e-12)
    np.testing.assert_allclose(found[ORANGE].covariance, (1.15 * 0.04 / 3 + 0.01) * np.eye(2), atol=1e-12)


def test_orange_cones_are_placed_again_where_poses_were_corrected() -> None:
    """The drive had drifted by a metre in its last two cycles, and its heading by 0.1 rad."""
    cones, wrong = OrangeCones(SETTINGS, 0.1), np.array([0.0, 1.0, 0.1])
    true = [np.array([cycle, 0.0, 0.0]) for cycle in range(4)]
    for cycle, pose in enumerate(true):
        believed = pose + wrong * (cycle >= 2)
        sighting = seen_from(pose, cycle)
        cones.add(Sighting(cycle, believed, sighting.twist, sighting.detections), np.zeros(0))
    cones.place_again(np.zeros(0), (2, np.array(true[2:])))
    np.testing.assert_allclose(cones.points()[BIG_ORANGE].points, CONES[:2], atol=1e-12)


def test_orange_cones_move_with_the_map_behind_the_vehicle() -> None:
    cones, motion = OrangeCones(SETTINGS, 0.1), np.array([1.0, 2.0, 0.5 * np.pi])
    for cycle in range(3):
        cones.add(seen_from(np.zeros(3), cycle), np.zeros(0))
    cones.move(motion)
    np.testing.assert_allclose(cones.points()[ORANGE].points, [[1.0, 10.0]], atol=1e-12)
    cones.place_again(np.zeros(0), (7, np.zeros((0, 3))))  # their poses have moved as well
    np.testing.assert_allclose(cones.points()[ORANGE].points, [[1.0, 10.0]], atol=1e-12)


def test_errors_of_the_sensor_are_taken_out_of_orange_cones() -> None:
    """Ranges are a tenth too long, to first order."""
    cones, sensor = OrangeCones(SETTINGS, 0.1), np.array([0.0, 0.0, 0.0, 0.1, 0.0])
    for cycle in range(3):
        cones.add(seen_from(np.zeros(3), cycle), sensor)
    np.testing.assert_allclose(cones.points()[ORANGE].points, [[7.2, 0.0]], atol=1e-12)


def test_only_the_newest_sightings_of_orange_cones_are_remembered() -> None:
    cones = OrangeCones(SETTINGS, 0.1)
    for cycle in range(OrangeCones.MOST + 20):
        cones.add(seen_from(np.zeros(3), cycle), np.zeros(0))
    assert len(cones._sightings) == OrangeCones.MOST
    assert cones._sightings[-1].cycle == OrangeCones.MOST + 19


def test_a_copy_of_orange_cones_stays_as_it_is_and_goes_on_as_the_original() -> None:
    """Nothing that happens to the original shows in a copy: more detections, a motion, and new poses."""
    cones, pose = OrangeCones(SETTINGS, 0.1), np.array([0.5, 0.0, 0.1])
    for cycle in range(3):
        cones.add(seen_from(np.zeros(3), cycle), np.zeros(0))
    for happens in (
        lambda cones: cones.add(seen_from(pose, 100), np.zeros(0)),  # a second pass
        lambda cones: cones.move(np.array([1.0, 2.0, 0.3])),
        lambda cones: cones.place_again(np.zeros(0), (1, pose + np.zeros((1, 3)))),
        lambda cones: cones.add(seen_from(pose, 101), np.zeros(0)),
    ):
        twin, expected = cones.copy(), copied(cones)
        happens(cones)
        assert digest(twin) == digest(expected)
        happens(twin)
        assert digest(twin) == digest(cones)


def gate(spacing: float) -> Array:
    """Places of a start gate: a pair of cones on each side, 4 m apart."""
    return np.array([[x, y] for x in (0.0, spacing) for y in (2.0, -2.0)])


def driven_by(cones: OrangeCones, truth: Array, drifts: list[float], sigmas: tuple[float, float]) -> None:
    """Detect cones in passes whose poses have drifted along the road, with errors along and across it."""
    rng, cycle, count = np.random.default_rng(3), 0, len(truth)
    for number, drift in enumerate(drifts):
        slow = rng.normal(0.0, 0.3, truth.shape) * sigmas
        for k in range(20):
            points = truth + slow + rng.normal(0.0, 1.0, truth.shape) * sigmas
            points[:, 0] += 10.0 + drift
            covariances = np.tile(np.diag(np.square(sigmas)), (count, 1, 1))
            seen = Detections(20.0 * number + 0.2 * k, points, covariances, np.full(count, BIG_ORANGE))
            cones.add(Sighting(cycle, np.array([-10.0, 0.0, 0.0]), np.zeros(3), seen), np.zeros(0))
            cycle += 1


@pytest.mark.parametrize("spacing", [0.8, 1.0, 1.5])
@pytest.mark.parametrize("sigmas", [(0.05, 0.05), (0.15, 0.15), (0.2, 0.2), (0.35, 0.1)])
def test_a_gate_of_pairs_has_four_cones_however_often_it_is_passed(
    spacing: float, sigmas: tuple[float, float]
) -> None:
    """The vehicle's place drifts by up to 0.9 m from pass to pass, more than the cones are apart."""
    cones = OrangeCones(GrowthSettings(), 0.1)
    driven_by(cones, gate(spacing), [0.0, 0.5, -0.4, 0.2], sigmas)
    found = cones.points()[BIG_ORANGE].points
    assert len(found) == 4
    off = (found - found.mean(axis=0))[:, None] - (gate(spacing) - gate(spacing).mean(axis=0))
    apart = np.hypot(off[..., 0], off[..., 1])
    assert sorted(apart.argmin(axis=1).tolist()) == [0, 1, 2, 3]  # each of the four is there, by their shape
    assert (apart.min(axis=1) < 0.1 + sigmas[0]).all()


def test_a_false_cone_of_a_few_vague_detections_is_no_point() -> None:
    cones = OrangeCones(GrowthSettings(), 0.1)
    for cycle in range(4):
        seen = Detections(
            0.2 * cycle, np.array([[30.0, 1.0]]), 0.9**2 * np.eye(2)[None], np.array([BIG_ORANGE])
        )
        cones.add(Sighting(cycle, np.zeros(3), np.zeros(3), seen), np.zeros(0))
    assert cones.points() == {}  # 0.45 m and more, where 0.4 m are asked for
