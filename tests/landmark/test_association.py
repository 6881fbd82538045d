"""Gates, assignment, colours: on costs whose best assignment is known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.landmark.association import (
    UNASSOCIATED,
    Gates,
    associate,
    compatible,
    hysteresis_costs,
    pair_costs,
    squared_mahalanobis,
)

Array = NDArray[np.float64]

GATES = Gates.of(LandmarkSettings())


def test_gates_are_those_of_two_degrees_of_freedom() -> None:
    """`P(d^2 < x) = 1 - exp(-x / 2)`."""
    assert pytest.approx(-2.0 * np.log(0.05)) == GATES.match
    assert pytest.approx(-2.0 * np.log(0.01)) == GATES.create


def test_the_assignment_is_the_best_of_all_not_each_readings_own() -> None:
    cost = np.array([[1.0, 2.0], [1.5, 5.5]])  # greedy would take 1.0 and leave 5.5
    np.testing.assert_array_equal(associate(cost, GATES).landmark, [1, 0])


def test_a_bad_pair_is_not_taken_to_save_another() -> None:
    cost = np.array([[0.5, 50.0], [0.1, 50.0]])
    found = associate(cost, GATES)
    np.testing.assert_array_equal(found.landmark, [UNASSOCIATED, 0])


def test_between_the_gates_nothing_is_said() -> None:
    between = 0.5 * (GATES.match + GATES.create)
    found = associate(np.array([[between, 99.0], [99.0, 99.0], [99.0, 1.0]]), GATES)
    np.testing.assert_array_equal(found.landmark, [UNASSOCIATED, UNASSOCIATED, 1])
    np.testing.assert_array_equal(found.new, [False, True, False])


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_nothing_to_associate(shape: tuple[int, int]) -> None:
    found = associate(np.zeros(shape), GATES)
    np.testing.assert_array_equal(found.landmark, np.full(shape[0], UNASSOCIATED))
    assert found.new.all()


@given(arrays(float, (4, 5), elements=st.floats(0.0, 20.0) | st.just(np.inf)))
def test_it_is_one_to_one_and_inside_the_gate(cost: Array) -> None:
    found = associate(cost, GATES)
    matched = np.flatnonzero(found.landmark != UNASSOCIATED)
    assert len(np.unique(found.landmark[matched])) == len(matched)
    assert (cost[matched, found.landmark[matched]] < GATES.match).all()
    assert not found.new[matched].any()


def test_an_unknown_colour_may_be_either() -> None:
    may_be = compatible(np.array([LEFT, RIGHT, UNKNOWN]), np.array([LEFT, RIGHT]))
    np.testing.assert_array_equal(may_be, [[True, False], [False, True], [True, True]])


def test_a_held_pair_stays_as_long_as_it_passes_the_wide_gate() -> None:
    between = 0.5 * (GATES.match + GATES.create)
    cost = np.array([between, between, GATES.create + 1.0, 1.0])
    held = np.array([True, False, True, True])
    kept = hysteresis_costs(cost, held, GATES)
    np.testing.assert_array_equal(kept < GATES.match, [True, False, False, True])
    np.testing.assert_array_equal(kept[1:], cost[1:])


def test_distances_are_those_of_the_summed_covariance() -> None:
    rng = np.random.default_rng(0)
    points, predicted = rng.normal(0.0, 5.0, (3, 2)), rng.normal(0.0, 5.0, (4, 2))
    roots = rng.normal(0.0, 1.0, (7, 2, 2)) + 2.0 * np.eye(2)
    covariances = roots @ np.swapaxes(roots, 1, 2)
    found = pair_costs(points, covariances[:3], predicted, covariances[3:])
    for i in range(3):
        for j in range(4):
            r = predicted[j] - points[i]
            expected = r @ np.linalg.solve(covariances[i] + covariances[3 + j], r)
            assert found[i, j] == pytest.approx(expected)
    assert squared_mahalanobis(np.array([3.0, 4.0]), np.eye(2)) == pytest.approx(25.0)


def test_a_held_pair_is_kept_however_its_assignment_is_summed() -> None:
    """At the very edge of the gate, alone or beside a reading of nothing, in any order."""
    gates = Gates(6.0, 9.0)
    cost = np.array([[np.inf, np.inf], [7.0, np.inf]])
    for own, expected in (
        (cost, [UNASSOCIATED, 0]),
        (cost[::-1], [0, UNASSOCIATED]),
        (cost[:, ::-1], [UNASSOCIATED, 1]),
    ):
        held = np.isfinite(own)
        assert associate(hysteresis_costs(own, held, gates), gates).landmark.tolist() == expected
