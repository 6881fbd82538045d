"""Record of the measurements and poses of a drive, from which a batch of the lap is built."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain as chain_of
from typing import Final, Generic, TypeVar

import numpy as np

from pathspace_graph.batch.lap import OpenLap
from pathspace_graph.batch.start import StartMap, unwrap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray, read_only
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.log_odometry import chained
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.mapping.road import Road
from pathspace_graph.places.passes import SeenIn
from pathspace_graph.settings.mapper import MapperSettings

T = TypeVar("T")
C = TypeVar("C", bound=DetectionColumns)


class CycleList(Copyable, Generic[T]):
    """List that only grows, with one item per cycle; copies share all but the newest items."""

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
    """Measurements of a cycle."""

    motion: MeasuredMotion  # motion from the previous cycle
    seen: Detections  # detections of boundary cones, with stated covariances
    orange: Detections  # detections of orange cones


class DriveRecord(Copyable):
    """Odometry, detections and poses of every cycle, as long as a batch can solve them."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.unsolvable: str | None = None  # reason why no batch can solve the drive, if there is one
        self.poses: Array = np.zeros((0, 3))  # (P, 3) online poses, or those of the newest batch; map frame
        self.corrected: Array = self.poses  # (k, 3) poses of the first k cycles after the last correction
        self.stamps: CycleList[float] = CycleList()  # stamp of each cycle (s)
        self._measured: CycleList[MeasuredCycle] = CycleList()
        self._factors: tuple[Rows, ...] = ()  # user factors on poses, at values of zero

    def give_up(self, reason: str) -> None:
        """Drop the measurements, as no batch can solve them; the first reason is kept."""
        self.unsolvable = self.unsolvable or reason
        self._measured, self._factors = CycleList(), ()

    def measured(self, reading: Reading) -> None:
        """Add the motion and the detections of a cycle."""
        self.stamps.append(reading.detections.t)
        if self.unsolvable is not None:
            return
        self._measured.append(MeasuredCycle(reading.motion, *reading.stated))
        if len(self.stamps) > self.settings.open_lap.max_cycles:
            self.give_up("the lap is too long for a batch")

    def given(self, rows: Sequence[Rows] | None) -> None:
        """Add user factors on poses, as rows at values of zero; None for factors that no batch can have."""
        if rows is None and self.unsolvable is None:
            self.give_up("the user's factors hold control points, and a batch has other ones")
        elif rows and self.unsolvable is None:
            self._factors = (*self._factors, *rows)

    def estimated(self, road: Road) -> None:
        """Add the newest pose, unless the loop has closed and no batch needs it."""
        if not road.closed or self.unsolvable is None:
            self.poses = read_only(np.concatenate([self.poses, road.poses[-1:]]))

    def with_window(self, road: Road) -> Array:
        """Return the poses (P, 3) of all cycles, with the present ones of the window."""
        return unwrap(np.concatenate([self.poses[: road.smoother.first_cycle], road.poses]))

    def replaced(self, poses: Array) -> None:
        """Replace the poses (P, 3) of all cycles."""
        self.poses = self.corrected = read_only(unwrap(poses))

    def seen_in(self, sensor: Array, noise: NoiseLearner) -> SeenIn:
        """Return a lookup of the detections of given cycles, of orange cones too.

        Points are corrected by the calibration of the sensor, (5,) or (0,).
        """

        def seen_in(cycles: IntArray) -> DetectionColumns:
            chosen = [self._measured[k] for k in cycles.tolist()]
            twists = np.array([one.motion.odometry.twist for one in chosen]).reshape(-1, POSE)
            table = DetectionColumns.of([one.seen.with_others(one.orange) for one in chosen], twists=twists)
            table = replace(_for_map(table, noise), cycle=cycles[table.cycle])
            table.correct(sensor)
            return table

        return seen_in

    def lap(
        self,
        first_kept: int,
        start: StartMap | None,
        revisits: tuple[Revisit, ...],
        settings: MapperSettings,
        noise: NoiseLearner,
    ) -> OpenLap:
        """Return the drive for a batch, with the priors of the calibrations in `settings`."""
        cycles = [*self._measured]
        motions = noise.motions_of_lap([one.motion for one in cycles])
        chain = chained([*self.stamps], motions, settings.odometry)
        table = DetectionTable.of([one.seen for one in cycles], twists=chain.twists)
        return OpenLap(settings, chain, _for_map(table, noise), first_kept, start, revisits, self._factors)


def _for_map(table: C, noise: NoiseLearner) -> C:
    """Return a table with the corrections and covariances of the noise known now."""
    known = noise.for_map(Detections(0.0, table.measured, table.covariance, table.label))
    return replace(table, measured=known.points_vehicle, covariance=known.covariances)
