"""Read-only queries of the fixed-lag mapper: map, track ahead, state of the vehicle, and graph."""

from collections.abc import Sequence
from contextlib import AbstractContextManager

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.variables import UNKNOWN as UNKNOWN_PLACE
from pathspace_graph.graph.variables import name, pose_key
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import LapBatches, VehicleState
from pathspace_graph.loop.drive import Drive, Phase
from pathspace_graph.loop.lost import Lost
from pathspace_graph.mapping.motion import vehicle_state
from pathspace_graph.mapping.road import Road
from pathspace_graph.run import Readings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.ahead import TrackAhead, check_line, track_ahead
from pathspace_graph.spline.boundary import Boundary

from .gtsam_graph import window_graph
from .queries import readings_of, road_map, road_outline, smoothed_at, track_ahead_of


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

        An open curve includes the tentative stretch that `outline` describes.
        """
        return road_map(self.road, self._sigma_size)

    def outline(self) -> Map:
        """Return a copy of the map without covariances, in a hundredth of the time of `map`.

        Past `confirmed_until` an open curve is tentative: each call fits it through cones with fewer
        detections. A boundary without a confirmed curve may consist of a tentative stretch alone.
        """
        return road_outline(self.road)

    def ahead(self, distance: float, step: float = 1.0) -> TrackAhead:
        """Return the next `distance` metres of the track in the vehicle's frame, `step` (m) apart.

        The call is fast enough for a controller in each cycle. While the loop is open, the line continues
        past the confirmed ends through the cones of `outline`, and says where. There is none while the
        vehicle is lost. SettingsError is raised for a length out of its range.
        """
        check_line(distance, step)
        if isinstance(self.phase, Lost):
            return track_ahead({}, self.road.poses[-1], distance, step)
        return track_ahead_of(self.road, distance, step)

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
        return readings_of(self.road)

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
        return window_graph(self.road)

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
        keys: list[int] = self.road.smoother.map.state.keys(label).tolist()
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
        return smoothed_at(t, np.array([*self.drive.record.stamps][: len(poses)]), poses)

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
