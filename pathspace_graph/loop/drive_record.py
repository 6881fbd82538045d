"""The drive as it was measured, and its poses along the curves: what a batch of the lap is made of."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pathspace_graph.batch.lap import ClosedMap, OpenLap
from pathspace_graph.batch.start import unwrap
from pathspace_graph.factors.arrays import Array, IntArray, read_only
from pathspace_graph.factors.se2 import path_lengths, to_map, to_vehicle, wrap_angle
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.log_odometry import chained
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.variables import POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.constellation import SeenIn, return_to_beginning
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings


def bend(poses: Array, known: Mapping[int, Array]) -> Array:
    """Return the poses (n, 3) of a path bent so that some of them have known values (3,), by index.

    A pose between two of these is the mean of its places as seen from each, weighted by the nearness along
    the path. A pose after the last one moves with it.
    """
    at, along = np.array(sorted(known)), path_lengths(poses)
    before = at.searchsorted(np.arange(len(poses)), side="right") - 1
    after, values = np.minimum(before + 1, len(at) - 1), np.array([known[k] for k in at.tolist()])
    moved = []
    for nearest in (before, after):
        frames, to = poses[at[nearest]], values[nearest]
        points = to_map(to_vehicle(poses[:, :2], frames), to)
        moved.append(np.column_stack([points, poses[:, 2] + to[:, 2] - frames[:, 2]]))
    driven, way = along - along[at[before]], along[at[after]] - along[at[before]]
    weight = np.divide(driven, way, out=np.zeros_like(along), where=way > 0.0)[:, None]
    change = moved[1] - moved[0]
    change[:, 2] = wrap_angle(change[:, 2])
    return np.asarray(moved[0] + weight * change)


class DriveRecord:
    """The odometry, the detections and the poses of every cycle, kept as long as a batch can solve them."""

    def __init__(self, settings: MapperSettings, noise: NoiseLearner) -> None:
        self.settings = settings
        self._noise = noise
        self.unsolvable: str | None = None  # why the drive cannot be solved as a batch; None if it can be
        self.poses: Array = np.zeros((0, 3))  # of each cycle, map frame, as of then or the newest batch
        self.stamps: list[float] = []  # stamp of each cycle (s)
        self._motions: list[MeasuredMotion] = []  # that lead to each cycle
        self._seen: list[Detections] = []  # of each cycle, as they came
        self._orange: list[Detections] = []  # those of orange cones

    def give_up(self, reason: str) -> None:
        """Drop the measurements; the first reason counts."""
        self.unsolvable = self.unsolvable or reason
        self._motions, self._seen, self._orange = [], [], []

    def measured(self, reading: Reading) -> None:
        """Add the motion that leads to a pose, and the detections there as they came."""
        self.stamps.append(reading.detections.t)
        if self.unsolvable is not None:
            return
        seen, orange = reading.stated
        self._motions.append(reading.motion)
        self._seen.append(seen)
        self._orange.append(orange)
        if len(self.stamps) > self.settings.open_lap.max_cycles:
            self.give_up("the lap is too long for a batch")

    def estimated(self, state: State) -> None:
        """Add the newest pose, unless the loop has closed and no batch needs it."""
        if not state.closed or self.unsolvable is None:
            self.poses = read_only(np.concatenate([self.poses, state.poses[-1:]]))

    def with_window(self, smoother: CurveSmoother) -> Array:
        """Return the poses (P, 3) of all cycles: those of the window are as they are now."""
        return unwrap(np.concatenate([self.poses[: smoother.first_cycle], smoother.variables.poses]))

    def replaced(self, poses: Array) -> None:
        """Replace the poses (P, 3) of all cycles."""
        self.poses = read_only(unwrap(poses))

    def bent(self, keyframes: Mapping[int, Array], smoother: CurveSmoother) -> None:
        """Replace the poses: the window has its own, earlier ones move with the keyframes (3,), by cycle."""
        first = smoother.first_cycle
        earlier, window = unwrap(self.poses[: first + 1]), smoother.variables.poses
        bent = bend(earlier, {0: earlier[0], **keyframes, first: window[0]})
        self.replaced(np.concatenate([bent[:first], window]))

    def seen_in(self, sensor: Array) -> SeenIn:
        """Return the detections of some cycles, corrected by the calibration (5,) of the sensor, or (0,)."""

        def seen_in(cycles: IntArray) -> DetectionColumns:
            chosen = cycles.tolist()
            twists = np.array([self._motions[k].odometry.twist for k in chosen]).reshape(-1, POSE)
            seen = [self._seen[k].with_others(self._orange[k]) for k in chosen]
            table = DetectionColumns.of(seen, twists=twists)
            known = self._noise.for_map(Detections(0.0, table.measured, table.covariance, table.label))
            table = replace(table, measured=known.points_vehicle, covariance=known.covariances)
            table = replace(table, cycle=cycles[table.cycle])
            table.correct(sensor)
            return table

        return seen_in

    def return_to_beginning(self, covariance: Array, sensor: Array) -> Revisit | None:
        """Return the newest pose beside an early one, if the newest cones lie on those of the beginning."""
        return return_to_beginning(self.seen_in(sensor), unwrap(self.poses), covariance, self.settings)

    def lap(self, first_kept: int, start: ClosedMap | Revisit, settings: MapperSettings) -> OpenLap:
        """Return the lap; the priors of its calibrations are those of the settings, which may be wide."""
        chain = chained(self.stamps, self._noise.motions_of_lap(self._motions), settings.odometry)
        table = DetectionTable.of(self._seen, twists=chain.twists)
        seen = self._noise.for_map(Detections(0.0, table.measured, table.covariance, table.label))
        table = replace(table, measured=seen.points_vehicle, covariance=seen.covariances)
        return OpenLap(settings, chain, table, first_kept, start)
