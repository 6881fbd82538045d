"""The place factor: a detection's distance along the curve from the place of the cone that it saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .se2 import left_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaceRows:
    """Holds one row for each detection: residual, tangent and Jacobian blocks, not whitened."""

    residual: Array
    """This is the distance (m,) of the detection past its cone's place, in m, along the tangent there."""
    tangent_unit: Array
    """These are the unit tangents (m, 2) at the places, map frame."""
    by_pose: Array
    """These are the derivatives (m, 3) by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """These are the derivatives (m, degree + 1, 2) by the control points of the place's span."""

    @property
    def flat_by_control(self) -> Array:
        """Returns the derivatives (m, 2 (degree + 1)) by the coordinates of the control points."""
        return self.by_control.reshape(-1, 2 * self.by_control.shape[1])


def along_from_place(
    points_map: Array, poses: Array, control_points: Array, basis: Array, basis_slope: Array
) -> PlaceRows:
    """Returns `r = t . (p - S(u_k))`, where t is the unit tangent at the place u_k of a cone on the curve.

    The parameter u_k is a constant. So `S(u_k)` and its slope `S'(u_k)` are fixed combinations of the control
    points c_j (m, degree + 1, 2) of the place's span, with the coefficients `basis` and `basis_slope`
    (m, degree + 1). points_map `p = R z + t_pose` (m, 2) are in m, poses (m, 3) in the map frame. With J the
    quarter turn, n the unit normal and `d = n . (p - S)`, the derivatives are exact at any distance:

        dr/dt_pose = t,   dr/dtheta = t . (J R z),   dr/dc_j = -beta_j t + d / |S'| beta'_j n
    """
    position = np.einsum("mj,mjd->md", basis, control_points)
    slope = np.einsum("mj,mjd->md", basis_slope, control_points)
    speed = np.hypot(slope[:, 0], slope[:, 1])
    t = slope / speed[:, None]
    n = left_of(t)
    offset, arm = points_map - position, points_map - poses[:, :2]
    turning = (n * offset).sum(axis=1) / speed
    by_theta = t[:, 1] * arm[:, 0] - t[:, 0] * arm[:, 1]
    return PlaceRows(
        residual=(t * offset).sum(axis=1),
        tangent_unit=t,
        by_pose=np.concatenate([t, by_theta[:, None]], axis=1),
        by_control=(turning[:, None] * basis_slope)[:, :, None] * n[:, None, :]
        - basis[:, :, None] * t[:, None, :],
    )
