"""Sightings: merged by weight, counted, confirmed, forgotten; every answer by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.mapping.tentative import TentativeTracks
from pathspace_graph.settings.growth import GrowthSettings

Array = NDArray[np.float64]

SETTINGS = GrowthSettings(sightings=3, merge_radius=1.0, forget_after=6.0)


def tentative(*detections: tuple[float, float, float, float]) -> TentativeTracks:
    """Sightings after readings (x, y, variance, t), one at a time; the variance is the trace."""
    found = TentativeTracks(SETTINGS)
    for x, y, variance, t in detections:
        found.add(np.array([[x, y]]), round_covariances(variance), t)
    return found


def round_covariances(*variances: float) -> Array:
    """Returns covariances (m, 2, 2) that are alike in all directions, of these traces."""
    return 0.5 * np.array(variances)[:, None, None] * np.eye(2)


def test_a_merged_sighting_is_the_weighted_mean() -> None:
    """Weights 1 and 2: a third of the way is left to the first."""
    found = tentative((0.0, 0.0, 1.0, 0.0), (0.3, -0.6, 0.5, 0.1))
    np.testing.assert_allclose(found.points, [[0.2, -0.4]], atol=1e-15)
    np.testing.assert_allclose(found.information, [6.0 * np.eye(2)])
    assert found.counts.tolist() == [2]
    assert found.last_t.tolist() == [0.1]


def test_two_readings_of_one_cycle_merge_one_after_the_other() -> None:
    found = tentative((0.0, 0.0, 1.0, 0.0))
    found.add(np.array([[0.6, 0.0], [0.0, 0.3]]), round_covariances(1.0, 1.0), 0.1)
    np.testing.assert_allclose(found.points, [[0.2, 0.1]], atol=1e-15)
    assert found.counts.tolist() == [3]


@pytest.mark.parametrize(("distance", "count"), [(0.99, 1), (1.01, 2)])
def test_of_what_is_known_well_only_what_is_near_merges(distance: float, count: int) -> None:
    """Each is known to 0.22 m, so 1.01 m are more than three sigmas of both together."""
    assert len(tentative((0.0, 0.0, 0.1, 0.0), (distance, 0.0, 0.1, 0.1)).points) == count


def test_a_reading_goes_to_the_nearest() -> None:
    found = tentative((0.0, 0.0, 0.1, 0.0), (1.5, 0.0, 0.1, 0.0), (0.9, 0.0, 0.1, 0.1))
    np.testing.assert_allclose(found.points, [[0.0, 0.0], [1.2, 0.0]], atol=1e-15)
    assert found.counts.tolist() == [1, 2]


def test_confirmed_when_seen_three_times() -> None:
    twice = [(0.0, 0.0, 1.0, 0.1 * k) for k in range(2)]
    assert tentative(*twice).confirmed().tolist() == []
    found = tentative((9.0, 0.0, 1.0, 0.0), *twice, (0.1, 0.0, 1.0, 0.2))
    assert found.confirmed().tolist() == [1]


@pytest.mark.parametrize(("t", "left"), [(5.9, 2), (6.1, 1), (6.3, 0)])
def test_what_is_not_seen_again_is_forgotten(t: float, left: int) -> None:
    """Also in a cycle in which nothing is seen."""
    found = tentative((0.0, 0.0, 1.0, 0.0), (5.0, 0.0, 1.0, 0.2))
    found.add(np.zeros((0, 2)), np.zeros((0, 2, 2)), t)
    assert len(found.points) == len(found.information) == len(found.counts) == len(found.last_t) == left


def test_seeing_it_again_keeps_it() -> None:
    found = tentative((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 5.0), (9.0, 0.0, 1.0, 10.0))
    assert found.counts.tolist() == [2, 1]


def test_remove_and_clear() -> None:
    found = tentative(*((3.0 * k, 0.0, 1.0, 0.1 * k) for k in range(3)))
    found.remove(np.array([1]))
    np.testing.assert_array_equal(found.points[:, 0], [0.0, 6.0])
    np.testing.assert_array_equal(found.last_t, [0.0, 0.2])
    found.clear()
    assert found.points.shape == (0, 2)
    assert found.confirmed().tolist() == []


def test_a_rigid_motion_moves_every_track() -> None:
    """A half turn and a shift; what is alike in all directions and the counts stay."""
    found = tentative((1.0, 0.0, 1.0, 0.0), (4.0, 2.0, 0.5, 0.0))
    found.move(np.array([1.0, 1.0, np.pi]))
    np.testing.assert_allclose(found.points, [[0.0, 1.0], [-3.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(found.information, [2.0 * np.eye(2), 4.0 * np.eye(2)], atol=1e-12)
    assert found.counts.tolist() == [1, 1]


def test_of_too_many_tracks_those_stay_that_were_seen_last() -> None:
    found = TentativeTracks(GrowthSettings(max_tracks=3))
    for k, t in enumerate([0.4, 0.1, 0.3, 0.2, 0.5]):
        found.add(np.array([[3.0 * k, 0.0]]), round_covariances(1.0), t)
    assert found.points[:, 0].tolist() == [0.0, 6.0, 12.0]
    assert found.last_t.tolist() == [0.4, 0.3, 0.5]


def test_a_late_detection_makes_no_track_older() -> None:
    found = tentative((0.0, 0.0, 1.0, 2.0), (0.0, 0.0, 1.0, 1.5))
    assert found.last_t.tolist() == [2.0]
    assert found.counts.tolist() == [2]
