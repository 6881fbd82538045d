"""Rows of the curves: detections across and along them, and the weak priors of control points."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.residuals import sigma_across, smoothness_coefficients
from pathspace_graph.factors.se2 import in_vehicle, left_of, rotations, to_vehicle
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import FIRST_POSE, POINT, SENSOR_KEY, Drives, Variables, pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.detections import NO_STATION, DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import GaugeSettings


@dataclass(frozen=True, eq=False)
class DetectionRows:
    """One row for each of m detections on [pose | sensor | control points], not whitened."""

    rows: IntArray  # (m,) detections, by row of the table
    keys: IntArray  # (m, k)
    residual: Array  # (m,) distance from the curve or from the station, in m
    sigma: Array  # (m,) its standard deviation in m; infinite for a detection without information
    jacobian: Array  # (m, n)

    @property
    def whitened(self) -> Array:
        """Residuals (m,) in sigmas."""
        return np.asarray(self.residual / self.sigma)

    def weighted(self, weights: Array, owner: IntArray) -> Rows:
        """Whiten the rows and apply robust weights (m,); each row is part of the factor `owner` (m,)."""
        scale = np.sqrt(weights) / self.sigma
        return Rows(self.keys, self.jacobian * scale[:, None], self.residual * scale, owner)


NO_ROWS: Final = DetectionRows(
    np.zeros(0, np.intp), np.zeros((0, 0), np.intp), np.zeros(0), np.zeros(0), np.zeros((0, 0))
)


def rows_across(
    state: State,
    detections: DetectionTable,
    rows: IntArray,
    points: Array,
    foot: FootPoints,
    sigma_model: float,
) -> DetectionRows:
    """Linearize `n . (R z + t - S(u))` for detections (m,) at points (m, 2), map frame.

    Foot points are on `State.curves`. The terms are those of `factors._kernels:detection_rows`.
    """
    cycle, variables = detections.cycle[rows], state.variables
    measuring = measuring_keys(cycle, variables, state.drives)
    keys = np.concatenate([measuring, state.curves.keys[foot.columns]], axis=1)

    def terms(own: IntArray | slice, sensor: Array) -> tuple[Array, Array, Array]:
        chosen = rows[own]
        return kernels.detection_rows(
            points[own],
            detections.covariance[chosen],
            variables.poses_at(cycle[own]),
            foot.normal_unit[own],
            foot.distance[own],
            foot.basis[own],
            detections.measured[chosen],
            detections.twist[chosen],
            sensor,
            sigma_model,
        )

    return DetectionRows(rows, keys, *state.drives.by_sensor(terms, cycle, variables.sensor))


def measuring_keys(cycle: IntArray, variables: Variables, drives: Drives) -> IntArray:
    """Keys (m, 1) of the poses of cycles (m,), or (m, 2) with the sensor's calibration."""
    sensors = np.asarray(drives.sensors)[drives.of(cycle)]
    keys = np.column_stack([FIRST_POSE + cycle, SENSOR_KEY + sensors])
    return np.asarray(keys[:, : 2 if len(variables.sensor) else 1])


# --- stations along the curves ---------------------------------------------------------------------------


STATION_CERTAIN: Final = 3.0  # gate along a curve (sigmas), less than half the distance of the next cone
SIGMA_POSE: Final = 0.2  # standard deviation of the vehicle along a curve in the matching of detections (m)


@dataclass(frozen=True, eq=False)
class CurveStations:
    """The stations of one curve, ascending."""

    label: int  # of the boundary
    first: int  # index of the first station among those of all curves
    u: Array  # (k,) parameters of the cones, within one length (m)
    sigma: Array  # (k,) standard deviations of the cones along the curve, given the curve (m)
    apart: Array  # (k,) distances to the nearer neighbour (m)
    length: float  # length of the curve (m); infinite if open

    @classmethod
    def of(cls, label: int, first: int, u: Array, sigma: Array, ends: tuple[float, float]) -> Self:
        """Place at least one cone at parameters (k,) of a curve; an open one ends at infinity."""
        low, length = ends[0], ends[1] - ends[0]
        u = low + np.mod(u - low, length)
        order = np.argsort(u)
        gaps = np.diff(u[order], append=u[order[0]] + length)
        return cls(label, first, u[order], sigma[order], np.minimum(gaps, np.roll(gaps, 1)), length)

    @cached_property
    def _around(self) -> tuple[Array, Array]:
        """Parameters of the stations, on a closed curve with the first one again, and midpoints between."""
        u = self.u if self.length == np.inf else np.append(self.u, self.u[0] + self.length)
        return u, 0.5 * (u[:-1] + u[1:])

    def nearest(self, u: Array) -> tuple[IntArray, Array]:
        """Return the nearest station to each parameter, of any shape, and the distance beyond it (m)."""
        around, between = self._around
        if self.length < np.inf:
            u = self.u[0] + np.mod(u - self.u[0], self.length)
        near = between.searchsorted(u)
        return near % len(self.u), u - around[near]

    def matched(self, u: Array, sigma: Array) -> IntArray:
        """Match detections with foot points u (m,) to stations; `NO_STATION` if ambiguous.

        sigma (m,) are their standard deviations along the curve, with the vehicle's. Ambiguity is judged by
        the expected distances: a choice by the observed ones would be biased to small distances.
        """
        station, beyond = self.nearest(u)
        limit = STATION_CERTAIN * np.hypot(sigma, self.sigma[station])
        sure = (limit < 0.5 * self.apart[station]) & (np.abs(beyond) < limit)
        return np.where(sure, self.first + station, NO_STATION)


