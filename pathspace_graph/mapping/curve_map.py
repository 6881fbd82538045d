"""The curves for the engine: rows of detections and of new control points, also as GTSAM's own factors."""

from collections.abc import Callable, MutableSequence
from functools import reduce
from itertools import starmap
from typing import Any, Final, Self

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.gtsam_factors import (
    fill,
    smoothness_factors,
    spline_projection_factors,
    station_factors,
)
from pathspace_graph.graph.rows import Rows, among
from pathspace_graph.graph.variables import FIRST_POSE, NO_KEYS, POINT, SENSOR_KEY, pose_key, pose_keys
from pathspace_graph.io.map import NO_CONES
from pathspace_graph.mapping.detection_rows import Stations, WeakPriors
from pathspace_graph.mapping.detections import NO_STATION, DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary

SIGHTINGS_IN_WINDOW: Final = 20.0  # typical number of a cone's detections in a window


class CurveMap:
    """Both boundaries with what the window's poses have seen and placed, and the rows of these."""

    def __init__(self, settings: MapperSettings, state: State | None = None) -> None:
        self.settings = settings
        self.state = state or State()  # curves and all variables
        self.variables = self.state.variables
        self.detections = DetectionTable()  # detections of the poses in the window
        self.weak: dict[
            int, WeakPriors
        ] = {}  # of the control points placed beside poses of the window, by label
        self._replaced = NO_KEYS  # cycles whose weak priors have changed since the last linearization
        self.scatter: dict[int, Array] = {}  # (m,) sigma of cones at each control point, if known (m)
        self.cones: dict[int, Array] = {}  # (k, 2) cones of a boundary, if known: parameters, and sigmas (m)
        self.stations: Stations | None = None  # these cones, if they constrain detections along the curves
        self.reached_inactive = False  # whether the latest `rows` reach inactive control points
        self._refined: tuple[IntArray, Array] = (np.zeros(0, np.intp), np.zeros(0))

    def copy(self) -> Self:
        """Return an independent copy."""
        other = shallow(self)
        other.state = self.state.copy()
        other.variables = other.state.variables
        other.detections = self.detections.copy()
        return other

    # --- detections --------------------------------------------------------------------------------------

    def changed(self) -> IntArray:
        """Cycles (k,) of associations and weak priors that have changed since the last linearization."""
        return np.append(self.detections.cycle[self.detections.changed], self._replaced)

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Linearize `w_i n_i . (R z_i + t - S(u_i)) / sigma_i` for the used detections of ascending cycles.

        The keys are [pose | control points of the span]; w is the root of the Huber weight, and zero if the
        foot point is not interior. `linearized` stores the refined parameters u. Rows along the curves,
        `w t . (R z + t - S(u)) / sigma` at stations u, and the weak priors of the cycles follow.
        """
        state, detections = self.state, self.detections
        if not state.boundaries or len(cycles) == 0:
            return []
        curves, variables, s = state.curves, self.variables, self.settings.spline
        on = self.stations
        rows, u, self.reached_inactive, measured = kernels.curve_rows(
            curves.searched,
            (state.map_points, curves.labels, curves.keys, state.trusted, curves.active_from),
            detections.associated,
            cycles,
            variables.poses,
            variables.first_cycle,
            variables.sensor,
            (s.refine_room, s.refine_iterations, s.sigma_model, self.settings.gate.huber),
            (FIRST_POSE, SENSOR_KEY),
            None if on is None else (on.value, on.slope, on.columns, on.sigma),
        )
        self._refined = rows, u
        weak = [one.where(among(one.cycle, cycles)) for one in self.weak.values()]
        return [*starmap(Rows, measured), *(reduce(WeakPriors.joined, weak).rows(variables) if weak else ())]

    def correct(self) -> None:
        """Do nothing: detections are corrected on access."""

    def linearized(self, cycles: IntArray) -> None:
        """Accept the latest `rows`, of these cycles, which the graph has from now on."""
        if len(cycles) and self.state.boundaries:
            self.detections.refine(*self._refined)
            self.detections.mark_linearized()
            self._replaced = NO_KEYS

    def activate(self, keys: IntArray) -> None:
        """Activate control points that are next to the active ones."""
        self.state.activate(keys)

    def move(self, motion: Array) -> None:
        """Move the cones that the curves were grown through by a rigid motion (3,) of the map frame."""
        for boundary in self.state.boundaries.values():
            boundary.move(motion)

    def activate_all(self) -> None:
        self.state.activate_only({})

    def drop_cycle(self, cycle: int) -> None:
        """Remove the detections of the oldest pose, which has left the window."""
        self.detections.keep_from(cycle + 1)
        self.state.drop_oldest_pose_u()
        self.weak = {
            label: one.where(one.cycle > cycle) for label, one in self.weak.items() if len(one.cycle)
        }

    def replaced_by(self, scatter: dict[int, Array], cones: dict[int, Array]) -> None:
        """Take over the scatter and the cones, by label, from the batch that made curves and prior.

        Cones (k, 2) are their parameters and standard deviations along the curves (m).
        """
        self.scatter, self.cones, self.weak = scatter, cones, {}
        self.lay_out_stations()

    def lay_out_stations(self) -> None:
        """Make the cones stations on the present curves, if all curves have some."""
        labels = [*self.state.boundaries] if self.settings.stations else []
        known = labels and all(len(self.cones.get(label, ())) for label in labels)
        self.stations = Stations.of(self.state, self.cones, SIGHTINGS_IN_WINDOW) if known else None

    def forget_cones(self, label: int, is_gone: Callable[[Array], BoolArray]) -> None:
        """Remove the cones of a curve that are gone, by their parameters (k,)."""
        own = self.cones.get(label, NO_CONES)
        self.cones = {**self.cones, label: own[~is_gone(own[:, 0])]}
        self.lay_out_stations()

    # --- weak priors -------------------------------------------------------------------------------------

    def place(self, label: int, first: int) -> None:
        """Keep the control points from index `first` on where they are, as seen from the newest pose.

        These weak priors replace those that they have in the window.
        """
        points = np.arange(first, self.state.boundaries[label].size)
        if len(points) == 0:
            return
        newest = self.variables.first_cycle + len(self.variables.poses) - 1
        new = WeakPriors.of(self.state, label, points, np.full(len(points), newest), self.settings.gauge)
        self._replaced = np.append(self._replaced, newest)
        known = self.weak.get(label)
        if known is not None:
            gone = known.keys >= new.keys[0]
            self._replaced = np.concatenate([self._replaced, known.cycle[gone]])
            new = known.where(~gone).joined(new)
        self.weak = {**self.weak, label: new}


# --- as GTSAM's own factors ---------------------------------------------------------------------------------


def curve_factors(track: CurveMap, label: int) -> list[gtsam.NonlinearFactor]:
    """Return the factors of the detections in use on a boundary, and the weak priors of its control points.

    A detection has a factor across the curve, and one at its station, with their Huber losses. Foot points
    may move as far as in a step, within the active part of the curve.
    """
    detections, settings, state = track.detections, track.settings, track.state
    boundary, active, rows = state.boundaries[label], state.active(label), detections.used_on(label)

    def seen(rows: IntArray) -> dict[str, Any]:
        return {
            "pose_keys": pose_keys(detections.cycle[rows]),
            "control_keys": state.control_keys(label).tolist(),
            "tables": boundary.tables,
            "points_vehicle": detections.measured[rows],
            "covariances": detections.covariance[rows],
            "twists": detections.twist[rows],
            "huber": settings.gate.huber,
            "sensor_key": state.variables.sensor_key,
        }

    u = detections.u[rows]
    before, past = _room(boundary, active, u, settings.spline.refine_room)
    factors: list[gtsam.NonlinearFactor] = [
        *spline_projection_factors(
            low=u - before,
            high=boundary.within_trusted(u + past),
            sigma_model=settings.spline.sigma_model,
            **seen(rows),
        )
    ]
    rows = rows[detections.station[rows] != NO_STATION]
    if track.stations is not None and len(rows):
        station = detections.station[rows]
        at, sigma_station = track.stations.u[station], track.stations.sigma[station]
        factors += station_factors(u=at, sigma_station=sigma_station, **seen(rows))
    weak = track.weak.get(label)
    if weak is not None:
        factors += [factor_beside(weak, j) for j in range(len(weak.keys))]
        for triple, bending in zip(weak.triples.tolist(), weak.bending, strict=True):
            factors += smoothness_factors(triple, bending[None], 1.0) if bending.any() else []
    return factors


def factor_beside(one: WeakPriors, j: int) -> gtsam.CustomFactor:
    """Build the factor that keeps a control point where it is, as seen from its pose."""
    point_key, cycle = int(one.keys[j]), int(one.cycle[j])
    place, whitener = one.place[j], one.whitener[j]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: MutableSequence[Array] | None) -> Array:
        pose, by_pose, by_point = (
            values.atPose2(pose_key(cycle)),
            np.zeros((2, 3), order="F"),
            np.zeros((2, 2), order="F"),
        )
        seen = pose.transformTo(values.atPoint2(point_key), by_pose, by_point)
        if H is not None:
            fill(H, [whitener @ by_point, whitener @ by_pose])
        return np.asarray(whitener @ (seen - place))

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(POINT), [point_key, pose_key(cycle)], error)


def _room(boundary: Boundary, active: IntArray, u: Array, room: float) -> tuple[Array, Array]:
    """Return the lengths (m,) of active curve before and past parameters u (m,), at most `room` (m)."""
    if len(active) == boundary.size:
        return np.full(len(u), room), np.full(len(u), room)
    p, begin = boundary.degree, boundary.knots[active[0] + boundary.degree]
    span = active[0] + np.arange(p, len(active))
    span = np.where(span >= boundary.size + p, span - boundary.size, span) if boundary.periodic else span
    widths = np.diff(boundary.knots)[span]
    after = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin
    return np.minimum(after, room), np.minimum(widths.sum() - after, room)
