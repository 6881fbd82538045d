"""Landmarks in the engine: rows, marginalization, merged graphs and labels, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.landmarks import LandmarkState
from pathspace_graph.labels import LEFT, RIGHT

from ...scenes.digest import digest
from ...scenes.jacobians import assert_jacobians
from .scenes import CONES, LABELS, SPEED, drive_on, driven

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
