"""The one helper that holds every Jacobian of the project against central differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Retraction = Callable[[Array, Array], Array]

STEP = 1e-5
"""Half of the difference's width, in the units of the input: truncation and round-off are near 1e-10."""
TOLERANCE = 1e-6
"""Largest |analytic - numeric|, as a share of 1 + the largest entry of the numeric Jacobian."""


def plus(point: Array, delta: Array) -> Array:
    """The retraction of a vector space."""
    return point + delta


def numeric_jacobian(
    residual: Callable[[Array], Array], point: Array, retract: Retraction = plus, step: float = STEP
) -> Array:
    """`(r(x + h e_j) - r(x - h e_j)) / 2 h` column by column: (m, d), d the size of the point."""
    columns = []
    for j in range(point.size):
        delta = np.zeros(point.size)
        delta[j] = step
        columns.append((residual(retract(point, delta)) - residual(retract(point, -delta))) / (2.0 * step))
    return np.stack(columns, axis=1)


def assert_jacobians(
    function: Callable[..., Sequence[Array]],
    inputs: Sequence[Array],
    retractions: Sequence[Retraction] | None = None,
    step: float = STEP,
    tolerance: float = TOLERANCE,
) -> None:
    """Every Jacobian of `function(*inputs) -> residual (m,), J_1 (m, d_1), J_2, ...`, one for each input.

    inputs are flat arrays (d_i,); retractions tell how a tangent is added to each (a sum by default).
    """
    retractions = retractions or [plus] * len(inputs)
    residual, *jacobians = function(*inputs)
    assert len(jacobians) == len(inputs) == len(retractions)
    for i, (analytic, retract) in enumerate(zip(jacobians, retractions, strict=True)):

        def moved(value: Array, i: int = i) -> Array:
            return np.asarray(function(*inputs[:i], value, *inputs[i + 1 :])[0])

        numeric = numeric_jacobian(moved, inputs[i], retract, step)
        assert analytic.shape == (len(residual), inputs[i].size), f"shape of the Jacobian by input {i}"
        assert np.isfinite(analytic).all(), f"Jacobian by input {i} is not finite"
        worst = np.abs(analytic - numeric).max(initial=0.0)
        allowed = tolerance * (1.0 + np.abs(numeric).max(initial=0.0))
        assert worst <= allowed, f"Jacobian by input {i} is off by {worst:.3g}, allowed {allowed:.3g}"
