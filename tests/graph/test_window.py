"""The window's factors: which of them a relinearization replaces, and what it leaves as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.factors._kernels import RowStore
from pathspace_graph.factors.arrays import IntArray
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.sensor import SENSOR, SENSOR_SIZE
from pathspace_graph.graph.gaussian import graph_of, normal_equations
from pathspace_graph.graph.rows import Rows, newton_system
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POSE,
    SENSOR_KEY,
    control_keys,
    pose_key,
    pose_keys,
)
from pathspace_graph.graph.window import WindowFactors

from ..scenes.graph import dense_rows, rows_in
from ..scenes.linear_drive import LinearTrack

CYCLES = np.arange(4)
TOLERANCE_POINT, TOLERANCE_HEADING = 0.1, 0.01
ACTIVE: IntArray = np.zeros(0, np.intp)
"""No variable is inactive."""


class Track(LinearTrack):
    """A linear track whose detections in use can change."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.changed_cycles: list[int] = []
        self.weight = 1.0
        """Factor of the rows, by which those that are made later are told from those that were kept."""

    def rows(self, cycles: IntArray) -> list[Rows]:
        return self._weighed(super().rows(cycles))

    def _weighed(self, groups: Sequence[Rows]) -> list[Rows]:
        by = self.weight
        return [replace(rows, jacobian=by * rows.jacobian, residual=by * rows.residual) for rows in groups]

    def changed(self) -> IntArray:
        return np.array(self.changed_cycles, np.intp)

    def linearized(self, cycles: IntArray) -> None:
        self.changed_cycles = []


def make_window(seed: int = 0, kind: type[Track] = Track) -> WindowFactors[Track]:
    """Returns a window of four poses and six map points, all of whose factors are linearized."""
    rng = np.random.default_rng(seed)
    track = kind(seed)
    track.variables.insert(np.array([CALIBRATION_KEY]), rng.normal(size=2))
    if kind is SensorTrack:
        track.variables.insert(np.array([SENSOR_KEY]), np.zeros(SENSOR_SIZE))
    track.variables.insert(control_keys(0, np.arange(6)), rng.normal(size=12))
    track.variables.insert(pose_keys(CYCLES), rng.normal(size=POSE * len(CYCLES)))
    window = WindowFactors(track, (TOLERANCE_POINT, TOLERANCE_HEADING))
    for _ in CYCLES[1:]:
        twists = rng.normal(size=(3, POSE))
        window.odometry.append(integrate_twists(np.full(3, 0.1), twists, np.array([0.2, 0.1, 0.05])))
    assert window.relinearize(CYCLES, ACTIVE)
    return window


def new_owners(rows: RowStore, before: dict[int, float]) -> list[int]:
    """Returns the owners whose rows were made since."""
    return [owner for owner, size in sizes_of(rows).items() if before.get(owner) != size]


def sizes_of(kept: RowStore) -> dict[int, float]:
    """Returns the sum of the absolute derivatives of each owner's rows; then later rows weigh more."""
    owners = np.unique(np.concatenate([rows.owner for rows in rows_in(kept)])).tolist()
    return {
        owner: sum(float(np.abs(rows.jacobian[rows.owner == owner]).sum()) for rows in rows_in(kept))
        for owner in owners
    }


def mark(window: WindowFactors[Track]) -> dict[int, float]:
    """Returns the rows of the cycles as they are; those that are made later weigh more."""
    window.map.weight = 2.0
    return sizes_of(window.measured)


def move(window: WindowFactors[Track], key: int, entry: int, size: float) -> None:
    variables = window.variables
    variables.values[variables.layout.columns(np.array([key]))[0] + entry] += size


def holding(kept: RowStore, key: int) -> list[int]:
    return np.unique(kept.holding(np.array([key]))).tolist()


