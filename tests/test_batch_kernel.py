"""Robust losses: their weights are their derivatives, and a reading at the gate says nothing."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.batch_kernel import Biweight, Kernel

KERNELS = [Kernel(gate=3.0, huber=1.5), Biweight(4.0)]


@pytest.mark.parametrize("kernel", KERNELS, ids=["huber", "biweight"])
def test_the_weight_is_the_slope_of_the_loss(kernel: Kernel) -> None:
    z = np.linspace(-6.0, 6.0, 42)
    h = 1e-5
    slope = (kernel.loss(z + h) - kernel.loss(z - h)) / (2.0 * h)
    np.testing.assert_allclose(kernel.weights(z) * z, slope, atol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS, ids=["huber", "biweight"])
def test_near_zero_the_loss_is_half_the_square(kernel: Kernel) -> None:
    z = np.array([-0.01, 0.0, 0.01])
    np.testing.assert_allclose(kernel.loss(z), 0.5 * z**2, rtol=1e-4)
    np.testing.assert_allclose(kernel.ceiling, kernel.loss(np.array([kernel.gate]))[0])


def test_beyond_the_gate_the_biweight_is_flat() -> None:
    kernel = Biweight(4.0)
    np.testing.assert_allclose(kernel.loss(np.array([4.0, 5.0, 50.0])), kernel.ceiling)
    np.testing.assert_array_equal(kernel.weights(np.array([-4.0, 4.0, 50.0])), 0.0)
    assert kernel.weights(np.array([3.99]))[0] < 1e-4
