"""Expansion on two straight rows: which detections extend a curve, how far, and what is done without any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines import ckf as expansion
from pathspace_graph.baselines.ckf import Belief, CurveState, Expansion, beyond_end, proximity_chain
from pathspace_graph.baselines.filters import FILTER_REACH
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.path import CARRIED_TO, DrivenPath, PathAhead
from pathspace_graph.settings.mapper import MapperSettings

from .scenes import detections_of, straight_rows

Array = NDArray[np.float64]

END = np.array([12.0, 2.0])
"""The left row ends here."""


def path_along_x(x: float, settings: MapperSettings) -> PathAhead:
    """Returns the path of a vehicle that has driven from 0 to `x` (m) along the x axis."""
    path = DrivenPath()
    for at in np.arange(0.0, x + 0.25, 0.5):
        path.update(np.array([at, 0.0, 0.0]))
    return path.ahead(np.array([x, 0.0, 0.0]), FILTER_REACH)


def expanded(
    state: CurveState, points: Array, x: float = 10.0, label: int = LEFT, times: int = 3
) -> tuple[set[int], Expansion]:
    """Moves the vehicle to `x`, detects map points (m, 2) a number of times, and expands."""
    state.belief.mean[0] = x
    expansion = Expansion(state.settings)
    seen = detections_of(points - [x, 0.0], np.full(len(points), label))
    for k in range(times):
        expansion.observe(state, replace(seen, t=0.1 * k))
    path_ahead = path_along_x(x, state.settings)
    return expansion.expand(state, seen, path_ahead, np.ones(len(points), bool)), expansion


def end_of(state: CurveState) -> Array:
    return np.asarray(state.control_points(LEFT)[-1])


def test_the_chain_goes_from_the_end_always_to_the_nearest() -> None:
    points = np.array([[9.0, 0.0], [3.0, 0.0], [6.0, 0.0]])
    np.testing.assert_array_equal(proximity_chain(points, np.zeros(2)), [1, 2, 0])


def test_the_chain_returns_for_a_point_that_it_has_passed() -> None:
    points = np.array([[4.0, 0.0], [5.0, 0.0], [0.0, 4.5]])
    np.testing.assert_array_equal(proximity_chain(points, np.zeros(2)), [0, 1, 2])
    assert len(proximity_chain(np.zeros((0, 2)), np.zeros(2))) == 0


def test_the_papers_three_conditions_by_hand() -> None:
    """The points are beyond the end, beside the curve, nearer than the threshold, and near `C_{n-1}`."""
    control_points = np.array([[0.0, 0.0], [4.0, 8.0], [8.0, 0.0]])
    points, u = np.array([[13.0, 0.0], [13.0, 0.0], [11.0, 0.0], [4.0, 5.0]]), np.array([9.0, 8.0, 9.0, 9.0])
    found = beyond_end(points, u, 9.0, control_points, 4.0, 4.0)
    np.testing.assert_array_equal(found, [True, False, False, False])


def test_the_curve_is_extended_to_the_last_point_of_the_chain() -> None:
    state = straight_rows()
    extended, _ = expanded(state, np.array([[18.5, 2.0], [16.5, 2.0]]))
    assert extended == {LEFT}
    assert state.curves[LEFT].size == 5 and state.curves[RIGHT].size == 4
    np.testing.assert_allclose(end_of(state), [18.5, 2.0], atol=0.05)


def test_a_long_extension_takes_a_point_between(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expansion, "LONGEST_EXTENSION", 5.0)
    state = straight_rows()
    expanded(state, np.array([[18.5, 2.0], [16.5, 2.0]]))
    assert state.curves[LEFT].size == 6
    np.testing.assert_allclose(end_of(state), [18.5, 2.0], atol=0.05)


@pytest.mark.parametrize(
    ("point", "times"),
    [
        ((15.0, 2.0), 3),  # nearer to the end than the growth threshold
        ((8.0, 2.0), 3),  # its foot point is not the end
        ((16.5, -2.0), 3),  # on the other side of the path
        ((25.0, 2.0), 3),  # beyond the path ahead
        ((16.5, 2.0), 2),  # not detected often enough
    ],
)
def test_a_detection_does_not_extend_the_curve(point: tuple[float, float], times: int) -> None:
    state = straight_rows()
    extended, _ = expanded(state, np.array([point]), times=times)
    assert extended == set()
    np.testing.assert_allclose(end_of(state), END, atol=1e-3)


def test_a_disputed_track_does_not_extend_the_curve() -> None:
    """The track has more detections with the label of the other boundary."""
    state = straight_rows()
    state.belief.mean[0], expansion, point = 10.0, Expansion(state.settings), np.array([[6.5, 2.0]])
    for k in range(3):
        expansion.observe(state, detections_of(point, np.array([LEFT]), 0.1 * k))
    for k in range(4):
        expansion.observe(state, detections_of(point, np.array([RIGHT]), 0.1 * k))
    path_ahead = path_along_x(10.0, state.settings)
    assert expansion.expand(state, detections_of(point), path_ahead, np.ones(1, bool)) == set()


def test_a_detection_that_updates_a_curve_does_not_expand_it() -> None:
    state = straight_rows()
    _, expansion = expanded(state, np.array([[16.5, 2.0]]), times=3, x=10.0)
    size, seen = state.curves[LEFT].size, detections_of(np.array([[13.0, 2.0]]))
    assert expansion.expand(state, seen, path_along_x(10.0, state.settings), np.zeros(1, bool)) == set()
    assert state.curves[LEFT].size == size


def test_a_stranded_end_is_extended_beside_the_path() -> None:
    """The vehicle has passed the end without any detection."""
    state = straight_rows()
    extended, _ = expanded(state, np.zeros((0, 2)), x=16.0)
    assert extended == {LEFT, RIGHT}
    np.testing.assert_allclose(end_of(state), [16.0 - CARRIED_TO, 2.0], atol=0.1)


def test_two_confirmed_tracks_begin_a_curve_and_one_does_not() -> None:
    for count, curves in ((1, 0), (2, 1)):
        state = CurveState(Belief(np.zeros(3), 1e-4 * np.eye(3)), MapperSettings())
        extended, _ = expanded(state, np.array([[4.0, -2.0], [8.0, -2.0]])[:count], x=0.0, label=RIGHT)
        assert extended == set() and len(state.curves) == curves
    ends = state.spline(RIGHT).evaluate(np.array([0.0, 4.0]))
    np.testing.assert_allclose(ends, [[4.0, -2.0], [8.0, -2.0]], atol=1e-3)


def test_each_confirmed_cone_is_observed_once() -> None:
    _, expansion = expanded(straight_rows(), np.array([[16.5, 2.0], [18.5, 2.0]]), times=6)
    assert len(expansion.observed[LEFT]) == 2 and len(expansion.observed[RIGHT]) == 0
    np.testing.assert_allclose(
        np.sort(np.array([*expansion.observed[LEFT].values()])[:, 0]), [16.5, 18.5], atol=1e-9
    )
