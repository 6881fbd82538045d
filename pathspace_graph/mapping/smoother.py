"""The fixed-lag engine on the curves of both boundaries: association, and the active part of the map."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary, relocate

from .curve_map import CurveMap
from .detection_rows import rows_across
from .motion import smoother_settings

CHI_UNKNOWN: Final = 1.5  # gate of unknown colour, own sigmas: a start line would bend curves
STATION_STEP: Final = 1.5  # way in a cycle beyond which the pose's foot point is searched for (m)
FAR_STRETCH: Final = 12.0  # least length behind the vehicle of which an open curve becomes inactive (m)
FAR_ROOM: Final = 40.0  # length beyond what the vehicle sees that stays active (m)


@dataclass(frozen=True, eq=False)
class Gating:
    """Gating of the coloured detections of the newest pose."""

    rows: IntArray  # (k,) detections, by row of the table
    in_view: BoolArray  # (k,) whether the detection lies beside the part of its curve that the pose sees
    innovation: Array  # (k,) distance from the curve before the update, in sigmas


class CurveSmoother(FixedLagSmoother[CurveMap]):
    """Window, prior and map of the two curves, with the association of detections."""

    MAP: ClassVar = CurveMap  # class of the curves' rows

    def __init__(self, settings: MapperSettings) -> None:
        super().__init__(smoother_settings(settings), self.MAP(settings))
        self.window.exact = True
        self.attached = [self.map]

    def settle(self) -> None:
        """Relinearize only what moves from now on; after loop closure, that is little."""
        self.window.exact = False

    def newest_covariance(self) -> Array:
        """Covariance (3, 3) of the newest pose (m, m, rad), map frame."""
        return self.covariance(pose_keys(np.array([self.next_cycle - 1])))

    # --- association -------------------------------------------------------------------------------------

    def associate(self, retest: frozenset[int], use: bool = True) -> Gating:
        """Use detections that pass the gate of a curve: `d^2 < chi^2 (sigma^2 + g' Sigma g)`.

        d is the signed distance, sigma its own standard deviation, and g its gradient by pose and control
        points with the joint covariance Sigma. The detections of the newest pose are tested, and all unused
        ones of the window for the labels in `retest`, whose curves have grown. A detection of unknown colour
        is used if exactly one curve accepts it. The same search locates the newest pose on each curve;
        without `use`, nothing else is done.
        """
        detections = self.map.detections
        rows, curve = self._untested(retest)
        points = detections.points_map(rows, self.variables)
        foot = self._find(rows, curve, points)
        if len(rows) == 0 or self.last_step is None or not use:
            return Gating(rows[:0], np.zeros(0, bool), np.zeros(0))
        innovation = self._accept(rows, curve, points, foot)
        newest = detections.cycle[rows] == self.next_cycle - 1
        judged = newest & (detections.label[rows] != UNKNOWN)
        return Gating(rows[judged], foot.interior[judged], innovation[judged])

    def reassociate(self) -> None:
        """Associate all detections of the window with new curves, on which the poses are located.

        The uncertainty is that of prior and odometry alone, since no detection is in use.
        """
        self.map.detections.release_all()
        self.factorize()
        self._associate(*self._untested(frozenset(self.map.state.boundaries)))

    def _associate(self, rows: IntArray, curve: IntArray) -> None:
        """Use detections (m,) that pass the gate of their curve (m,), by the places of all poses."""
        state, detections, gate = self.map.state, self.map.detections, self.map.settings.gate
        points = detections.points_map(rows, self.variables)
        pose_u = np.array([state.pose_u[label] for label in state.boundaries])
        seen_from = pose_u[curve, detections.cycle[rows] - self.first_cycle]
        stretch = seen_from - gate.view_behind, seen_from + gate.view_ahead
        self._accept(rows, curve, points, state.find(points, curve, *stretch))

    def _accept(self, rows: IntArray, curve: IntArray, points: Array, foot: FootPoints) -> Array:
        """Use detections (m,) that pass the gate of their curve (m,); return innovations (m,) in sigmas."""
        detections, state, gate = self.map.detections, self.map.state, self.map.settings.gate
        sigma_model = self.map.settings.spline.sigma_model
        limits = (sigma_model, gate.sigma_floor, gate.rough, gate.chi, CHI_UNKNOWN, UNKNOWN)
        columns = detections.cycle, detections.label, detections.covariance
        poses, at = (self.variables.poses, self.first_cycle), (foot.normal_unit, foot.distance, foot.interior)
        variance, accepted, doubtful = kernels.gated(rows, *columns, *poses, at, limits)
        if doubtful.any():  # the joint uncertainty is costly: compute it for these only
            variance[doubtful] += self.joint_variance(rows[doubtful], points[doubtful], foot.where(doubtful))
            accepted[doubtful] = foot.distance[doubtful] ** 2 < gate.chi**2 * variance[doubtful]
        taken = rows[accepted]
        ambiguous = detections.used[taken] | (np.bincount(taken)[taken] > 1)  # two curves accept it
        detections.take(taken, state.curves.labels[curve[accepted]], foot.u[accepted])
        if self.map.stations is not None:
            self.map.stations.match(state, detections, taken, foot.tangent_unit[accepted])
        if ambiguous.any():
            detections.release(taken[ambiguous])
        return np.asarray(foot.distance / np.sqrt(variance))

    def _untested(self, retest: frozenset[int]) -> tuple[IntArray, IntArray]:
        """Return the detections (m,) to test, and the index (m,) of the curve to test each for."""
        detections, labels = self.map.detections, np.array([*self.map.state.boundaries], np.intp)
        newest = int(detections.cycle.searchsorted(self.next_cycle - 1))
        since = np.array([0 if label in retest else newest for label in labels.tolist()], np.intp)
        return detections.open_to(labels, since)

    def joint_variance(self, rows: IntArray, points: Array, foot: FootPoints) -> Array:
        """Variance `g_i' Sigma g_i` (m,) of the residuals of detections (m,) at points (m, 2), map frame.

        It is in m^2, by pose, control points and calibration of the sensor.
        """
        detections, sigma_model = self.map.detections, self.map.settings.spline.sigma_model
        seen = rows_across(self.map.state, detections, rows, points, foot, sigma_model)
        gradient = Rows(seen.keys, seen.jacobian, seen.residual, detections.cycle[rows])
        return self.predicted_covariance(gradient)[:, 0, 0]

    # --- the newest pose beside the curves ---------------------------------------------------------------

    def _find(self, rows: IntArray, curve: IntArray, points: Array) -> FootPoints:
        """Find foot points of detections at points (m, 2) on their curves (m,); locate the newest pose."""
        state, gate, s = self.map.state, self.map.settings.gate, self.map.settings.spline
        curves, room = state.curves, (gate.station_behind, gate.station_ahead)
        if float(np.hypot(*(state.poses[-1, :2] - state.poses[-2, :2]))) < STATION_STEP:
            room = s.refine_room, s.refine_room
        foot, beside = kernels.in_view(
            curves.searched,
            state.map_points,
            state.trusted,
            points,
            curve,
            self.map.detections.cycle[rows] - self.first_cycle,
            [state.pose_u[label] for label in state.boundaries],
            state.poses[-1],
            (gate.view_behind, gate.view_ahead, *room),
            s.search_step,
            s.search_iterations,
        )
        for label, (u, along, distance) in zip(state.boundaries, beside, strict=True):
            lost = along < 0.0 or abs(distance) > gate.station_lateral
            state.locate_newest(label, self._relocated(label) if lost else u)
        return FootPoints(*foot)

    def _relocated(self, label: int) -> float:
        """Find the parameter of a vehicle that the ordinary search has not found beside the curve."""
        state, room = self.map.state, self.map.settings.gate.station_room
        boundary = state.boundaries[label]
        low = np.array([boundary.confirmed_end - room - boundary.settings.refine_room])
        if boundary.periodic or boundary.tables.locate(low)[0][0] < state.active(label)[0]:
            self.refresh()  # the search reaches inactive control points, which may be outdated
        return relocate(boundary, state.control_points(label), state.poses[-1], room)

    # --- the active part ---------------------------------------------------------------------------------

    def deactivate_distant(self, stretch: float = FAR_STRETCH) -> None:
        """Restrict steps to the control points that the window can reach, and some room for the next cycles.

        The active part of a closed map is chosen again when it does not contain what the window needs. The
        inactive part of an open map grows with the drive, once a `stretch` (m) of it can become inactive.
        Inactive control points keep their linearization point. From a map that is solved as a whole, a closed
        one differs by millimetres to centimetres, an open one by decimetres.
        """
        state = self.map.state
        needed = {label: self._needed(label) for label in state.boundaries}
        if not all(
            _holds(state.active(label), indices, state.boundaries[label].size)
            for label, indices in needed.items()
        ):
            keys = [state.control_keys(label)[indices] for label, indices in needed.items()]
            self.activate(np.concatenate(keys))
        elif not self._is_worthwhile(needed, stretch):
            return
        active = {label: self._needed(label, FAR_ROOM) for label in state.boundaries}
        leaving = [np.setdiff1d(state.active(label), indices) for label, indices in active.items()]
        if not any(map(len, leaving)):
            return
        keys = [state.control_keys(label)[indices] for label, indices in zip(active, leaving, strict=True)]
        self.deactivate(np.concatenate(keys))
        state.activate_only(active)
        self.transform_to_origin()

    def _is_worthwhile(self, needed: dict[int, IntArray], stretch: float) -> bool:
        """Whether a closed curve is active all around, or an open one for a stretch (m) behind."""
        state, settings = self.map.state, self.map.settings
        behind = [0]
        for label, indices in needed.items():
            if state.boundaries[label].periodic:
                return state.whole
            behind.append(int(indices[0] - state.active(label)[0]))
        return max(behind) * settings.spline.spacing >= stretch

    def _needed(self, label: int, room: float = 0.0) -> IntArray:
        """Control points (k,) that the window can reach until the next cycle, and `room` (m) ahead.

        Used detections may lie farther behind than a pose sees, since the road has moved after they were
        made.
        """
        boundary, pose_u = self.map.state.boundaries[label], self.map.state.pose_u[label]
        settings, weak = self.map.settings, self.map.weak.get(label)
        if boundary.periodic:
            return reached(boundary, pose_u, settings, room)
        low = float(pose_u.min()) - settings.gate.view_behind
        low = float(self.map.detections.u[self.map.detections.used_on(label)].min(initial=low))
        first = boundary.tables.span_of(low - settings.spline.refine_room)
        if weak is not None and len(weak.keys):  # an end that was carried on may lie farther behind
            first = min(first, int(weak.triples.min() - self.map.state.control_keys(label)[0]))
        return np.arange(first, boundary.size)


def reached(boundary: Boundary, pose_u: Array, settings: MapperSettings, room: float) -> IntArray:
    """Control points (k,) of a closed curve that poses at parameters (P,) can reach, and `room` (m) ahead."""
    gate, slide = settings.gate, settings.spline.refine_room
    ahead = gate.view_ahead + gate.station_ahead + slide + room
    return boundary.stretch(float(pose_u.min()) - gate.view_behind - slide, float(pose_u.max()) + ahead)


def _holds(active: IntArray, needed: IntArray, size: int) -> bool:
    """Whether one stretch of a boundary's `size` control points contains another; indices may wrap."""
    return int(needed[0] - active[0]) % size + len(needed) <= len(active)
