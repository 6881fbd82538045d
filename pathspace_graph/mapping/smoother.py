"""The fixed-lag engine on both boundaries' curves: association, and the active part of the map."""

from dataclasses import dataclass

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.graph.inactive import Follower
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.smoother import FixedLagSmoother
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import relocate

from .curve_map import CurveMap
from .motion import smoother_settings


@dataclass(frozen=True, eq=False)
class Gating:
    """The coloured detections of the newest pose, as they were tested."""

    rows: IntArray
    """(k,) Detections, by row of the table."""
    in_view: BoolArray
    """(k,) Whether the detection lies beside the part of its curve that the pose sees."""
    innovation: Array
    """(k,) Distance of each from its curve before the update, in standard deviations of it."""


class CurveSmoother(FixedLagSmoother[CurveMap]):
    """Window, prior and map of the two curves, with the association of detections with them."""

    def __init__(self, settings: MapperSettings) -> None:
        super().__init__(smoother_settings(settings), CurveMap(settings))
        self.window.exact = True
        self.add_followers(self.map)

    def add_followers(self, *followers: Follower) -> None:
        """Move these together with the open map."""
        self.followers += followers

    def settle(self) -> None:
        """Relinearize only what moves from now on: once the loop has closed, hardly anything does."""
        self.window.exact = False

    def newest_covariance(self) -> Array:
        """Return the covariance (3, 3) of the newest pose (m, m, rad), map frame."""
        return self.covariance(pose_keys(np.array([self.next_cycle - 1])))

    # --- association -------------------------------------------------------------------------------------

    def associate(self, retest: frozenset[int], use: bool = True) -> Gating:
        """Put detections into use that lie on a curve: `d^2 < chi^2 (sigma^2 + g' Sigma g)`.

        d is the signed distance, sigma its own standard deviation, and g its gradient by pose and control
        points, whose joint covariance is Sigma. The newest pose's detections are tested, and for the labels
        in `retest`, whose curves have grown, all of the window that are not in use. A detection of unknown
        colour is used only if exactly one curve accepts it. The newest pose's parameter on each curve is
        found in the same search. Without `use`, no detection is tested, and only that parameter is found.
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

    def associate_late(self, new: slice) -> None:
        """Put those of the late detections, which are the rows `new`, into use that lie on a curve."""
        if self.last_step is None:
            return
        of_label = [self.map.detections.open_to(b, new.start) for b in self.map.state.curves.labels.tolist()]
        of_label = [rows[rows < new.stop] for rows in of_label]
        curve = np.repeat(np.arange(len(of_label)), [len(rows) for rows in of_label])
        self._associate(np.concatenate(of_label), curve)

    def reassociate(self) -> None:
        """Associate all detections of the window anew, after the curves were replaced.

        The poses must have their parameters on the new curves. The uncertainty is that of the prior and the
        odometry alone, since no detection is in use.
        """
        self.map.detections.release_all()
        self.factorize()
        self._associate(*self._untested(frozenset(self.map.state.boundaries)))

    def _associate(self, rows: IntArray, curve: IntArray) -> None:
        """Put those detections (m,) into use that pass the gate of their curve (m,), by all poses' places."""
        state, points = self.map.state, self.map.detections.points_map(rows, self.variables)
        low, high = self._view(rows, curve, np.array([state.pose_u[label] for label in state.boundaries]))
        foot = state.curves.find(state.map_points, points, curve, low, high)
        self._accept(rows, curve, points, foot)

    def _view(self, rows: IntArray, curve: IntArray, pose_u: Array) -> tuple[Array, Array]:
        """Return the stretch [low, high] of its curve (m,) that each detection may belong to.

        `pose_u` (k, P) are the parameters of the window's poses on every curve.
        """
        gate = self.map.settings.gate
        seen_from = pose_u[curve, self.map.detections.cycle[rows] - self.first_cycle]
        return seen_from - gate.view_behind, seen_from + gate.view_ahead

    def _accept(self, rows: IntArray, curve: IntArray, points: Array, foot: FootPoints) -> Array:
        """Put those detections (m,) into use that pass the gate of their curve (m,).

        Return the distance of each from its curve, in standard deviations (m,).
        """
        detections, state, gate = self.map.detections, self.map.state, self.map.settings.gate
        poses = self.variables.poses_at(detections.cycle[rows])
        covariances, sigma_model = detections.covariance[rows], self.map.settings.spline.sigma_model
        sigma = sigma_across(foot.normal_unit, covariances, poses, sigma_model)
        variance, unknown = sigma**2 + gate.sigma_floor**2, detections.label[rows] == UNKNOWN
        near, square = foot.interior & (np.abs(foot.distance) < gate.rough), foot.distance**2
        accepted = near & (square < np.where(unknown, gate.chi_unknown, gate.chi) ** 2 * variance)
        doubtful = np.flatnonzero(near & ~accepted & ~unknown)
        if len(doubtful):  # the joint uncertainty is costly, and only these need it
            variance[doubtful] += self.joint_variance(rows[doubtful], points[doubtful], foot.where(doubtful))
            accepted[doubtful] = square[doubtful] < gate.chi**2 * variance[doubtful]
        taken = rows[accepted]
        ambiguous = detections.used[taken] | (np.bincount(taken)[taken] > 1)  # two curves accept it
        detections.take(taken, state.curves.labels[curve[accepted]], foot.u[accepted])
        detections.release(taken[ambiguous])
        return np.asarray(foot.distance / np.sqrt(variance))

    def _untested(self, retest: frozenset[int]) -> tuple[IntArray, IntArray]:
        """Return the detections (m,) to test, and the index (m,) of the curve that each is tested for."""
        detections, labels = self.map.detections, self.map.state.curves.labels.tolist()
        newest = int(detections.cycle.searchsorted(self.next_cycle - 1))
        rows = [detections.open_to(label, 0 if label in retest else newest) for label in labels]
        return np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(of_label) for of_label in rows])

    def joint_variance(self, rows: IntArray, points: Array, foot: FootPoints) -> Array:
        """Return `g_i' Sigma g_i` (m,) in m^2: the variance of each residual of detections (m,).

        It comes from the uncertainty of the pose, of the control points and of the sensor's calibration. The
        detections are at points (m, 2), map frame.
        """
        cycles = self.map.detections.cycle[rows]
        keys = np.concatenate(
            [self.map.measuring_keys(cycles), self.map.state.curves.keys[foot.columns]], axis=1
        )
        projected, by = self.map.project(rows, points, foot)
        by_control = projected.by_control.reshape(len(rows), 2 * foot.basis.shape[1])
        jacobian = np.concatenate([projected.by_pose, by.by_sensor, by_control], axis=1)
        return self.predicted_covariance(Rows(keys, jacobian, projected.residual, cycles))[:, 0, 0]

    # --- the newest pose beside the curves ---------------------------------------------------------------

    def _find(self, rows: IntArray, curve: IntArray, points: Array) -> FootPoints:
        """Find the foot points of detections at points (m, 2), each on its own curve (m,) and in its view.

        The newest pose's foot point on every curve is found in the same search and noted in the state.
        """
        state, gate = self.map.state, self.map.settings.gate
        curves, pose = state.curves, state.poses[-1]
        pose_u = np.array([state.pose_u[label] for label in state.boundaries])
        pose_u = np.append(pose_u, pose_u[:, -1:], axis=1)  # the newest pose is near the one before
        (low, high), all_curves = self._view(rows, curve, pose_u), np.arange(len(pose_u))
        behind, ahead = self._search_room()
        foot = curves.find(
            state.map_points,
            np.concatenate([points, np.broadcast_to(pose[:2], (len(pose_u), 2))]),
            np.append(curve, all_curves),
            np.append(low, pose_u[:, -1] - behind),
            np.append(high, pose_u[:, -1] + ahead),
        )
        beside = foot.where(slice(len(rows), None))
        along = beside.tangent_unit @ np.array([np.cos(pose[2]), np.sin(pose[2])])
        lost = (along < 0.0) | (np.abs(beside.distance) > gate.station_lateral)
        for label, u, is_lost in zip(state.boundaries, beside.u.tolist(), lost.tolist(), strict=True):
            state.locate_newest(label, self._relocated(label) if is_lost else u)
        return foot.where(slice(len(rows)))

    def _search_room(self) -> tuple[float, float]:
        """Return how far behind and ahead (m) of its last parameter the vehicle's foot point is searched."""
        settings, poses = self.map.settings, self.variables.poses
        if float(np.hypot(*(poses[-1, :2] - poses[-2, :2]))) < settings.gate.station_step:
            return settings.spline.refine_room, settings.spline.refine_room
        return settings.gate.station_behind, settings.gate.station_ahead

    def _relocated(self, label: int) -> float:
        """Return the parameter of a vehicle that was not found beside the curve in the ordinary search."""
        state, room = self.map.state, self.map.settings.gate.station_room
        boundary = state.boundaries[label]
        low = np.array([boundary.confirmed_end - room - boundary.settings.refine_room])
        if boundary.periodic or boundary.tables.locate(low)[0][0] < state.active(label)[0]:
            self.refresh()  # the search reaches inactive control points, which may be out of date
        return relocate(boundary, state.control_points(label), state.poses[-1], room)

    # --- the active part ---------------------------------------------------------------------------------

    def deactivate_distant(self) -> None:
        """Restrict each step to what the window can touch, and some room for the next cycles.

        This changes no result, see `graph.inactive`. An open curve's inactive part grows as the vehicle
        drives on. A closed curve's active part is chosen again when it no longer holds what the window needs.
        """
        state = self.map.state
        needed = {label: self._needed(label) for label in state.boundaries}
        if not all(
            _holds(state.active(label), indices, state.boundaries[label].size)
            for label, indices in needed.items()
        ):
            self.activate(np.concatenate([state.keys(label)[indices] for label, indices in needed.items()]))
        elif not self._is_worthwhile(needed):
            return
        active = {label: self._needed(label, self.map.settings.far.room) for label in state.boundaries}
        leaving = [np.setdiff1d(state.active(label), indices) for label, indices in active.items()]
        if not any(map(len, leaving)):
            return
        keys = [state.keys(label)[indices] for label, indices in zip(active, leaving, strict=True)]
        self.deactivate(np.concatenate(keys))
        state.activate_only(active)
        self.carry()

    def _is_worthwhile(self, needed: dict[int, IntArray]) -> bool:
        """Whether a closed curve is active all around, or an open one has enough behind the vehicle."""
        state, settings = self.map.state, self.map.settings
        behind = [0]
        for label, indices in needed.items():
            if state.boundaries[label].periodic:
                return state.whole
            behind.append(int(indices[0] - state.active(label)[0]))
        return max(behind) * settings.spline.spacing >= settings.far.stretch

    def _needed(self, label: int, room: float = 0.0) -> IntArray:
        """Return the control points (k,) that the window sees until the next cycle, and `room` (m) ahead."""
        boundary, pose_u = self.map.state.boundaries[label], self.map.state.pose_u[label]
        gate, slide = self.map.settings.gate, self.map.settings.spline.refine_room
        low = float(pose_u.min()) - gate.view_behind - slide
        high = float(pose_u.max()) + gate.view_ahead + gate.station_ahead + slide + room
        if boundary.periodic and high - low >= boundary.length:
            return boundary.everything
        first, last = boundary.tables.locate(np.array([low, high]))[0]
        if not boundary.periodic:
            return np.arange(first, boundary.size)
        last += boundary.degree + (boundary.size if last < first else 0)
        if last - first >= boundary.size - 1:
            return boundary.everything
        return np.arange(first, last + 1) % boundary.size


def _holds(active: IntArray, needed: IntArray, size: int) -> bool:
    """Return whether one stretch of a boundary's `size` control points holds another; indices may wrap."""
    return int(needed[0] - active[0]) % size + len(needed) <= len(active)
