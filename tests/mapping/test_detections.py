"""Tables of detections: built, appended, cut, chosen by cycle, and associated."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.baselines.landmarks import LandmarkDetections
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable

from ..scenes.drives import detections

TABLES = (DetectionTable, LandmarkDetections)


def cycle(*labels: int) -> Detections:
    """Returns a cycle whose k-th detection is at (k, 10 k)."""
    k = np.arange(len(labels), dtype=float)
    return detections(0.0, np.column_stack([k, 10.0 * k]), np.array(labels, np.intp))


CYCLES = [cycle(LEFT, RIGHT, UNKNOWN), cycle(), cycle(RIGHT), cycle(LEFT, LEFT)]


def assert_equal(one: DetectionColumns, other: DetectionColumns) -> None:
    for column in fields(one):
        mine, others = (np.asarray(getattr(table, column.name)) for table in (one, other))
        np.testing.assert_array_equal(mine, others)
        assert mine.dtype == others.dtype


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_appended_cycle_by_cycle_is_that_of_the_log(kind: type[DetectionColumns]) -> None:
    table = kind()
    rows = [table.append(one, 5 + k) for k, one in enumerate(CYCLES)]
    assert rows == [slice(0, 3), slice(3, 3), slice(3, 4), slice(4, 6)]
    assert_equal(table, kind.of(CYCLES, first=5))
    assert table.cycle.tolist() == [5, 5, 5, 7, 8, 8]
    np.testing.assert_array_equal(table.point[:, 0], [0.0, 1.0, 2.0, 0.0, 0.0, 1.0])
    assert not table.changed.any()


@pytest.mark.parametrize("kind", TABLES)
def test_cycles_before_one_are_cut_off(kind: type[DetectionColumns]) -> None:
    table = kind.of(CYCLES)
    table.keep_from(2)
    assert_equal(table, kind.of(CYCLES[2:], first=2))
    table.keep_from(9)
    assert_equal(table, kind())


@pytest.mark.parametrize("kind", TABLES)
def test_no_cycles_are_an_empty_table(kind: type[DetectionColumns]) -> None:
    assert_equal(kind.of([]), kind())
    assert len(kind.of([cycle()])) == 0


@given(st.sets(st.integers(0, 9)))
def test_detections_are_chosen_by_cycle(cycles: set[int]) -> None:
    table = DetectionTable.of([cycle(*[LEFT] * (k % 3)) for k in range(6)], first=2)
    wanted = np.array(sorted(cycles), np.intp)
    np.testing.assert_array_equal(table.in_cycles(wanted), [k in cycles for k in table.cycle.tolist()])


def test_an_association_is_taken_refined_and_released() -> None:
    table = DetectionTable.of(CYCLES)
    rows = np.array([1, 2])
    table.take(rows, RIGHT, np.array([4.0, 5.0]))
    assert table.used_on(RIGHT).tolist() == [1, 2] and table.used_on(LEFT).tolist() == []
    assert table.boundary.tolist() == [LEFT, RIGHT, RIGHT, RIGHT, LEFT, LEFT]
    assert np.flatnonzero(table.changed).tolist() == [1, 2]
    table.mark_linearized()
    table.refine(rows, np.array([4.5, 5.5]))
    assert table.u[rows].tolist() == [4.5, 5.5] and not table.changed.any()
    table.release(rows)
    assert not table.used.any() and np.flatnonzero(table.changed).tolist() == [1, 2]
    np.testing.assert_array_equal(table.boundary, table.label)


def test_which_rows_a_boundary_may_have() -> None:
    """Row 2 has no colour; where RIGHT uses it, LEFT is still tested for it, since both may accept it."""
    table = DetectionTable.of(CYCLES)
    assert table.pending(LEFT).tolist() == [0, 4, 5]
    table.take(np.array([2, 4]), np.array([RIGHT, LEFT]), np.zeros(2))
    assert table.pending(LEFT).tolist() == [0, 5]
    rows, curve = table.open_to(np.array([LEFT, RIGHT]), np.zeros(2, np.intp))
    assert rows[curve == 0].tolist() == [0, 2, 5]
    assert rows[curve == 1].tolist() == [1, 3]
    assert table.open_to(np.array([LEFT]), np.array([1]))[0].tolist() == [2, 5]


def test_landmarks_that_are_merged_give_their_detections() -> None:
    table = LandmarkDetections.of(CYCLES)
    assert not table.used.any()
    table.take(np.array([0, 4, 5]), np.array([7, 8, 9]))
    table.merge(np.array([8]), np.array([7]))
    assert table.landmark[[0, 4, 5]].tolist() == [7, 7, 9]
    assert np.flatnonzero(table.used).tolist() == [0, 4, 5]


@pytest.mark.parametrize("kind", TABLES)
def test_late_detections_stand_behind_those_of_their_cycle(kind: type[DetectionColumns]) -> None:
    """The table is that of the log in which the cycle had them from the first."""
    table = kind.of(CYCLES)
    assert table.append(cycle(UNKNOWN, LEFT), 2) == slice(4, 6)
    assert table.cycle.tolist() == [0, 0, 0, 2, 2, 2, 3, 3]
    assert table.label.tolist() == [LEFT, RIGHT, UNKNOWN, RIGHT, UNKNOWN, LEFT, LEFT, LEFT]
    assert table.append(cycle(RIGHT), 1) == slice(3, 4)
    assert table.cycle.tolist() == [0, 0, 0, 1, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("column", ["boundary", "u", "used", "station", "changed"])
def test_associations_of_a_copy_change_alone(column: str) -> None:
    table = DetectionTable.of(CYCLES)
    other, known = table.copy(), getattr(table, column).copy()
    getattr(other, column)[:] = known == 0
    assert (getattr(other, column) != known).any()
    np.testing.assert_array_equal(getattr(table, column), known)


def test_points_of_lines_are_no_cones() -> None:
    labels = np.array([LEFT, RIGHT, UNKNOWN, RIGHT])
    cycle = Detections(0.0, np.arange(8.0).reshape(4, 2), np.tile(np.eye(2), (4, 1, 1)), labels)
    table = DetectionColumns.of([cycle])
    assert len(table.cones(True)) == 0
    assert table.cones(False) is table
