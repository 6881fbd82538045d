"""Stations: which cone a detection is of, and where that is in doubt."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.detection_rows import CurveStations, Stations
from pathspace_graph.mapping.detections import NO_STATION

from ..scenes.batch import ring, state_of

LENGTH = 100.0


def stations(*u: float, sigma: float = 0.0) -> CurveStations:
    """Return stations of a closed curve of 100 m."""
    places = np.array(u)
    return CurveStations.of(LEFT, 10, places, np.full(len(places), sigma), (0.0, LENGTH))


@pytest.mark.parametrize(
    ("u", "station", "beyond"),
    [(11.0, 0, 1.0), (29.0, 1, -1.0), (111.0, 0, 1.0), (95.0, 2, 5.0), (2.0, 0, -8.0), (-89.0, 0, 1.0)],
)
def test_the_nearest_station_across_the_seam(u: float, station: int, beyond: float) -> None:
    found, distance = stations(10.0, 30.0, 90.0).nearest(np.array([u]))
    assert (found[0], distance[0]) == (station, pytest.approx(beyond))


@pytest.mark.parametrize(("u", "station", "beyond"), [(2.0, 0, -8.0), (29.0, 1, -1.0), (140.0, 2, 50.0)])
def test_an_open_curve_has_no_seam(u: float, station: int, beyond: float) -> None:
    places = np.array([10.0, 30.0, 90.0])
    found, distance = CurveStations.of(LEFT, 0, places, np.zeros(3), (0.0, np.inf)).nearest(np.array([u]))
    assert (found[0], distance[0]) == (station, pytest.approx(beyond))


def test_distances_to_neighbours_go_around() -> None:
    np.testing.assert_allclose(stations(10.0, 30.0, 90.0).apart, [20.0, 20.0, 20.0])
    np.testing.assert_allclose(stations(10.0, 12.0, 99.0).apart, [2.0, 2.0, 11.0])


def test_a_match_is_certain_below_half_the_distance_of_the_next_cone() -> None:
    """Neighbours 3 m apart: by 1.5 m for three sigmas, and so for 0.5 m."""
    row = stations(10.0, 13.0, 16.0)
    at = np.array([13.1, 13.1])
    assert row.matched(at, np.array([0.49, 0.51])).tolist() == [11, NO_STATION]


def test_a_match_is_within_three_sigmas() -> None:
    row = stations(10.0, 13.0, 16.0)
    sigma = np.full(2, 0.2)
    assert row.matched(np.array([13.59, 13.61]), sigma).tolist() == [11, NO_STATION]


def test_the_station_s_own_sigma_counts() -> None:
    row = stations(10.0, 13.0, 16.0, sigma=0.4)
    assert row.matched(np.array([13.1]), np.array([0.29])).tolist() == [11]  # hypot(0.4, 0.29) = 0.494
    assert row.matched(np.array([13.1]), np.array([0.31])).tolist() == [NO_STATION]


def test_what_is_not_known_is_of_no_station() -> None:
    assert stations(10.0, 13.0).matched(np.array([np.nan]), np.array([0.1])).tolist() == [NO_STATION]


def test_all_curves_are_numbered_together() -> None:
    """Cones of two rings, given in no order: their points are those of the curves, in ascending order."""
    state = state_of({LEFT: ring(8.0), RIGHT: ring(12.0)}, np.zeros((3, 3)), periodic=True)
    length = {label: boundary.length for label, boundary in state.boundaries.items()}
    left = np.array([[20.0, 0.3], [5.0, 0.1], [5.0 + length[LEFT], 0.2]])
    found = Stations.of(state, {LEFT: left, RIGHT: np.array([[30.0, 0.5], [1.0, 0.4]])})
    assert found.label.tolist() == [LEFT] * 3 + [RIGHT] * 2
    assert [curve.first for curve in found.curves] == [0, 3]
    np.testing.assert_allclose(found.sigma, [0.1, 0.2, 0.3, 0.4, 0.5])
    at = np.einsum("kj,kjd->kd", found.value, state.map_points[found.columns])
    for number, (label, own) in enumerate(
        [(LEFT, 5.0), (LEFT, 5.0), (LEFT, 20.0), (RIGHT, 1.0), (RIGHT, 30.0)]
    ):
        expected = state.boundaries[label].evaluate(state.control_points(label), np.array([own]))[0]
        np.testing.assert_allclose(at[number], expected, atol=1e-9)
