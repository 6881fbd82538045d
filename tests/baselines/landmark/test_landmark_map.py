"""Landmarks in the engine: rows, marginalization, merged graphs and labels, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.landmark_map import LandmarkState
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, merge_variables, normal_equations
from pathspace_graph.graph.variables import landmark_keys, sizes
from pathspace_graph.labels import LEFT, RIGHT

from ...scenes.digest import digest
from ...scenes.jacobians import assert_jacobians
from .scenes import CONES, LABELS, QUADRATIC, SPEED, drive_on, driven

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def test_rows_are_the_derivatives_of_their_residuals() -> None:
    smoother = driven(4)
    variables, track = smoother.variables, smoother.map

    def whitened(x: Array) -> tuple[Array, Array]:
        variables.values = x
        groups = track.rows(np.arange(1, 4))
        residual = np.concatenate([rows.residual for rows in groups])
        dense = [_dense(rows.columns(variables.layout), rows.jacobian, len(x)) for rows in groups]
        return residual, np.concatenate(dense)

    x = variables.values + np.random.default_rng(0).normal(0.0, 0.3, len(variables.values))
    assert len(whitened(x)[0]) == 2 * 3 * len(CONES)  # the first cycle was not asked for
    assert_jacobians(whitened, [x])


def test_the_last_steps_covariance_is_the_inverse_of_its_system() -> None:
    """It is the covariance of the step, even after the window has moved on."""
    smoother = driven(4)
    layout, keys = smoother.layout, smoother.map.state.keys[[3, 1]]
    hessian, _ = normal_equations(smoother.linear_graph(), layout)
    smoother.step()  # nearly nothing moves
    drive_on(smoother, 4, (SPEED, 0.0, 0.0))
    entries = layout.entries(keys)
    expected = np.linalg.inv(hessian)[np.ix_(entries, entries)]
    np.testing.assert_allclose(smoother.last_covariance(keys), expected, rtol=1e-6)


def test_marginalized_poses_take_no_information_with_them() -> None:
    """With a short lag the map is that of the whole drive, except for the earlier linearization points."""
    whole, short = driven(25), driven(25, replace(QUADRATIC, lag=0.5))
    assert len(short.times) == 6
    np.testing.assert_allclose(short.map.state.landmarks, whole.map.state.landmarks, atol=3e-3)
    keys = whole.map.state.keys
    expected = whole.last_covariance(keys)
    np.testing.assert_allclose(short.last_covariance(keys), expected, atol=0.03 * expected.max())


def test_a_merged_graph_has_the_error_of_the_old_one_where_both_are_one() -> None:
    rng, keys = np.random.default_rng(2), landmark_keys(np.arange(4))
    gone, kept, offset = keys[[3, 1]], keys[[0, 2]], rng.normal(0.0, 1.0, 4)
    factors = [_random(rng, of) for of in (keys[[0, 3]], keys[[1, 2, 3]], keys[[0, 1, 2]])]
    old, new = graph_of(*factors), merge_variables(graph_of(*factors), gone, kept, offset)
    raised = []
    for _ in range(5):
        known = {int(key): rng.normal(0.0, 3.0, 2) for key in kept}
        at_new = _vectors(known)
        for key, same, apart in zip(gone.tolist(), kept.tolist(), offset.reshape(-1, 2), strict=True):
            known[key] = known[same] + apart
        old_error = old.error(_vectors(known))
        raised.append(new.error(at_new) - old_error)
    np.testing.assert_allclose(raised, raised[0], atol=1e-9 * old_error)  # a constant does not matter


def test_a_key_that_the_graph_does_not_hold_merges_into_nothing() -> None:
    keys = landmark_keys(np.arange(3))
    graph = graph_of(_random(np.random.default_rng(3), keys[:2]))
    hessian, vector = graph.hessian(gtsam.Ordering(keys[:2].tolist()))
    found = merge_variables(graph, keys[2:], keys[:1], np.ones(2)).hessian(gtsam.Ordering(keys[:2].tolist()))
    np.testing.assert_allclose(found[0], hessian, atol=1e-9)
    np.testing.assert_allclose(found[1], vector, atol=1e-9)


@pytest.mark.parametrize("observed", [2, 0])
def test_a_landmark_has_the_label_of_most_of_its_detections(observed: int) -> None:
    state = LandmarkState()
    state.next_number = 10 * observed  # numbers, not positions
    n = state.add(CONES, LABELS)
    state.vote(np.array([RIGHT, RIGHT, RIGHT]), n[[0, 0, 1]])
    np.testing.assert_array_equal(state.labels, [RIGHT, RIGHT, LEFT, RIGHT, LEFT])
    state.vote(np.array([LEFT, LEFT]), n[[0, 0]])
    assert state.labels[0] == RIGHT  # an equal count changes nothing
    state.vote(np.array([LEFT]), n[[0]])
    assert state.labels[0] == LEFT


def test_what_the_smoother_does_leaves_a_copy_of_its_map_as_it_was() -> None:
    smoother = driven(4)
    copy = smoother.map.copy()
    before = digest(copy)
    assert before == digest(smoother.map) and copy.state.variables is copy.variables
    drive_on(smoother, 4, (SPEED, 0.1, 0.05))
    smoother.map.state.vote(LABELS[:1], np.array([0]))
    smoother.map.detections.take(np.array([0]), np.array([4]))
    smoother.step()
    smoother.map.merge(np.array([4]), np.array([0]))
    smoother.marginalize()
    assert digest(copy) == before
    assert len(copy.state) == len(CONES) and len(smoother.map.state) == len(CONES) - 1


def _dense(columns: IntArray, jacobian: Array, size: int) -> Array:
    out = np.zeros((len(jacobian), size))
    np.add.at(out, (np.arange(len(jacobian))[:, None], columns), jacobian)
    return out


def _random(rng: np.random.Generator, keys: IntArray) -> gtsam.GaussianConditional:
    return jacobian_factor(keys, rng.normal(0.0, 1.0, (3, int(sizes(keys).sum()))), rng.normal(0.0, 1.0, 3))


def _vectors(values: dict[int, Array]) -> gtsam.VectorValues:
    out = gtsam.VectorValues()
    for key, value in values.items():
        out.insert(key, value)
    return out
