"""Two rows of cones without colours: each cone goes to the row that it fits better, or to none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.front_end.sides import GAP, ConeRow, follow_rows
from pathspace_graph.labels import LEFT, RIGHT

Array = NDArray[np.float64]


def begun(half_width: float = 1.75) -> dict[int, ConeRow]:
    """Two rows that begin beside a vehicle at the origin, which heads along x."""
    return {
        LEFT: ConeRow([], np.array([0.0, half_width]), 0.0),
        RIGHT: ConeRow([], np.array([0.0, -half_width]), 0.0),
    }


def bend(radius: float, half_width: float, gap: float, angle: float) -> tuple[Array, Array]:
    """Both rows (k, 2) of a left bend about (0, radius), whose cones are `gap` apart on the outer side."""
    phi = np.arange(gap, angle * (radius + half_width), gap) / (radius + half_width)
    rows = [
        np.column_stack([r * np.sin(phi), radius - r * np.cos(phi)])
        for r in (radius - half_width, radius + half_width)
    ]
    return rows[0], rows[1]


def followed(rows: dict[int, ConeRow], left: Array, right: Array) -> tuple[list[int], list[int]]:
    points = np.concatenate([left, right])
    votes = np.zeros((len(points), 2), np.intp)
    follow_rows(rows, points, votes, np.arange(len(points)))
    return rows[LEFT].cones, rows[RIGHT].cones


@pytest.mark.parametrize("radius", [6.0, 9.0, 25.0, 1e4])
@pytest.mark.parametrize("half_width", [1.5, 2.0, 3.0])
def test_both_rows_of_a_bend_are_followed_to_their_ends(radius: float, half_width: float) -> None:
    left, right = bend(radius, half_width, 3.5, min(1.5, 15.0 / radius))
    found = followed(begun(half_width), left, right)
    assert found == (list(range(len(left))), list(range(len(left), len(left) + len(right))))


def test_a_row_with_a_missing_cone_does_not_lead_across_the_track() -> None:
    """The next cone of the right row is 7 m ahead; the cone across is 4.4 m away, and is of the left row."""
    left = np.array([[4.0, 1.75], [8.0, 1.75], [12.0, 1.75]])
    right = np.array([[7.0, -1.75], [11.0, -1.75]])
    assert followed(begun(), left, right) == ([0, 1, 2], [3, 4])


def test_a_cone_between_the_rows_ends_both() -> None:
    left, right = np.array([[9.0, 1.75]]), np.array([[9.0, -1.75]])
    middle = np.array([[5.0, 0.0]])
    rows = begun()
    assert followed(rows, np.concatenate([left, middle]), right) == ([], [])


def test_colours_that_a_cone_was_seen_in_are_kept() -> None:
    """A cone that fits the left row, but was yellow three times, is in neither row."""
    points = np.array([[4.0, 1.75], [4.0, -1.75]])
    rows = begun()
    follow_rows(rows, points, np.array([[0, 3], [0, 0]]), np.arange(2))
    assert rows[LEFT].cones == []
    assert rows[RIGHT].cones == [1]


def test_a_row_does_not_reach_farther_than_a_gap() -> None:
    left = np.array([[GAP + 0.1, 1.75]])
    assert followed(begun(), left, np.zeros((0, 2))) == ([], [])
