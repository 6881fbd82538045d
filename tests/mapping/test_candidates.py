"""The chain of candidates: which of them may follow one another, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.mapping.path import Candidates, End, chain


def candidates(*places: tuple[float, float]) -> Candidates:
    """Returns candidates at (station, side), each at the point (station, side)."""
    points = np.array(places).reshape(-1, 2)
    return Candidates(points, np.arange(len(points)), points[:, 0], points[:, 1])


def end(station: float, side: float) -> End:
    return End(np.array([station, side]), station, side)


def test_a_row_at_one_distance_is_a_chain() -> None:
    assert chain(candidates((0.0, 2.0), (4.0, 2.0), (8.0, 2.0)), None).tolist() == [0, 1, 2]


def test_a_row_does_not_jump_to_the_next_lane_between_two_cones() -> None:
    """The cone of the next lane's row is 2.6 m farther from the path than that 2.2 m before it."""
    row = candidates((4.0, 1.3), (6.2, 3.9), (8.5, 1.3))
    assert chain(row, end(0.0, 1.3)).tolist() == [0, 2]
    assert chain(row, None).tolist() == [0, 2]


@pytest.mark.parametrize(("side", "follows"), [(1.0, True), (4.29, True), (4.31, False)])
def test_the_next_may_be_farther_from_the_path_by_a_step_and_a_rate(side: float, follows: bool) -> None:
    """4 m on: 2 + 1.5 + 0.2 * 4 = 4.3 m; to the other side it may come as near as it likes."""
    for found, begin in (
        (candidates((0.0, 2.0), (4.0, side)), None),
        (candidates((4.0, side)), end(0.0, 2.0)),
    ):
        assert (len(found.points) - 1 in chain(found, begin)) == follows


def test_one_that_is_left_out_does_not_lead_on_to_the_next() -> None:
    """The far row stands 6 m from the path: each of its cones is measured from the last near one."""
    found = candidates((0.0, 2.0), (4.0, 6.0), (8.0, 6.0), (12.0, 2.0))
    assert chain(found, None).tolist() == [0, 3]


@pytest.mark.parametrize(("begin", "count"), [(None, 4), (end(-4.0, 2.0), 4)], ids=["no curve", "a curve"])
def test_no_candidate_allows_the_next_one_more(begin: End | None, count: int) -> None:
    """A row leads away by 1.2 m from cone to cone, and only 0.8 m of them are the rate."""
    found = candidates(*((4.0 * k, 2.0 + 1.2 * k) for k in range(8)))
    assert chain(found, begin).tolist() == list(range(count))


def test_a_candidate_farther_out_does_not_end_the_chain() -> None:
    """One that may not follow is left out, and the next one is measured from the one before it."""
    found = candidates((4.0, 2.0), (8.0, 6.0), (12.0, 2.0), (16.0, 4.2))
    assert chain(found, end(0.0, 2.0)).tolist() == [0, 2, 3]


@pytest.mark.parametrize(("gap", "chosen"), [(0.7, [0, 1]), (0.9, [0])])
def test_of_those_beside_each_other_the_nearest_to_the_path_stay(gap: float, chosen: list[int]) -> None:
    assert chain(candidates((0.0, 2.0), (1.9, 2.0 + gap)), None).tolist() == chosen
    apart = candidates((0.0, 2.0), (2.1, 2.0 + gap))
    assert chain(apart, None).tolist() == [0, 1]


def test_no_candidates_are_an_empty_chain() -> None:
    assert chain(candidates(), end(0.0, 2.0)).tolist() == []


@given(st.lists(st.tuples(st.floats(0.0, 30.0), st.floats(0.0, 9.0)), max_size=12), st.floats(0.0, 5.0))
def test_every_candidate_of_a_chain_keeps_the_rule(places: list[tuple[float, float]], side: float) -> None:
    found = candidates(*sorted(places))
    chosen = found.where(chain(found, end(-1.0, side)))
    assert (chosen.sides <= side + 1.5 + 0.2 * (chosen.stations + 1.0) + 1e-9).all()


def test_chosen_candidates_keep_their_places_together() -> None:
    found = candidates((0.0, 2.0), (4.0, 3.0), (8.0, 1.0)).where(np.array([2, 0]))
    assert found.indices.tolist() == [2, 0]
    np.testing.assert_array_equal(found.points, np.column_stack([found.stations, found.sides]))
