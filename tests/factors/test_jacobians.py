"""The helper that checks Jacobians passes right ones and fails on wrong ones."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array

from ..scenes.jacobians import assert_jacobians


def bearing_and_range(a: Array, b: Array, error: float = 0.0) -> tuple[Array, Array, Array]:
    """Angle and length of b - a, with an error of one entry of the second Jacobian."""
    dx, dy = b - a
    square = dx * dx + dy * dy
    length = np.sqrt(square)
    by_b = np.array([[-dy / square, dx / square], [dx / length, dy / length]])
    wrong = by_b.copy()
    wrong[0, 1] += error
    return np.array([np.arctan2(dy, dx), length]), -by_b, wrong


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_a_right_jacobian_passes(scale: float) -> None:
    inputs = [scale * np.array([0.3, -0.2]), scale * np.array([1.5, 0.9])]
    assert_jacobians(bearing_and_range, inputs)


@pytest.mark.parametrize("error", [1e-4, -1.0, np.nan])
def test_a_wrong_entry_is_caught(error: float) -> None:
    with pytest.raises(AssertionError, match="Jacobian by input 1"):
        assert_jacobians(
            lambda a, b: bearing_and_range(a, b, error), [np.array([0.3, -0.2]), np.array([1.5, 0.9])]
        )


def test_a_wrong_sign_and_a_wrong_shape_are_caught() -> None:
    inputs = [np.array([0.3, -0.2]), np.array([1.5, 0.9])]

    def swapped(a: Array, b: Array) -> tuple[Array, Array, Array]:
        residual, by_a, by_b = bearing_and_range(a, b)
        return residual, by_b, by_a

    def broadcastable(a: Array, b: Array) -> tuple[Array, Array, Array]:
        residual, by_a, by_b = bearing_and_range(a, b)
        return residual, by_a, by_b[:1]

    with pytest.raises(AssertionError, match="Jacobian by input 0"):
        assert_jacobians(swapped, inputs)
    with pytest.raises(AssertionError, match="shape of the Jacobian by input 1"):
        assert_jacobians(broadcastable, inputs)


def test_a_tangent_is_added_by_the_retraction() -> None:
    """`x -> x exp(delta)`: the derivative of log x by delta is one, and of a sum it would be 1 / x."""

    def log(x: Array) -> tuple[Array, Array]:
        return np.log(x), np.ones((1, 1))

    assert_jacobians(log, [np.array([3.0])], [lambda x, delta: x * np.exp(delta)])
    with pytest.raises(AssertionError):
        assert_jacobians(log, [np.array([3.0])])
