"""Rows that lead on between two boundaries, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.mapping.path import crosses
from pathspace_graph.online.outlook import TentativeRow, extend_rows

THRESHOLD = 0.7
PATH = np.array([[-10.0, 0.0], [0.0, 0.0]])


def row(side: float, *candidates: tuple[float, float], end: float = 0.0) -> TentativeRow:
    """Returns a row along x that ends 2 m to the left or to the right of (end, 0)."""
    line = np.array([[-10.0, 2.0 * side], [end, 2.0 * side]])
    return TentativeRow(side, line, np.array([1.0, 0.0]), np.array(candidates).reshape(-1, 2))


def chosen(left: TentativeRow, right: TentativeRow, driven: np.ndarray = PATH) -> tuple[list[int], list[int]]:
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
