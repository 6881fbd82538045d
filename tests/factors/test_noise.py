"""Whitening and Huber's loss, by hand and by what defines them."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.noise import huber_loss, huber_roots, huber_weights, whiteners


def test_huber_weights_bound_the_pull_of_a_row() -> None:
    """Weight times residual is the derivative of Huber's loss: the residual itself, then the threshold."""
    z = np.array([-50.0, -1.5, -0.2, 0.0, 1.0, 1.5, 2.0, 1e6])
    np.testing.assert_allclose(huber_weights(z, 1.5) * z, np.clip(z, -1.5, 1.5), rtol=1e-15)
    np.testing.assert_array_equal(huber_weights(z, np.inf), 1.0)


def test_hubers_loss_by_hand() -> None:
    """With threshold 2: z^2 / 2 up to 2, and 2 (|z| - 1) beyond."""
    z = np.array([0.0, 1.0, -2.0, 5.0, -101.0])
    np.testing.assert_allclose(huber_loss(z, 2.0), [0.0, 0.5, 2.0, 8.0, 200.0], rtol=1e-15)
    np.testing.assert_allclose(huber_loss(z, np.inf), 0.5 * z**2, rtol=1e-15)


@pytest.mark.parametrize("threshold", [1.5, np.inf])
def test_huber_roots_have_the_loss_as_half_their_squares(threshold: float) -> None:
    z = np.array([-4.0, -1.0, 0.0, 1.5, 100.0])
    roots = huber_roots(z, threshold)
    np.testing.assert_allclose(0.5 * roots**2, huber_loss(z, threshold), rtol=1e-14)
    np.testing.assert_array_equal(np.sign(roots), np.sign(z))


def test_whitened_rows_are_independent_and_of_unit_variance() -> None:
    rng = np.random.default_rng(2)
    roots = rng.normal(0.0, 1.0, (50, 2, 2)) + np.eye(2)
    covariances = roots @ np.swapaxes(roots, 1, 2)
    w = whiteners(covariances)
    whitened = w @ covariances @ np.swapaxes(w, 1, 2)
    np.testing.assert_allclose(whitened, np.tile(np.eye(2), (50, 1, 1)), atol=1e-8)