def assert_linearized_at_the_values(window: WindowFactors[Track]) -> None:
    """The window's normal equations are those of dense rows at the current values."""
    variables, track = window.variables, window.map
    groups = [
        *track.rows(CYCLES),
        *window.odometry.rows(variables, CYCLES),
    ]
    J, r, _ = dense_rows(groups, variables.keys)
    now = variables.values - variables.reference
    hessian, gradient = newton_system(graph_of(), window.measured, variables.layout, now)
    np.testing.assert_allclose(np.tril(hessian), np.tril(J.T @ J), atol=1e-9 * np.abs(hessian).max())
    np.testing.assert_allclose(gradient, -J.T @ r, atol=1e-8 * np.abs(J.T @ J @ now).max())


def test_the_first_linearization_makes_every_factor() -> None:
    window = make_window()
    assert list(sizes_of(window.measured)) == CYCLES.tolist()
    assert_linearized_at_the_values(window)


def test_a_factor_is_kept_while_nothing_moves_by_more_than_the_tolerance() -> None:
    window = make_window()
    before = mark(window)
    for key, entry, size in (
        (pose_key(1), 0, 0.9 * TOLERANCE_POINT),
        (pose_key(2), POSE - 1, -0.9 * TOLERANCE_HEADING),
        (int(control_keys(0, np.array(2))), 1, 0.9 * TOLERANCE_POINT),
    ):
        move(window, key, entry, size)
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == []


@pytest.mark.parametrize(
    ("entry", "size"),
    [(0, 1.1 * TOLERANCE_POINT), (1, -1.1 * TOLERANCE_POINT), (POSE - 1, 1.1 * TOLERANCE_HEADING)],
)
def test_a_moved_pose_makes_its_own_cycle_stale_and_the_one_whose_odometry_leads_to_it(
    entry: int, size: float
) -> None:
    window = make_window()
    before = mark(window)
    move(window, pose_key(2), entry, size)
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == [1, 2]


def test_a_moved_point_makes_the_cycles_stale_that_hold_it() -> None:
    window, key = make_window(), int(control_keys(0, np.array(2)))
    before = mark(window)
    move(window, key, 0, 1.1 * TOLERANCE_POINT)
    assert window.relinearize(CYCLES, ACTIVE)
    assert 0 < len(new_owners(window.measured, before)) < len(CYCLES)
    assert new_owners(window.measured, before) == holding(window.measured, key)


def test_small_motions_add_up_until_the_tolerance_is_passed() -> None:
    """The distance counts from the last linearization, and not from the last call."""
    window = make_window()
    before = mark(window)
    for expected in ([], [], [0]):
        move(window, pose_key(0), 0, 0.4 * TOLERANCE_POINT)
        assert window.relinearize(CYCLES, ACTIVE)
        assert new_owners(window.measured, before) == expected


def test_the_cycle_whose_odometry_came_last_gets_a_row_on_it_though_nothing_moves() -> None:
    window, rng = make_window(), np.random.default_rng(1)
    before = mark(window)
    window.extend(
        3, integrate_twists(np.full(3, 0.1), rng.normal(size=(3, POSE)), np.array([0.2, 0.1, 0.05]))
    )
    window.variables.insert(control_keys(0, np.array([6])), rng.normal(size=2))
    window.variables.insert(pose_keys(np.array([4])), rng.normal(size=POSE))
    assert window.relinearize(np.arange(5), ACTIVE)
    assert new_owners(window.measured, before) == [3, 4]
    assert holding(window.measured, pose_key(4)) == [3, 4]


def test_the_calibration_never_makes_a_factor_stale() -> None:
    """Every row is linear in it."""
    window = make_window()
    before = mark(window)
    move(window, CALIBRATION_KEY, 0, 100.0)
    window.exact = True
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == []
    window.map.weight = 1.0
    assert_linearized_at_the_values(window)


class SensorTrack(Track):
    """A track that a sensor sees whose calibration is estimated: each cycle has a row on it."""

    def rows(self, cycles: IntArray) -> list[Rows]:
        keys = np.column_stack([np.full(len(cycles), SENSOR_KEY), pose_keys(cycles)])
        of_sensor = Rows(keys, np.ones((len(keys), SENSOR_SIZE + POSE)), np.zeros(len(keys)), cycles)
        return [*super().rows(cycles), *self._weighed([of_sensor])]


