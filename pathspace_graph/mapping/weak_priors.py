"""Weak priors of control points, on what detections leave free: above all, their slide along the curve."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.residuals import smoothness_coefficients
from pathspace_graph.factors.se2 import in_vehicle, left_of, rotations, to_vehicle
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POINT, Variables, pose_keys
from pathspace_graph.settings.mapper import GaugeSettings

from .state import State


@dataclass(frozen=True, eq=False)
class WeakPriors:
    """Weak priors of control points c of a curve, each beside the pose (p, theta) that it was placed from.

    The residuals `W (R(theta)' (c - p) - z)` keep its place z in the vehicle frame: along the curve to a
    share of the spacing, across it only as far as the system needs. The residual `sum_k d_k c_k` of the point
    and the two before it is their second difference. No rigid motion of poses and map changes either.
    """

    keys: IntArray  # (m,) control points
    cycle: IntArray  # (m,) perception cycles of the poses
    place: Array  # (m, 2) z, vehicle frame (m)
    whitener: Array  # (m, 2, 2) W, vehicle frame (1/m)
    triples: IntArray  # (m, 3) keys of the point and the two before it
    bending: Array  # (m, 3) d, in sigmas (1/m); zero for the first two points of an open curve

    @classmethod
    def of(cls, state: State, label: int, points: IntArray, cycle: IntArray, settings: GaugeSettings) -> Self:
        """Build the priors of control points (m,) of a curve, by index, at their present places."""
        boundary, control = state.boundaries[label], state.control_points(label)
        period, spacing = boundary.length if boundary.periodic else None, float(np.mean(boundary.nominal))
        before, after, first = points - 1, points + 1, points - 2
        if not boundary.periodic:
            before, after, first = (
                np.maximum(before, 0),
                np.minimum(after, boundary.size - 1),
                np.maximum(first, 0),
            )
        ahead = control[after % boundary.size] - control[before % boundary.size]
        beside = state.variables.poses_at(cycle)
        tangent = in_vehicle(ahead / np.hypot(*ahead.T)[:, None], beside)
        along, across = settings.sigma_spacing * spacing, settings.sigma_anchor
        bent = smoothness_coefficients(boundary.abscissae, period, spacing)[first]
        bent *= ((points >= 2) | boundary.periodic)[:, None] / (settings.sigma_smoothness * spacing)
        keys = state.control_keys(label)
        return cls(
            keys[points],
            cycle,
            to_vehicle(control[points], beside),
            np.stack([tangent / along, left_of(tangent) / across], axis=1),
            keys[(first[:, None] + np.arange(3)) % boundary.size],
            bent,
        )

    def where(self, chosen: BoolArray) -> Self:
        return type(self)(*(getattr(self, column.name)[chosen] for column in fields(self)))

    def joined(self, other: Self) -> Self:
        both = ((getattr(self, column.name), getattr(other, column.name)) for column in fields(self))
        return type(self)(*map(np.concatenate, both))

    def rows(self, variables: Variables) -> list[Rows]:
        """Linearize places on [pose | point], and second differences on [point | point | point]."""
        if len(self.keys) == 0:
            return []
        poses, points = variables.poses_at(self.cycle), variables.of(self.keys).reshape(-1, POINT)
        seen, by_point = to_vehicle(points, poses), self.whitener @ rotations(poses[:, 2]).transpose(0, 2, 1)
        by_heading = -self.whitener @ left_of(seen)[:, :, None]
        by_both = np.concatenate([-by_point, by_heading, by_point], axis=2)
        off = self.whitener @ (seen - self.place)[:, :, None]
        by_axis = np.zeros((len(points), POINT, 3, POINT))
        by_axis[:, 0, :, 0] = by_axis[:, 1, :, 1] = self.bending
        three = variables.of(self.triples.ravel()).reshape(-1, 3, POINT)
        bent = (self.bending[:, :, None] * three).sum(axis=1)
        beside, owner = np.column_stack([pose_keys(self.cycle), self.keys]), np.repeat(self.cycle, POINT)
        return [
            Rows(np.repeat(beside, POINT, axis=0), by_both.reshape(len(owner), -1), off.ravel(), owner),
            Rows(
                np.repeat(self.triples, POINT, axis=0), by_axis.reshape(len(owner), -1), bent.ravel(), owner
            ),
        ]
