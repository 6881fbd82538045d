"""Cones that are followed and merged by the compiled functions, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors import _kernels as kernels

NEARER, FARTHER = 0.5, 0.15


@pytest.mark.parametrize(
    ("ranges", "gain"), [((5.0, 9.0), NEARER), ((9.0, 5.0), NEARER), ((9.0, 8.0), FARTHER)]
)
def test_the_nearer_of_two_sightings_of_a_cone_tells_how_far_it_moves(
    ranges: tuple[float, float], gain: float
) -> None:
    """A cone that was seen from 6 m moves by the larger gain if either of them is from nearer."""
    known = np.array([[10.0, 0.0]]), np.array([0]), np.array([6.0]), np.array([0.0]), np.array([4])
    points = np.array([[10.2, 0.2], [10.4, 0.2]])
    numbers, cones, count = kernels.followed(
        np.array([0, 2]),
        np.array([0.1]),
        np.zeros((1, 2)),
        points,
        np.array([0, 0]),
        np.array(ranges),
        *np.full((2, 2), 1.5),
        known,
        5,
        (3.0, NEARER, FARTHER),
    )
    np.testing.assert_array_equal(numbers, [4, 4])
    np.testing.assert_allclose(cones[0], [[10.0 + 0.3 * gain, 0.2 * gain]])
    assert cones[2].tolist() == [min(6.0, *ranges)] and cones[3].tolist() == [0.1] and count == 5


def test_of_new_detections_in_a_row_the_last_is_of_no_cone() -> None:
    """Each is beside the one before. The second is of the first one's cone, and has none of its own."""
    nothing = np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0), np.zeros(0), np.zeros(0, np.intp)
    numbers, cones, count = kernels.followed(
        np.array([0, 3]),
        np.array([0.1]),
        np.zeros((1, 2)),
        np.array([[10.0, 0.0], [11.2, 0.0], [12.4, 0.0]]),
        np.zeros(3, np.intp),
        np.array([10.0, 11.2, 12.4]),
        *np.full((2, 3), 1.5),
        nothing,
        0,
        (3.0, NEARER, FARTHER),
    )
    np.testing.assert_array_equal(numbers, [0, 0, -1])
    np.testing.assert_array_equal(cones[0], [[10.0, 0.0]])
    assert count == 1
