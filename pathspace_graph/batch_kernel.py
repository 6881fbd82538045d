"""Robust losses of whitened residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import huber_weights

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Kernel:
    """Robust loss of a whitened residual: Huber's, constant beyond a gate."""

    gate: float
    """Beyond it a reading isn't used, and its loss is that at the gate."""
    huber: float
    """Beyond it the loss grows linearly only."""

    def loss(self, whitened: Array) -> Array:
        """`rho(z)` (m,), Huber's alone: the gate is what decides which rows are used."""
        inner = np.minimum(np.abs(whitened), self.huber)
        return np.asarray(inner * (np.abs(whitened) - 0.5 * inner))

    def weights(self, whitened: Array) -> Array:
        """`rho'(z) / z` (m,)."""
        return huber_weights(whitened, self.huber)

    @property
    def ceiling(self) -> float:
        """Loss of a reading that isn't used."""
        return float(self.loss(np.array([self.gate]))[0])


@dataclass(frozen=True)
class Biweight(Kernel):
    """Tukey's `rho(z) = g^2 / 6 (1 - (1 - z^2 / g^2)^3)`, constant beyond the gate g.

    A reading at the gate has no weight, so that one more or less of them moves nothing, as it would with
    Huber's loss and a hard gate.
    """

    huber: float = np.inf
    """Not used."""

    def loss(self, whitened: Array) -> Array:
        """`rho(z)` (m,)."""
        return np.asarray(self.gate**2 / 6.0 * (1.0 - self._inner(whitened) ** 3))

    def weights(self, whitened: Array) -> Array:
        """`(1 - z^2 / g^2)^2` (m,)."""
        return np.asarray(self._inner(whitened) ** 2)

    def _inner(self, whitened: Array) -> Array:
        return np.maximum(1.0 - (whitened / self.gate) ** 2, 0.0)
