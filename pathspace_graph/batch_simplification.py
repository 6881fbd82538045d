"""Simplification of the batch's curves: few knots for the map, nearly one for each cone for the optimum."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .batch_gating import associate, locate_poses
from .batch_knots import reknot
from .boundary import Boundary
from .knots import refit
from .readings import Readings
from .settings import MapperSettings
from .state import State

Array = NDArray[np.float64]


def simplified(
    state: State, covariance: Array, readings: Readings, settings: MapperSettings
) -> tuple[State, Array]:
    """The same poses beside curves on the knots that the cones ask for, and their joint covariance (n, n).

    `C_new = F C_old`, so `F Sigma F'` with the given covariance Sigma of the state's control points. Solved
    for on few knots, a curve would pass its cones by a decimetre on the same side in every lap, which no
    number of readings averages out: in the first seconds that turns the vehicle, and with it the whole map,
    by up to a degree, several times what its covariance says.
    """
    following = reknot(state, readings, settings)
    change = np.zeros((following.map_size, state.map_size))
    for label, boundary in state.boundaries.items():
        new, points = following.boundaries[label], following.control_points(label)
        refit = new_from_old(boundary, state.control_points(label), new, points)
        change[following.block(label), state.block(label)] = np.kron(refit, np.eye(2))
    locate_poses(following)
    associate(following, readings, settings, settings.batch.gate, strict=True)
    return following, change @ covariance[: state.map_size, : state.map_size] @ change.T


def new_from_old(old: Boundary, old_points: Array, new: Boundary, new_points: Array) -> Array:
    """F (m_new, m_old), least squares over points of the old curve and their foot points on the new one."""

    def foot_on_new(u: Array) -> Array:
        low, high = np.full(len(u), new.tables.low), np.full(len(u), new.tables.high)
        return new.find(new_points, old.evaluate(old_points, u), low, high).u

    return refit(old.spline(old_points), new.spline(new_points), foot_on_new).new_from_old
