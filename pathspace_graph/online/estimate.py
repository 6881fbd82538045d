"""What the fixed-lag mapper gives: the map, what is ahead, the vehicle's state, and the graph itself."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors import gtsam_factors
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import odometry_factor
from pathspace_graph.graph.variables import POINT, POSE, control_keys, name, pose_key, pose_keys
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import LapBatches, VehicleState
from pathspace_graph.lengths import POSE as POSE_LENGTHS
from pathspace_graph.lengths import scaled, times
from pathspace_graph.loop.track_loop import TrackLoop
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.detections import NO_STATION
from pathspace_graph.mapping.motion import vehicle_state, with_size
from pathspace_graph.mapping.orange import OrangeCones
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.run import Readings
from pathspace_graph.settings.mapper import GaugeSettings, MapperSettings
from pathspace_graph.spline.ahead import CurveAhead, TrackAhead, check_line, track_ahead
from pathspace_graph.spline.boundary import Boundary

from .growth import Growth
from .outlook import Outlook, confirmed, curves_ahead, joint_covariance_of, look_ahead


class MapperEstimate:
    """What a fixed-lag mapper can be asked; to ask changes nothing of the estimate."""

    settings: MapperSettings
    scale: float
    smoother: CurveSmoother
    path: DrivenPath
    growth: Growth
    orange: OrangeCones
    loop: TrackLoop
    new_road: "MapperEstimate | None"

    def __repr__(self) -> str:
        times, name = self.smoother.times, type(self).__name__
        if not times:
            return f"{name}(no cycle yet)"
        poses = f"{self.smoother.next_cycle} cycles up to {times[-1]:.1f} s, {len(times)} poses in the window"
        return f"{name}({poses},\n    {self.outline()})"

    def map(self) -> Map:
        """Return a copy of the present map, with the joint covariance of each boundary's control points.

        An open curve goes on beyond its confirmed end, as `outline` says.
        """
        with self.looked_at():
            return scaled(replace(self._map(), points=self.orange.points()), self.scale)

    def _map(self) -> Map:
        """Return the map without points; a closed curve with few control points has its scatter added."""
        track, outlooks = self.smoother.map, self._outlooks()
        if not outlooks:
            return Map(self.closed, {})
        newest = pose_keys(np.array([self.smoother.next_cycle - 1]))
        joint = self.smoother.covariance(np.concatenate([track.state.map_keys, newest]))
        lengths = np.concatenate([track.state.map_points.ravel(), self.poses[-1, :2], [0.0]])
        joint = with_size(joint, lengths, self.loop.sigma_size)
        if self.closed:
            sizes, shape = [len(one.known) for one in outlooks.values()], self.settings.spline.sigma_shape
            sigmas = [track.scatter.get(b, np.full(n, shape)) for b, n in zip(outlooks, sizes, strict=True)]
            joint = joint[:-POSE, :-POSE] + np.diag(np.repeat(np.concatenate(sigmas), POINT) ** 2)
            blocks = [slice(*ends) for ends in pairwise([0, *(POINT * np.cumsum(sizes)).tolist()])]
        else:
            joint, blocks = joint_covariance_of(list(outlooks.values()), joint, self.poses[-1])
        boundaries = {
            label: SplineBoundary(outlook.spline, joint[block, block].copy(), outlook.confirmed_until)
            for (label, outlook), block in zip(outlooks.items(), blocks, strict=True)
        }
        return Map(self.closed, boundaries, joint)

    def outline(self) -> Map:
        """Return a copy of the present map without covariances, which takes a hundredth of the time.

        Past `confirmed_until` an open curve is tentative: fitted in each call through cones that were seen
        less often. A curve that has not begun may consist of a tentative stretch alone.
        """
        with self.looked_at():
            boundaries = {
                label: SplineBoundary(outlook.spline, NO_COVARIANCE, outlook.confirmed_until)
                for label, outlook in self._outlooks().items()
            }
        return scaled(Map(self.closed, boundaries, points=self.orange.points()), self.scale)

    def ahead(self, distance: float, step: float = 1.0) -> TrackAhead:
        """Return the next `distance` metres of the track in the vehicle's frame, `step` (m) apart.

        It is fast, for a controller in each cycle. While the loop is open, it goes on beyond the confirmed
        ends through the cones of `outline`, and says where. While the vehicle is lost on a closed map, it is
        the road as mapped since then. SettingsError is raised where a length is out of its range.
        """
        check_line(distance, step, self.scale)
        return scaled(self._ahead(distance / self.scale, step / self.scale), self.scale)

    def _ahead(self, distance: float, step: float) -> TrackAhead:
        if not self.smoother.times:
            return track_ahead({}, np.zeros(POSE), distance, step)
        if self.new_road is not None:
            return self.new_road._ahead(distance, step)
        pose, state = self.poses[-1], self.smoother.map.state
        if not self.closed:
            t = self.smoother.times[-1]
            curves = curves_ahead(self.smoother.map, self.growth.tentative, self.path, t)
            return track_ahead(curves, pose, distance, step)
        curves = {}
        for label, boundary in self.boundaries.items():
            points, beside = boundary.extended(state.control_points(label)), float(state.pose_u[label][-1])
            curves[label] = CurveAhead(boundary.tables, points, beside)
        return track_ahead(curves, pose, distance, step)

    def looked_at(self) -> AbstractContextManager[None]:
        """Return a context in which the mapper may be asked for anything, and its estimate stays as it is.

        Without it, `control_points` refreshes the inactive part of an open map, and may move later estimates
        by millimetres.
        """
        return self.smoother.variables.looked_at()

    def readings(self) -> Readings:
        """Return the detections of the newest cycle as they were used or gated, with their foot points.

        A foot point is that of the last linearization, on the curve as it is now.
        """
        track, table = self.smoother.map, self.smoother.map.detections
        newest = slice(int(table.cycle.searchsorted(self.smoother.next_cycle - 1)), None)
        used, boundary = table.used[newest].copy(), table.boundary[newest].copy()
        points = table.points_map(newest, track.variables)
        feet = np.full(points.shape, np.nan)
        for label, curve in self.boundaries.items():
            on = np.flatnonzero(used & (boundary == label))
            if len(on):
                feet[on] = curve.evaluate(track.state.control_points(label), table.u[newest][on])
        return scaled(Readings(points, boundary, used, feet), self.scale)

    def vehicle_state(self) -> VehicleState:
        """Return the newest pose and the calibration, with their joint covariance."""
        with self.looked_at():
            return scaled(vehicle_state(self.smoother, self.loop.sigma_size), self.scale)

    def _outlooks(self) -> dict[int, Outlook]:
        self.smoother.refresh()
        if self.closed or self.smoother.next_cycle == 0:
            return confirmed(self.smoother.map)
        return look_ahead(self.smoother.map, self.growth.tentative, self.path, self.smoother.times[-1])

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the window as GTSAM factors: projection, spacing, smoothness, odometry, your own and prior.

        The factors hold the active variables, which `values` returns. Linearized at the estimate, they are
        the mapper's own system in GTSAM's tangents of the poses. The graph shares nothing with the mapper:
        optimize it, print its errors, or compute its marginals with GTSAM's own classes.
        """
        smoother, track, settings = self.smoother, self.smoother.map, self.settings
        factors: list[gtsam.NonlinearFactor] = []
        anchor = gtsam.noiseModel.Isotropic.Sigma(2, settings.gauge.sigma_anchor)
        for label, boundary in self.boundaries.items():
            active = track.state.active(label)
            factors += [*_detection_factors(track, label, active), *_station_factors(track, label)]
            if not track.held_by_prior:
                factors += _gauge_factors(label, boundary, active, settings.gauge)
            keys = control_keys(label, boundary.first + active).tolist()
            points = track.state.control_points(label)[active]
            factors += [gtsam.PriorFactorPoint2(*pair, anchor) for pair in zip(keys, points, strict=True)]
        intervals = enumerate(smoother.window.odometry.intervals, start=smoother.first_cycle)
        factors += [odometry_factor(cycle, interval) for cycle, interval in intervals]
        factors += smoother.user_factors.factors
        prior = factors_of(smoother.absolute_prior())
        factors += [as_nonlinear(factor, smoother.variables) for factor in prior]
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        return graph

    def values(self) -> gtsam.Values:
        """Return the active variables: poses as `Pose2`, control points and the calibration as points."""
        return self.smoother.variables.gtsam_values(self.smoother.layout.keys)

    def marginal_covariance(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance (q, q) of any variables (k,), in the order of their keys.

        Control points are in m, poses (x, y, theta) in m and rad, both in the map frame; the calibration is
        (-, rad/s). SettingsError is raised for a key of a pose outside the window or of former knots.
        """
        wanted = np.array(keys, np.intp)
        unknown = wanted[self.smoother.variables.layout.positions(wanted) == UNKNOWN_PLACE]
        if len(unknown):
            first, last = self.smoother.first_cycle, self.smoother.next_cycle - 1
            raise SettingsError(
                f"covariance of {name(unknown[0])}: expected keys of poses x{first} to x{last}, "
                "of control points of the present curves, or of the calibration"
            )
        return self.smoother.covariance(wanted)

    @staticmethod
    def pose_key(cycle: int) -> int:
        """Return GTSAM's key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Return the key of the pose that the next update adds."""
        return pose_key(self.smoother.next_cycle)

    def control_keys(self, label: int) -> list[int]:
        """Return the keys of a boundary's control points, which change only when the loop closes."""
        keys: list[int] = self.smoother.map.state.keys(label).tolist()
        return keys

    # --- the loop ----------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Return whether the loop has closed: the map has its final size."""
        return self.loop.closed

    @property
    def corrected_poses(self) -> Array:
        """Return the poses (k, 3) of the first k cycles as the closing of the loop has corrected them."""
        return self.loop.corrected_poses

    def smoothed(self, t: Array) -> Array:
        """Return the corrected poses (n, 3) of the cycles at stamps (n,); NaN after the last of them."""
        poses: Array = times(self.corrected_poses, POSE_LENGTHS, self.scale)
        stamps = np.array(self.loop.record.stamps[: len(poses)])
        found, known = np.full((len(t), 3), np.nan), t <= stamps.max(initial=-np.inf)
        found[known] = poses[np.maximum(stamps.searchsorted(t[known], side="right") - 1, 0)]
        return found

    @property
    def revisits(self) -> tuple[Revisit, ...]:
        """Return the poses measured in the frame of earlier ones, where an open road was driven twice."""
        return tuple(self.loop.revisits.found)

    @property
    def closed_by(self) -> tuple[Revisit, ...]:
        """Return the pose measured in the frame of one of the beginning, by which a batch closed the loop."""
        return (self.loop.closed_by,) if self.closed and self.loop.closed_by else ()

    @property
    def lap_seconds(self) -> float:
        """Return the wall time (s) of the batch of the lap, once it has replaced the prior."""
        return self.loop.lap_seconds

    def wait(self) -> None:
        """Wait for the batch whose result the next update may take, however long that takes.

        A replay calls this before each update, so that the same log always gives the same map.
        """
        self.loop.solver.wait(self.smoother.next_cycle)

    def batches(self) -> LapBatches:
        """Return the cycles in which batches of the lap have ended, and how late they would have been."""
        return LapBatches(self.loop.solver.ends(self.smoother.next_cycle), self.loop.solver.late_cycles)

    # --- the estimate ------------------------------------------------------------------------------------

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Return the curves by label; their control points are in `control_points`."""
        return self.smoother.map.state.boundaries

    def control_points(self, label: int) -> Array:
        """Return a view of a boundary's control points (m, 2) in m, map frame."""
        self.smoother.refresh()
        return self.smoother.map.state.control_points(label)

    @property
    def poses(self) -> Array:
        """Return a view of the poses (P, 3) in the window, the oldest first, map frame."""
        return self.smoother.variables.poses

    def window_poses(self) -> Array:
        """Return a copy of the poses (P, 3) in the window, the oldest first, map frame."""
        poses: Array = times(self.poses.copy(), POSE_LENGTHS, self.scale)
        return poses

    @property
    def calibration(self) -> Array:
        """Return a view of the odometry's calibration: (scale error [-], yaw-rate bias [rad/s])."""
        return self.smoother.variables.calibration


def _detection_factors(track: CurveMap, label: int, active: IntArray) -> list[gtsam.CustomFactor]:
    """Return a spline-projection factor for each cycle of the detections in use on a boundary.

    Foot points may move as far as a step refines them, where the curve is active.
    """
    detections, settings = track.detections, track.settings
    boundary, rows = track.state.boundaries[label], detections.used_on(label)
    u = detections.u[rows]
    before, past = _room(boundary, active, u, settings.spline.refine_room)
    return gtsam_factors.spline_projection_factors(
        pose_keys(detections.cycle[rows]),
        control_keys(label, boundary.numbers).tolist(),
        boundary.tables,
        points_vehicle=detections.measured[rows],
        covariances=detections.covariance[rows],
        low=u - before,
        high=boundary.within_trusted(u + past),
        sigma_model=settings.spline.sigma_model,
        huber=settings.gate.huber,
        sensor_key=track.variables.sensor_key,
        twists=detections.twist[rows],
    )


def _station_factors(track: CurveMap, label: int) -> list[gtsam.CustomFactor]:
    """Return a factor for each cycle of the detections on a boundary that have a station."""
    detections, stations = track.detections, track.stations
    rows = detections.used_on(label)
    rows = rows[detections.station[rows] != NO_STATION]
    if stations is None or len(rows) == 0:
        return []
    boundary, station = track.state.boundaries[label], detections.station[rows]
    return gtsam_factors.station_factors(
        pose_keys(detections.cycle[rows]),
        control_keys(label, boundary.numbers).tolist(),
        boundary.tables,
        u=stations.u[station],
        sigma_station=track.sigma_stations(station),
        points_vehicle=detections.measured[rows],
        covariances=detections.covariance[rows],
        twists=detections.twist[rows],
        huber=track.settings.gate.huber,
        sensor_key=track.variables.sensor_key,
    )


def _room(boundary: Boundary, active: IntArray, u: Array, room: float) -> tuple[Array, Array]:
    """Return how far before and past parameters (m,) the curve is active, at most `room`."""
    if len(active) == boundary.size:
        return np.full(len(u), room), np.full(len(u), room)
    p, begin = boundary.degree, boundary.knots[active[0] + boundary.degree]
    span = active[0] + np.arange(p, len(active))
    span = np.where(span >= boundary.size + p, span - boundary.size, span) if boundary.periodic else span
    widths = np.diff(boundary.knots)[span]
    after = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin
    return np.minimum(after, room), np.minimum(widths.sum() - after, room)


def _gauge_factors(
    label: int, boundary: Boundary, active: IntArray, settings: GaugeSettings
) -> list[gtsam.NonlinearFactor]:
    """Return spacing and smoothness factors between the active control points of a boundary."""
    gauge = boundary.gauge_on(active)
    keys = control_keys(label, boundary.first + np.arange(boundary.size)).tolist()
    factors: list[gtsam.NonlinearFactor] = []
    for pair, nominal in zip(gauge.pairs.tolist(), gauge.nominal[:, None], strict=True):
        sigma = settings.sigma_spacing * nominal
        factors += gtsam_factors.spacing_factors([keys[j] for j in pair], nominal, sigma, False)
    for triple, bending in zip(gauge.triples.tolist(), gauge.bending, strict=True):
        factors += gtsam_factors.smoothness_factors([keys[j] for j in triple], bending[None], 1.0)
    return factors
