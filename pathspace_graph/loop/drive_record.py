"""The drive as it was measured, and its poses along the curves: what a batch of the lap is made of."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain as chain_of
from typing import Final, Generic, TypeVar

import numpy as np

from pathspace_graph.batch.lap import ClosedMap, OpenLap
from pathspace_graph.batch.start import unwrap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray, read_only
from pathspace_graph.factors.se2 import path_lengths, to_map, to_vehicle, wrap_angle
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.log_odometry import chained
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.constellation import SeenIn
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings

T = TypeVar("T")
C = TypeVar("C", bound=DetectionColumns)


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


class CycleList(Copyable, Generic[T]):
    """A list that only grows, with one item for each cycle; its copies share all but the newest items."""

    BLOCK: Final = 200  # items of a shared block

    def __init__(self) -> None:
        self._blocks: tuple[list[T], ...] = ()
        self._newest: list[T] = []

    def __len__(self) -> int:
        return self.BLOCK * len(self._blocks) + len(self._newest)

    def __iter__(self) -> Iterator[T]:
        return chain_of.from_iterable((*self._blocks, self._newest))

    def __getitem__(self, cycle: int) -> T:
        block, item = divmod(cycle, self.BLOCK)
        return self._newest[item] if block == len(self._blocks) else self._blocks[block][item]

    def append(self, item: T) -> None:
        self._newest.append(item)
        if len(self._newest) == self.BLOCK:
            self._blocks, self._newest = (*self._blocks, self._newest), []


@dataclass(frozen=True, eq=False)
class MeasuredCycle:
    """What was measured up to a cycle and in it."""

    motion: MeasuredMotion  # that leads to the cycle
    seen: Detections  # as they came
    orange: Detections  # those of orange cones


class DriveRecord(Copyable):
    """The odometry, the detections and the poses of every cycle, kept as long as a batch can solve them."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.unsolvable: str | None = None  # why the drive cannot be solved as a batch; None if it can be
        self.poses: Array = np.zeros((0, 3))  # of each cycle, map frame, as of then or the newest batch
        self.corrected: Array = self.poses  # (k, 3) of the first k cycles, as they were replaced last
        self.stamps: CycleList[float] = CycleList()  # stamp of each cycle (s)
        self._measured: CycleList[MeasuredCycle] = CycleList()
        self._factors: tuple[Rows, ...] = ()  # of the user's factors on poses, at values of zero

    def give_up(self, reason: str) -> None:
        """Drop the measurements; the first reason counts."""
        self.unsolvable = self.unsolvable or reason
        self._measured, self._factors = CycleList(), ()

    def measured(self, reading: Reading) -> None:
        """Add the motion that leads to a pose, and the detections there as they came."""
        self.stamps.append(reading.detections.t)
        if self.unsolvable is not None:
            return
        self._measured.append(MeasuredCycle(reading.motion, *reading.stated))
        if len(self.stamps) > self.settings.open_lap.max_cycles:
            self.give_up("the lap is too long for a batch")

    def given(self, rows: Sequence[Rows] | None) -> None:
        """Add the user's factors on poses, as rows at values of zero; None where a batch can't have them."""
        if rows is None and self.unsolvable is None:
            self.give_up("the user's factors hold control points, which are others in a batch")
        elif rows and self.unsolvable is None:
            self._factors = (*self._factors, *rows)

    def estimated(self, road: Road) -> None:
        """Add the newest pose, unless the loop has closed and no batch needs it."""
        if not road.closed or self.unsolvable is None:
            self.poses = read_only(np.concatenate([self.poses, road.poses[-1:]]))

    def with_window(self, road: Road) -> Array:
        """Return the poses (P, 3) of all cycles: those of the window are as they are now."""
        return unwrap(np.concatenate([self.poses[: road.smoother.first_cycle], road.poses]))

    def replaced(self, poses: Array) -> None:
        """Replace the poses (P, 3) of all cycles."""
        self.poses = self.corrected = read_only(unwrap(poses))

    def bent(self, keyframes: Mapping[int, Array], road: Road) -> None:
        """Replace the poses: the window has its own, earlier ones move with the keyframes (3,), by cycle."""
        first = road.smoother.first_cycle
        earlier, window = unwrap(self.poses[: first + 1]), road.poses
        bent = bend(earlier, {0: earlier[0], **keyframes, first: window[0]})
        self.replaced(np.concatenate([bent[:first], window]))

    def seen_in(self, sensor: Array, noise: NoiseLearner) -> SeenIn:
        """Return the cones detected in some cycles, corrected by the sensor's calibration: (5,) or (0,)."""

        def seen_in(cycles: IntArray) -> DetectionColumns:
            chosen = [self._measured[k] for k in cycles.tolist()]
            twists = np.array([one.motion.odometry.twist for one in chosen]).reshape(-1, POSE)
            table = DetectionColumns.of([one.seen.with_others(one.orange) for one in chosen], twists=twists)
            table = replace(_for_map(table, noise), cycle=cycles[table.cycle])
            table.correct(sensor)
            return table.cones(self.settings.lines)

        return seen_in

    def lap(
        self, first_kept: int, start: ClosedMap | Revisit, settings: MapperSettings, noise: NoiseLearner
    ) -> OpenLap:
        """Return the lap; the priors of its calibrations are those of the settings, which may be wide."""
        cycles = [*self._measured]
        motions = noise.motions_of_lap([one.motion for one in cycles])
        chain = chained([*self.stamps], motions, settings.odometry)
        table = DetectionTable.of([one.seen for one in cycles], twists=chain.twists)
        return OpenLap(settings, chain, _for_map(table, noise), first_kept, start, self._factors)


def _for_map(table: C, noise: NoiseLearner) -> C:
    """Return a table as it counts in a map, with the noise that is known now."""
    known = noise.for_map(Detections(0.0, table.measured, table.covariance, table.label))
    return replace(table, measured=known.points_vehicle, covariance=known.covariances)
