"""Relative factors: derivatives of an energy that a rigid motion does not change."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse
from pathspace_graph.graph.gaussian import graph_of, keys_of, normal_equations
from pathspace_graph.graph.relative import RelativeFactor, from_frame, relative_factor, to_frame
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    ORIGIN_KEY,
    POSE,
    Layout,
    Variables,
    control_keys,
    pose_key,
)

from ..scenes.graph import random_graph

FRAME = pose_key(4)
KEYS = np.array([CALIBRATION_KEY, *control_keys(0, np.arange(2)), pose_key(2), pose_key(7)])
"""Calibration, two control points, and a pose before and after that of the frame."""
ALL = np.sort(np.append(KEYS, FRAME))
SIZE = Layout(KEYS).size


def variables_at(x: Array, rng: np.random.Generator) -> Variables:
    """Values x of all keys, away from their references."""
    variables = Variables()
    variables.insert(ALL, x, x + rng.normal(size=len(x)))
    return variables


def energy(factor: RelativeFactor, x: Array) -> float:
    """`1/2 |A e - b|^2` by GTSAM-free poses: each is composed with the inverse of the frame's."""
    layout = Layout(ALL)
    frame = inverse(x[layout.entries(np.array([FRAME]))])
    local = [x[:2]]
    for key in KEYS[1:]:
        value = x[layout.entries(np.array([key]))]
        local.append(compose(frame, np.append(value, 0.0))[:2] if len(value) == 2 else compose(frame, value))
    left = factor.root @ (np.concatenate(local) - factor.local) - factor.right
    return float(0.5 * left @ left)


def random_factor(rng: np.random.Generator) -> RelativeFactor:
    root, right = rng.normal(size=(SIZE + 1, SIZE)), rng.normal(size=SIZE + 1)
    return RelativeFactor(FRAME, Layout(KEYS), root, right, rng.normal(size=SIZE))


@pytest.mark.parametrize("seed", range(4))
def test_a_factor_is_the_derivative_of_the_energy_by_points_and_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor, x = random_factor(rng), rng.normal(size=SIZE + POSE) * 3.0
    variables = variables_at(x, rng)
    hessian, vector = normal_equations(graph_of(factor.factor(variables)), variables.layout)
    found = hessian @ (variables.values - variables.reference) - vector
    steps = 1e-6 * np.eye(len(x))
    numeric = [(energy(factor, x + h) - energy(factor, x - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(found, numeric, rtol=1e-6, atol=1e-5)
    assert np.linalg.matrix_rank(hessian, tol=1e-8) == len(x) - POSE


def test_a_frame_and_back() -> None:
    rng = np.random.default_rng(5)
    values, frame, keys = rng.normal(size=SIZE), rng.normal(size=POSE) * 4.0, Layout(KEYS)
    np.testing.assert_allclose(from_frame(to_frame(values, frame, keys), frame, keys), values, atol=1e-12)


def test_a_graph_is_the_same_factor_where_the_frame_is_held() -> None:
    """Hessian and gradient by all other variables, at the values of the linearization."""
    rng = np.random.default_rng(6)
    x = rng.normal(size=SIZE + POSE)
    variables = variables_at(x, rng)
    graph, *_ = random_graph(rng, [ALL], ALL)
    own = variables.layout.entries(np.array([FRAME]))
    pose, reference = variables.values[own], variables.reference[own]
    factor = relative_factor(graph, FRAME, pose, reference, variables)
    rest = np.setdiff1d(np.arange(len(x)), own)
    change = variables.values - variables.reference
    systems = [normal_equations(one, variables.layout) for one in (graph, graph_of(factor.factor(variables)))]
    (H, g), (found, vector) = systems
    np.testing.assert_allclose(found[np.ix_(rest, rest)], H[np.ix_(rest, rest)], atol=1e-9 * np.abs(H).max())
    np.testing.assert_allclose(
        (found @ change - vector)[rest], (H @ change - g)[rest], atol=1e-8 * np.abs(H).max()
    )


def test_the_origin_does_not_move() -> None:
    """A factor on the origin is an absolute factor on all others."""
    rng = np.random.default_rng(7)
    keys = np.array([CALIBRATION_KEY, *control_keys(0, np.arange(2)), ORIGIN_KEY])
    layout, variables = Layout(keys), Variables()
    root = rng.normal(size=(layout.size, layout.size))
    factor = RelativeFactor(FRAME, layout, root, np.zeros(len(root)), rng.normal(size=layout.size))
    variables.insert(keys[:-1], rng.normal(size=6))
    variables.insert(np.array([FRAME]), rng.normal(size=POSE))
    variables.insert(keys[-1:], np.zeros(POSE))
    graph = graph_of(factor.factor(variables))
    held = keys_of(graph)
    assert held.tolist() == [*keys[:-1].tolist(), FRAME]
    hessian, _ = normal_equations(graph, Layout(held))
    assert np.linalg.eigvalsh(hessian)[0] > 1e-9