@pytest.mark.parametrize(("moved", "stale"), [(0.9, []), (1.1, CYCLES.tolist())])
def test_a_turn_of_the_sensor_makes_rows_stale_that_moves_a_point_10_m_away_by_the_tolerance(
    moved: float, stale: list[int]
) -> None:
    window = make_window(kind=SensorTrack)
    before = mark(window)
    move(window, SENSOR_KEY, SENSOR.index("yaw"), moved * TOLERANCE_POINT / 10.0)
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == stale


def test_an_exact_window_relinearizes_after_any_motion() -> None:
    window = make_window()
    before = mark(window)
    move(window, pose_key(3), 0, 1e-12)
    window.exact = True
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == [2, 3]
    window.variables.values += 1.0
    assert window.relinearize(CYCLES, ACTIVE)
    assert_linearized_at_the_values(window)


def test_other_detections_make_their_own_cycle_stale() -> None:
    window = make_window()
    before = mark(window)
    window.map.changed_cycles = [1]
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == [1]
    assert window.map.changed_cycles == []


def test_only_moved_variables_get_another_linearization_point() -> None:
    window = make_window()
    variables = window.variables
    point = variables.linearized.copy()
    move(window, pose_key(1), 0, 2.0 * TOLERANCE_POINT)
    move(window, pose_key(3), 0, 0.5 * TOLERANCE_POINT)
    assert window.relinearize(CYCLES, ACTIVE)
    moved = variables.layout.entries(pose_keys(np.array([1])))
    point[moved] = variables.values[moved]
    np.testing.assert_array_equal(variables.linearized, point)


def on_an_inactive_point(window: WindowFactors[Track]) -> IntArray:
    """A stale cycle sees a point that is inactive."""
    move(window, pose_key(1), 0, 1.0)
    return control_keys(0, np.arange(6))


def beyond_the_active_map(window: WindowFactors[Track]) -> IntArray:
    """The map says that a row should be on a point that is inactive."""
    move(window, pose_key(1), 0, 1.0)
    window.map.reached_inactive = True
    return ACTIVE


@pytest.mark.parametrize("reach", [on_an_inactive_point, beyond_the_active_map])
def test_nothing_changes_where_a_row_needs_an_inactive_variable(
    reach: Callable[[WindowFactors[Track]], IntArray],
) -> None:
    window = make_window()
    before, point = mark(window), window.variables.linearized.copy()
    inactive = reach(window)
    assert not window.relinearize(CYCLES, inactive)
    assert new_owners(window.measured, before) == []
    np.testing.assert_array_equal(window.variables.linearized, point)


def test_fresh_factors_are_at_the_values_and_leave_the_kept_ones_alone() -> None:
    window = make_window()
    before = mark(window)
    window.variables.values += 0.5 * TOLERANCE_HEADING
    fresh = normal_equations(graph_of(*window.fresh(CYCLES)), window.variables.layout)
    assert new_owners(window.measured, before) == []
    window.exact = True
    assert window.relinearize(CYCLES, ACTIVE)
    variables = window.variables
    now = variables.values - variables.reference
    hessian, gradient = newton_system(graph_of(), window.measured, variables.layout, now)
    scale = np.abs(hessian).max()
    np.testing.assert_allclose(np.tril(fresh[0]), np.tril(hessian), atol=1e-9 * scale)
    np.testing.assert_allclose(fresh[1] - fresh[0] @ now, gradient, atol=1e-9 * scale)


def test_dropped_factors_are_made_again() -> None:
    window = make_window()
    before = mark(window)
    window.drop(np.array([pose_key(0)]))
    assert list(sizes_of(window.measured)) == [1, 2, 3]
    assert window.relinearize(CYCLES, ACTIVE)
    assert new_owners(window.measured, before) == [0]
    window.clear()
    assert not window.measured.parts()
    window.map.weight = 1.0
    assert window.relinearize(CYCLES, ACTIVE)
    assert list(sizes_of(window.measured)) == CYCLES.tolist()
    assert_linearized_at_the_values(window)
