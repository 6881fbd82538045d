"""Read-only queries of the fixed-lag mapper: map, track ahead, state of the vehicle, and graph."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from itertools import pairwise

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.gaussian import factors_of
from pathspace_graph.graph.rows import Revisit, odometry_factor
from pathspace_graph.graph.variables import POINT, POSE, name, pose_key, pose_keys
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.graph.window import as_nonlinear
from pathspace_graph.io.map import NO_CONES, NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import LapBatches, VehicleState
from pathspace_graph.loop.drive import Drive, Phase
from pathspace_graph.loop.lost import Lost
from pathspace_graph.mapping.gtsam_graph import curve_factors
from pathspace_graph.mapping.motion import vehicle_state, with_size
from pathspace_graph.mapping.road import Road
from pathspace_graph.run import Readings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.planning import CurveAhead, TrackAhead, check_line, track_ahead

from .outlook import Outlook, confirmed, curves_ahead, joint_covariance_of, look_ahead


class MapperEstimate:
    """Read-only queries of a fixed-lag mapper."""

    settings: MapperSettings
    road: Road
    drive: Drive
    phase: Phase

    def __repr__(self) -> str:
        times, name = self.road.smoother.times, type(self).__name__
        if not times:
            return f"{name}(no cycle yet)"
        poses = f"{self.road.next_cycle} cycles up to {times[-1]:.1f} s, {len(times)} poses in the window"
        return f"{name}({poses},\n    {self.outline()})"

    def map(self) -> Map:
        """Return a copy of the map, with the joint covariance of each boundary's control points.

        An open curve includes the tentative stretch that `outline` describes. The covariance of a closed
        curve includes the scatter of the cones about it.
        """
        road, track = self.road, self.road.smoother.map
        with self.looked_at():
            outlooks, points = self._outlooks(), road.orange_cones()
            if not outlooks:
                return Map(road.closed, {}, points=points)
            newest = pose_keys(np.array([road.next_cycle - 1]))
            joint = road.smoother.covariance(np.concatenate([track.state.map_keys, newest]))
            lengths = np.concatenate([track.state.map_points.ravel(), road.poses[-1, :2], [0.0]])
            joint = with_size(joint, lengths, self._sigma_size)
            if road.closed:
                sizes, shape = [len(one.known) for one in outlooks.values()], road.settings.spline.sigma_shape
                of_label = zip(outlooks, sizes, strict=True)
                sigmas = [track.scatter.get(label, np.full(size, shape)) for label, size in of_label]
                joint = joint[:-POSE, :-POSE] + np.diag(np.repeat(np.concatenate(sigmas), POINT) ** 2)
                blocks = [slice(*ends) for ends in pairwise([0, *(POINT * np.cumsum(sizes)).tolist()])]
            else:
                joint, blocks = joint_covariance_of(list(outlooks.values()), joint, road.poses[-1])
            cones = {} if road.settings.of_lines else track.cones
            boundaries = {
                label: SplineBoundary(
                    outlook.spline, joint[block, block], outlook.confirmed_until, cones.get(label, NO_CONES)
                )
                for (label, outlook), block in zip(outlooks.items(), blocks, strict=True)
            }
            return Map(road.closed, boundaries, joint, points)

    def outline(self) -> Map:
        """Return a copy of the map without covariances, in a hundredth of the time of `map`.

        Past `confirmed_until` an open curve is tentative: each call fits it through cones with fewer
        detections. A boundary without a confirmed curve may consist of a tentative stretch alone.
        """
        with self.looked_at():
            boundaries = {
                label: SplineBoundary(outlook.spline, NO_COVARIANCE, outlook.confirmed_until)
                for label, outlook in self._outlooks().items()
            }
        return Map(self.road.closed, boundaries, points=self.road.orange_cones())

    def _outlooks(self) -> dict[int, Outlook]:
        """Curves by label, open ones with their tentative stretches."""
        road = self.road
        road.smoother.refresh()
        if road.closed or road.next_cycle == 0:
            return confirmed(road.smoother.map)
        return look_ahead(road.smoother.map, road.growth.tentative, road.path, road.smoother.times[-1])

    def ahead(self, distance: float, step: float = 1.0) -> TrackAhead:
        """Return the next `distance` metres of the track in the vehicle's frame, `step` (m) apart.

        The call is fast enough for a controller in each cycle. While the loop is open, the line continues
        past the confirmed ends through the cones of `outline`, and says where. There is none while the
        vehicle is lost. SettingsError is raised for a length out of its range.
        """
        check_line(distance, step)
        road, track, curves = self.road, self.road.smoother.map, dict[int, CurveAhead]()
        if isinstance(self.phase, Lost) or not road.smoother.times:
            return track_ahead(curves, np.zeros(POSE), distance, step)
        if road.closed:
            for label, boundary in road.boundaries.items():
                points = boundary.extended(track.state.control_points(label))
                curves[label] = CurveAhead(boundary.tables, points, float(track.state.pose_u[label][-1]))
        else:
            curves = curves_ahead(track, road.growth.tentative, road.path, road.smoother.times[-1])
        return track_ahead(curves, road.poses[-1], distance, step)

    def looked_at(self) -> AbstractContextManager[None]:
        """Return a context in which no query changes the estimate.

        Outside of it, `control_points` refreshes the inactive part of an open map, which may move later
        estimates by millimetres.
        """
        return self.road.smoother.variables.looked_at()

    def readings(self) -> Readings:
        """Return the used and gated detections of the newest cycle, with foot points.

        Parameters of the foot points are of the last linearization, positions of the present curve.
        """
        track, table = self.road.smoother.map, self.road.smoother.map.detections
        newest = slice(int(table.cycle.searchsorted(self.road.next_cycle - 1)), None)
        used, boundary = table.used[newest].copy(), table.boundary[newest].copy()
        points = table.points_map(newest, track.variables)
        feet = np.full(points.shape, np.nan)
        for label, curve in self.road.boundaries.items():
            on = np.flatnonzero(used & (boundary == label))
            if len(on):
                feet[on] = curve.evaluate(track.state.control_points(label), table.u[newest][on])
        return Readings(points, boundary, used, feet)

    def vehicle_state(self) -> VehicleState:
        """Return the newest pose and the calibration, with their joint covariance."""
        with self.looked_at():
            return vehicle_state(self.road.smoother, self._sigma_size)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Return the window as GTSAM factors: projection, gauge, odometry, stations, user factors and prior.

        The factors are on the active variables, which `values` returns. Linearized at the estimate, they give
        the mapper's own system in GTSAM's tangent space of the poses. The graph shares nothing with the
        mapper: optimize it, print its errors, or compute its marginals with GTSAM's classes.
        """
        smoother, graph = self.road.smoother, gtsam.NonlinearFactorGraph()
        factors = [one for label in self.road.boundaries for one in curve_factors(smoother.map, label)]
        intervals = enumerate(smoother.window.odometry.intervals, start=smoother.first_cycle)
        factors += [odometry_factor(cycle, interval) for cycle, interval in intervals]
        prior = factors_of(smoother.absolute_prior())
        linear = [as_nonlinear(factor, smoother.variables) for factor in prior]
        for factor in (*factors, *smoother.user_factors.factors, *linear):
            graph.add(factor)
        return graph

    def values(self) -> gtsam.Values:
        """Return the active variables: poses as `Pose2`, control points and calibrations as points."""
        return self.road.smoother.variables.gtsam_values(self.road.smoother.layout.keys)

    def marginal_covariance(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance (q, q) of any variables (k,), in the order of their keys.

        Units are m for control points, m and rad for poses (x, y, theta), both in the map frame, and (-,
        rad/s) for the calibration. SettingsError is raised for a pose outside the window or a key of former
        knots.
        """
        wanted, smoother = np.array(keys, np.intp), self.road.smoother
        unknown = wanted[smoother.variables.layout.positions(wanted) == UNKNOWN_PLACE]
        if len(unknown):
            first, last = smoother.first_cycle, smoother.next_cycle - 1
            raise SettingsError(
                f"covariance of {name(unknown[0])}: expected keys of poses x{first} to x{last}, "
                "of control points of the present curves, or of the calibration"
            )
        return smoother.covariance(wanted)

    @staticmethod
    def pose_key(cycle: int) -> int:
        """Return the GTSAM key of the pose at a perception cycle, counted from 0."""
        return pose_key(cycle)

    @property
    def next_pose_key(self) -> int:
        """Return the key of the pose of the next update."""
        return pose_key(self.road.next_cycle)

    def control_keys(self, label: int) -> list[int]:
        """Return the keys of a boundary's control points; they change only when the map is replaced."""
        keys: list[int] = self.road.smoother.map.state.control_keys(label).tolist()
        return keys

    # --- the loop ----------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether the loop has closed."""
        return self.road.closed

    @property
    def placed_at(self) -> float | None:
        """Return the stamp (s) of the localization on the known map, if there was one."""
        return self.drive.placed_at

    @property
    def corrected_poses(self) -> Array:
        """Return the poses (k, 3) of the first k cycles, corrected by loop closure or revisits."""
        return self.drive.record.corrected

    def smoothed(self, t: Array) -> Array:
        """Return the corrected poses (n, 3) at stamps t (n,) of cycles; NaN after the last corrected one."""
        poses = self.corrected_poses
        stamps = np.array([*self.drive.record.stamps][: len(poses)])
        found, known = np.full((len(t), POSE), np.nan), t <= stamps.max(initial=-np.inf)
        found[known] = poses[np.maximum(stamps.searchsorted(t[known], side="right") - 1, 0)]
        return found

    @property
    def revisits(self) -> tuple[Revisit, ...]:
        """Return the relative poses by which the open map was optimized."""
        return self.drive.revisits

    @property
    def closed_by(self) -> tuple[Revisit, ...]:
        """Return the relative pose that started the batch of the loop closure, in a tuple of at most one."""
        return (self.drive.closed_by,) if self.drive.closed_by else ()

    @property
    def lap_seconds(self) -> float:
        """Return the wall time (s) of the batch of the present map; NaN without one."""
        return self.drive.lap_seconds

    def wait(self) -> None:
        """Wait without limit for the batch whose result may be due in the next update.

        A replay calls this before each update, so that a log always gives the same map.
        """
        self.drive.solver.wait(self.road.next_cycle)

    def batches(self) -> LapBatches:
        """Return the cycles in which batches ended, and how late they would have been in a vehicle."""
        solver = self.drive.solver
        return LapBatches(solver.ends(self.road.next_cycle), solver.late_cycles)

    # --- the estimate ------------------------------------------------------------------------------------

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Return the knots and cones of the curves by label; `control_points` has their control points."""
        return self.road.boundaries

    def control_points(self, label: int) -> Array:
        """Return a view of a boundary's control points (m, 2) in m, map frame."""
        self.road.smoother.refresh()
        return self.road.smoother.map.state.control_points(label)

    @property
    def poses(self) -> Array:
        """Return a view of the poses (P, 3) in the window, oldest first, map frame."""
        return self.road.poses

    def window_poses(self) -> Array:
        """Return a copy of the poses (P, 3) in the window, oldest first, map frame."""
        return self.poses.copy()

    @property
    def calibration(self) -> Array:
        """Return a view of the odometry's calibration: (scale error [-], yaw-rate bias [rad/s])."""
        return self.road.smoother.variables.calibration

    @property
    def _sigma_size(self) -> float:
        """Return the relative standard deviation of the map's size, if it is not estimated (-)."""
        return self.drive.priors.odometry.sigma_size
