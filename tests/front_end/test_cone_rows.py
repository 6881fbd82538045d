"""Rows of cones, by hand: extended between two boundaries, or dealt out where cones have no colours."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.front_end.sides import ROW_GAP, ConeRow, extend_rows
from pathspace_graph.mapping.path import crosses

Array = NDArray[np.float64]

THRESHOLD = 0.7
PATH = np.array([[-10.0, 0.0], [0.0, 0.0]])


def row(side: float, *candidates: tuple[float, float], end: float = 0.0) -> ConeRow:
    """Returns a row along x that ends 2 m to the left or to the right of (end, 0)."""
    line = np.array([[-10.0, 2.0 * side], [end, 2.0 * side]])
    return ConeRow(side, line, np.array([1.0, 0.0]), np.array(candidates).reshape(-1, 2))


def chosen(left: ConeRow, right: ConeRow, driven: np.ndarray = PATH) -> tuple[list[int], list[int]]:
    extend_rows(left, right, driven, THRESHOLD)
    return left.chosen, right.chosen


def test_a_segment_crosses_a_line_or_not() -> None:
    line = np.array([[2.0, -1.0], [2.0, 1.0], [5.0, 1.0]])
    ends = np.array([[3.0, 0.0], [1.9, 0.0], [3.0, 2.0], [-3.0, 0.0], [4.0, 0.9]])
    assert crosses(np.zeros(2), ends, line).tolist() == [True, False, False, False, True]


def test_rows_extend_rows_in_the_order_of_the_track() -> None:
    left, right = row(1.0, (8.0, 2.0), (4.0, 2.0), (12.0, 2.0)), row(-1.0, (4.5, -2.0), (9.0, -2.0))
    assert chosen(left, right) == ([1, 0, 2], [0, 1])
    np.testing.assert_allclose(left.line[-1], [12.0, 2.0])
    np.testing.assert_allclose(left.direction, [1.0, 0.0])


@pytest.mark.parametrize(
    ("candidate", "follows"),
    [
        ((4.0, 2.0), True),
        ((0.5, 2.0), False),
        ((10.9, 2.0), True),
        ((11.1, 2.0), False),
        ((-0.3, 4.0), True),
        ((-2.0, 3.0), False),
        ((4.0, -0.6), False),
        ((4.0, -3.0), False),
    ],
    ids=["next", "at the end", "gap", "too far", "turn", "back", "narrow", "across the other row"],
)
def test_what_may_come_next(candidate: tuple[float, float], follows: bool) -> None:
    """The other row is known up to (9, -2)."""
    assert chosen(row(1.0, candidate), row(-1.0, (4.5, -2.0), (9.0, -2.0)))[0] == [0] * follows


def test_a_row_of_another_stretch_behind_the_next_cone_is_left_out() -> None:
    """Widths may grow from 4 m to 1.8 * 4 + 1 = 8.2 m beside a known row, and the near row is cheaper."""
    assert chosen(row(1.0, (5.0, 6.1), (4.0, 2.1)), row(-1.0, end=9.0))[0][:1] == [1]
    assert chosen(row(1.0, (5.0, 6.1)), row(-1.0, end=9.0))[0] == [0]
    assert chosen(row(1.0, (5.0, 6.3)), row(-1.0, end=9.0))[0] == []


def test_no_row_crosses_the_driven_path() -> None:
    """An older stretch of the drive ran 4 m to the left."""
    older = np.array([[20.0, 4.0], [-20.0, 4.0], [-20.0, 0.0], [0.0, 0.0]])
    assert chosen(row(1.0, (3.0, 5.0)), row(-1.0), older)[0] == []
    assert chosen(row(1.0, (3.0, 3.5)), row(-1.0), older)[0] == [0]


def test_without_candidates_nothing_is_chosen() -> None:
    assert chosen(row(1.0), row(-1.0)) == ([], [])


def test_a_hairpin_is_followed_around_its_inner_row() -> None:
    """The inner row turns by 180 degrees about (0, 4), 2 m away; the outer one is 4 m farther out."""
    angles = np.deg2rad([-45.0, 0.0, 45.0, 90.0])
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    inner, outer = np.array([0.0, 4.0]) + 2.0 * circle, np.array([0.0, 4.0]) + 6.0 * circle
    left = row(1.0, *map(tuple, inner.tolist()))
    right = row(-1.0, *map(tuple, outer.tolist()))
    assert chosen(left, right) == ([0, 1, 2, 3], [0, 1, 2, 3])


# --- cones without colours ---------------------------------------------------------------------------------


def begun(points: Array, half_width: float = 1.75) -> tuple[ConeRow, ConeRow]:
    """Two rows that begin beside a vehicle at the origin, which heads along x."""
    left, right = (np.array([[-8.0, side], [0.0, side]]) for side in (half_width, -half_width))
    ahead = np.array([1.0, 0.0])
    return ConeRow(1.0, left, ahead, points), ConeRow(-1.0, right, ahead, points)


def bend(radius: float, half_width: float, gap: float, angle: float) -> tuple[Array, Array]:
    """Both rows (k, 2) of a left bend about (0, radius), whose cones are `gap` apart on the outer side."""
    phi = np.arange(gap, angle * (radius + half_width), gap) / (radius + half_width)
    rows = [
        np.column_stack([r * np.sin(phi), radius - r * np.cos(phi)])
        for r in (radius - half_width, radius + half_width)
    ]
    return rows[0], rows[1]


def extended(left: Array, right: Array, half_width: float = 1.75) -> tuple[list[int], list[int]]:
    points = np.concatenate([left, right])
    rows = begun(points, half_width)
    extend_rows(*rows, np.array([[-8.0, 0.0], [0.0, 0.0]]), 0.7)
    return rows[0].chosen, rows[1].chosen


@pytest.mark.parametrize("radius", [6.0, 9.0, 25.0, 1e4])
@pytest.mark.parametrize("half_width", [1.5, 2.0, 3.0])
def test_both_rows_of_a_bend_are_followed_to_their_ends(radius: float, half_width: float) -> None:
    left, right = bend(radius, half_width, 3.5, min(1.5, 15.0 / radius))
    found = extended(left, right, half_width)
    assert found == (list(range(len(left))), list(range(len(left), len(left) + len(right))))


def test_a_row_with_a_missing_cone_does_not_lead_across_the_track() -> None:
    """The next cone of the right row is 7 m ahead; the cone across is 4.4 m away, and is of the left row."""
    left = np.array([[4.0, 1.75], [8.0, 1.75], [12.0, 1.75]])
    right = np.array([[7.0, -1.75], [11.0, -1.75]])
    assert extended(left, right) == ([0, 1, 2], [3, 4])


def test_a_row_does_not_reach_farther_than_a_gap() -> None:
    left = np.array([[ROW_GAP + 0.1, 1.75]])
    assert extended(left, np.zeros((0, 2))) == ([], [])
