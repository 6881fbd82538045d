"""The driving order of unordered cones, and the place of a start, on lanes made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.sim.curves import along_path
from pathspace_graph.sim.track_files import driving_order

ANGLES = np.arange(0.0, 2.0 * np.pi, np.pi / 10.0)
START = np.array([12.0, 0.0, 0.5 * np.pi])
NO_GATE = np.zeros((0, 2))


def ring(radius: float) -> np.ndarray:
    return radius * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])


def is_ring(row: np.ndarray) -> bool:
    """Whether all cones of a ring are in their order, from any one on."""
    return sorted(row.tolist()) == list(range(20)) and set(np.diff(row).tolist()) <= {1, -19}


def test_gate_cones_that_lead_off_the_lane_are_left_out() -> None:
    """The one behind the outer row is to the left of the start, and ends the walk round."""
    for gate in (NO_GATE, np.array([[9.0, 11.0]])):
        order = driving_order(ring(10.0), ring(14.0), gate, START)
        assert order is not None and order.closed
        assert is_ring(order.left) and is_ring(order.right)


def test_a_cone_far_from_its_row_is_not_one_of_it_and_a_missed_one_is() -> None:
    """The inner one is 0.5 m beside its row, out of the lane; the other one is in the middle of the ring."""
    inner = 9.5 * np.array([[np.cos(0.05 * np.pi), np.sin(0.05 * np.pi)]])
    order = driving_order(np.concatenate([ring(10.0), inner, np.zeros((1, 2))]), ring(14.0), NO_GATE, START)
    assert order is not None and order.closed
    assert 21 not in order.left
    before = order.left.tolist().index(20)
    assert {order.left[before - 1], order.left[(before + 1) % 21]} == {0, 1}


def test_the_lane_ends_where_its_rows_part() -> None:
    """Another road, 28 m to the right, is none of it."""
    x = np.arange(-5.0, 31.0, 5.0)
    left, near = np.column_stack([x, 0.0 * x + 2.0]), np.column_stack([x[:5], 0.0 * x[:5] - 2.0])
    far = np.column_stack([x[5:], 0.0 * x[5:] - 30.0])
    order = driving_order(left, np.concatenate([near, far]), NO_GATE, np.zeros(3))
    assert order is not None and not order.closed
    assert order.right.tolist() == [0, 1, 2, 3, 4]
    assert order.left[:5].tolist() == [0, 1, 2, 3, 4]


def test_a_start_is_on_the_leg_that_leads_its_way() -> None:
    """A hairpin of two legs 4 m apart; the start is nearer to the one that leads back."""
    x = np.arange(0.0, 41.0)
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)[1:-1]
    bend = np.column_stack([40.0 + 2.0 * np.cos(turn), 2.0 + 2.0 * np.sin(turn)])
    there, back = np.column_stack([x, 0.0 * x]), np.column_stack([x[::-1], 0.0 * x + 4.0])
    line = along_path(np.concatenate([there, bend, back]), there, closed=False)
    assert line.nearest(np.array([20.0, 2.6, 0.0])) == pytest.approx(20.0, abs=0.3)
    assert line.nearest(np.array([20.0, 1.4, np.pi])) == pytest.approx(line.length - 20.0, abs=0.3)