@dataclass(frozen=True, eq=False)
class Stations:
    """The stations of all curves of a state, curve by curve, and the basis functions there."""

    curves: tuple[CurveStations, ...]
    u: Array  # (k,) parameters (m)
    sigma: Array  # (k,) standard deviations along the curves, for a single detection (m)
    label: IntArray  # (k,) boundary of each
    value: Array  # (k, p + 1) basis functions at the stations
    slope: Array  # (k, p + 1) their derivatives (1/m)
    columns: IntArray  # (k, p + 1) control points that they weigh, by row of `State.map_points`

    @classmethod
    def of(cls, state: State, cones: Mapping[int, Array], sightings: float = 1.0) -> Self:
        """Place cones (k, 2), at least one on each curve, by label: parameters, and sigmas along it (m).

        The error of a station is the same in all of its `sightings`, so each gets its variance times their
        number.
        """
        curves, columns, values, before, count = list[CurveStations](), [], [], 0, 0
        for label, boundary in state.boundaries.items():
            ends = boundary.tables.low, boundary.tables.high if boundary.periodic else np.inf
            u, sigma = cones[label].T
            own = CurveStations.of(label, count, u, sigma, ends)
            value, span = boundary.tables.evaluate(own.u, 1)
            curves.append(own)
            columns.append(before + boundary.columns(span))
            values.append(value)
            before, count = before + boundary.size, count + len(own.u)
        value, slope = map(np.ascontiguousarray, np.concatenate(values, axis=1))
        numbers = np.array([own.label for own in curves]).repeat([len(own.u) for own in curves])
        places, sigmas = np.concatenate([(own.u, own.sigma) for own in curves], axis=1)
        sigmas = np.sqrt(sightings) * sigmas
        return cls(tuple(curves), places, sigmas, numbers, value, slope, np.concatenate(columns))

    def match(self, state: State, detections: DetectionTable, rows: IntArray, directions: Array) -> None:
        """Match used detections (m,) of the colour of their curve with its stations.

        directions (m, 2) are the unit tangents at their foot points, map frame.
        """
        poses = state.variables.poses_at(detections.cycle[rows])
        sigma = sigma_across(directions, detections.covariance[rows], poses, SIGMA_POSE)
        label = detections.label[rows]
        colour = np.where(detections.boundary[rows] == label, label, UNKNOWN)
        for curve in self.curves:
            own = colour == curve.label
            detections.match(rows[own], curve.matched(detections.u[rows[own]], sigma[own]))

    def rows(self, state: State, detections: DetectionTable, rows: IntArray) -> DetectionRows:
        """Linearize `t . (R z + t - S(u))` for detections (m,) at their stations.

        The terms are those of `factors._kernels:station_rows`.
        """
        cycle, variables, station = detections.cycle[rows], state.variables, detections.station[rows]
        columns = self.columns[station]
        measuring = measuring_keys(cycle, variables, state.drives)
        keys = np.concatenate([measuring, state.map_keys[columns]], axis=1)
        points = detections.points_map(rows, variables)

        def terms(own: IntArray | slice, sensor: Array) -> tuple[Array, Array, Array]:
            chosen, cones = rows[own], station[own]
            return kernels.station_rows(
                points[own],
                detections.covariance[chosen],
                variables.poses_at(cycle[own]),
                self.value[cones],
                self.slope[cones],
                state.map_points[columns[own]],
                detections.measured[chosen],
                detections.twist[chosen],
                sensor,
                self.sigma[cones],
            )

        return DetectionRows(rows, keys, *state.drives.by_sensor(terms, cycle, variables.sensor))


# --- weak priors of control points --------------------------------------------------------------------------


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
        return type(self)(*(column[chosen] for column in vars(self).values()))

    def joined(self, other: Self) -> Self:
        both = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*map(np.concatenate, both))

    def rows(self, variables: Variables) -> list[Rows]:
        return [self.places(variables), self.bends(variables)] if len(self.keys) else []

    def places(self, variables: Variables) -> Rows:
        """Linearize `W (R' (c - p) - z)` on [pose | point], two rows for each point."""
        poses, points = variables.poses_at(self.cycle), variables.of(self.keys).reshape(-1, POINT)
        seen, by_point = to_vehicle(points, poses), self.whitener @ rotations(poses[:, 2]).transpose(0, 2, 1)
        by_heading = -self.whitener @ left_of(seen)[:, :, None]
        by_both = np.concatenate([-by_point, by_heading, by_point], axis=2)
        off = self.whitener @ (seen - self.place)[:, :, None]
        keys = np.repeat(np.column_stack([pose_keys(self.cycle), self.keys]), POINT, axis=0)
        return Rows(keys, by_both.reshape(len(keys), -1), off.ravel(), np.repeat(self.cycle, POINT))

    def bends(self, variables: Variables) -> Rows:
        """Linearize second differences on [point | point | point], a row for each coordinate."""
        by_axis = np.zeros((len(self.keys), POINT, 3, POINT))
        by_axis[:, 0, :, 0] = by_axis[:, 1, :, 1] = self.bending
        three = variables.of(self.triples.ravel()).reshape(-1, 3, POINT)
        bent = (self.bending[:, :, None] * three).sum(axis=1)
        keys = np.repeat(self.triples, POINT, axis=0)
        return Rows(keys, by_axis.reshape(len(keys), -1), bent.ravel(), np.repeat(self.cycle, POINT))
