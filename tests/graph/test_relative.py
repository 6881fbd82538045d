"""Relative factors: a rigid motion changes nothing of them, and their linearization is exact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.gaussian import graph_of, normal_equations
from pathspace_graph.graph.inactive import RelativeFactor
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, Layout, Variables, control_keys, pose_key

NOTHING = np.zeros(0, np.intp)
KEYFRAME, END = pose_key(2), pose_key(6)
POINTS = np.append(control_keys(0, np.array([4, 5])), control_keys(1, np.array([2])))
KEYS = np.concatenate([[CALIBRATION_KEY], POINTS, [END]])
"""Of the random factor: calibration, three control points, and the end pose."""
SIZE = 2 + 2 * len(POINTS) + POSE
WHOLE = np.concatenate([[CALIBRATION_KEY], POINTS, [KEYFRAME, END]])
"""The same with the keyframe, ascending."""


def random_factor(rng: np.random.Generator) -> RelativeFactor:
    root, right = rng.normal(size=(SIZE + 2, SIZE)), rng.normal(size=SIZE + 2)
    return RelativeFactor(KEYFRAME, Layout(KEYS), root, right, rng.normal(size=SIZE))


def variables_at(x: Array, keys: IntArray, rng: np.random.Generator) -> Variables:
    """Values x away from their references."""
    variables = Variables()
    variables.insert(keys, x, x + rng.normal(size=len(x)))
    return variables


def seen_from(x: Array, keyframe: Array) -> Array:
    """Calibration, points and end pose as a keyframe sees them, written once more."""
    inverse = rotation(keyframe[2]).T
    points = x[2:-POSE].reshape(-1, 2)
    return np.concatenate(
        [
            x[:2],
            *(inverse @ (p - keyframe[:2]) for p in points),
            inverse @ (x[-POSE:-1] - keyframe[:2]),
            [x[-1] - keyframe[2]],
        ]
    )


def parts(x: Array) -> tuple[Array, Array]:
    """The factor's values, and the keyframe, of all values in the order of their keys."""
    return np.delete(x, np.arange(SIZE - POSE, SIZE)), x[SIZE - POSE : SIZE]


def energy(factor: RelativeFactor, x: Array) -> float:
    """`1/2 |A e - b|^2`."""
    left = factor.root @ (seen_from(*parts(x)) - factor.local) - factor.right
    return float(0.5 * left @ left)


def linearized(factor: RelativeFactor, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Hessian and negative gradient of the factor by all values, in the order of their keys."""
    variables = variables_at(x, WHOLE, rng)
    hessian, vector = normal_equations(graph_of(factor.factor(variables)), variables.layout)
    return hessian, vector - hessian @ (variables.values - variables.reference)


def moved(x: Array, theta: float, shift: Array) -> Array:
    """All values after a rigid motion of the map frame."""
    x = x.copy()
    for at in (*range(2, SIZE - POSE, 2), SIZE - POSE, SIZE):
        x[at : at + 2] = rotation(theta) @ x[at : at + 2] + shift
    x[[SIZE - 1, SIZE + 2]] += theta
    return x


@pytest.mark.parametrize("seed", range(5))
def test_a_factor_is_the_derivative_of_the_energy(seed: int) -> None:
    """Far from the factor's own point, at any heading, and whatever the references."""
    rng = np.random.default_rng(seed)
    factor, x = random_factor(rng), rng.normal(size=SIZE + POSE) * 3.0
    hessian, negative_gradient = linearized(factor, x, rng)
    steps = 1e-6 * np.eye(len(x))
    numeric = np.array([(energy(factor, x + h) - energy(factor, x - h)) / 2e-6 for h in steps])
    np.testing.assert_allclose(negative_gradient, -numeric, rtol=1e-6, atol=1e-5)
    differences = [seen_from(*parts(x + h)) - seen_from(*parts(x - h)) for h in steps]
    jacobian = factor.root @ np.array(differences).T / 2e-6
    np.testing.assert_allclose(hessian, jacobian.T @ jacobian, rtol=1e-6, atol=1e-5)


@given(st.integers(0, 1000), st.floats(-4.0, 4.0), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_a_rigid_motion_turns_the_gradient_and_keeps_the_energy(
    seed: int, theta: float, dx: float, dy: float
) -> None:
    rng = np.random.default_rng(seed)
    factor, x = random_factor(rng), rng.normal(size=SIZE + POSE)
    y = moved(x, theta, np.array([dx, dy]))
    assert energy(factor, y) == pytest.approx(energy(factor, x), rel=1e-8, abs=1e-8)
    before, after = linearized(factor, x, rng), linearized(factor, y, rng)
    rotations = np.eye(SIZE + POSE)
    for at in (*range(2, SIZE - POSE, 2), SIZE - POSE, SIZE):
        rotations[at : at + 2, at : at + 2] = rotation(theta)
    np.testing.assert_allclose(after[1], rotations @ before[1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(after[0], rotations @ before[0] @ rotations.T, rtol=1e-8, atol=1e-8)


def test_a_factor_leaves_a_rigid_motion_free() -> None:
    """Three directions without information: both shifts and the turn."""
    rng = np.random.default_rng(0)
    hessian, _ = linearized(random_factor(rng), rng.normal(size=SIZE + POSE), rng)
    values = np.linalg.eigvalsh(hessian)
    assert values[2] < 1e-10 * values[-1] < values[3]
