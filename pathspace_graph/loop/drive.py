"""The drive, which all phases share: its record and its batches. And the interface of a phase."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain as chain_of
from math import nan
from typing import ClassVar, Final, Generic, TypeVar

import gtsam
import numpy as np

from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.lap import LapMarginal, OpenLap
from pathspace_graph.batch.start import StartMap, unwrap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray, read_only
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.factors.se2 import compose, inverse, path_lengths, relative
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.log_odometry import chained
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.graph.variables import POSE
from pathspace_graph.health import Health, HealthMonitor
from pathspace_graph.io.log import Detections
from pathspace_graph.mapping.detections import DetectionColumns, DetectionTable
from pathspace_graph.mapping.motion import MeasuredMotion, inflate_priors
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.mapping.state import GivenFactor
from pathspace_graph.places.find import LOOKUP_RANGE, SeenIn
from pathspace_graph.settings.mapper import MapperSettings

from .closing import take_known, take_marginal
from .known_loop import evidence_of
from .lap_solver import LapSolver, Outcome

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


MOST_CYCLES: Final = 20000  # most cycles of an open lap that is solved as a batch; a longer one stays open


@dataclass(frozen=True, eq=False)
class MeasuredCycle:
    """Measurements of a cycle."""

    motion: MeasuredMotion  # motion from the previous cycle
    seen: Detections  # detections of boundary cones, with stated covariances
    orange: Detections  # detections of orange cones


class DriveRecord(Copyable):
    """Odometry, detections and poses of every cycle, as long as a batch can solve them."""

    def __init__(self) -> None:
        self.unsolvable: str | None = None  # reason why no batch can solve the drive, if there is one
        self.poses: Array = np.zeros((0, 3))  # (P, 3) online poses, or those of the newest batch; map frame
        self.corrected: Array = self.poses  # (k, 3) poses of the first k cycles after the last correction
        self.reckoned: Array = self.poses  # (P, 3) by the motion of each cycle as it was estimated then
        self.stamps: CycleList[float] = CycleList()  # stamp of each cycle (s)
        self._measured: CycleList[MeasuredCycle] = CycleList()
        self.factors: tuple[GivenFactor, ...] = ()  # the user's factors

    def give_up(self, reason: str) -> None:
        """Drop the measurements, as no batch can solve them; the first reason is kept."""
        self.unsolvable = self.unsolvable or reason
        self._measured, self.factors = CycleList(), ()

    def measured(self, reading: Reading) -> None:
        """Add the motion and the detections of a cycle."""
        self.stamps.append(reading.detections.t)
        if self.unsolvable is not None:
            return
        self._measured.append(MeasuredCycle(reading.motion, *reading.stated))
        if len(self.stamps) > MOST_CYCLES:
            self.give_up("the lap is too long for a batch")

    def given(self, factors: Sequence[gtsam.NonlinearFactor], road: Road) -> None:
        """Add user factors of the newest cycle."""
        if factors and self.unsolvable is None:
            state, cycle = road.smoother.map.state, road.next_cycle - 1
            self.factors = (*self.factors, *(GivenFactor.of(one, state, cycle) for one in factors))

    def linearize(self, road: Road) -> None:
        """Linearize the user factors on control points again that the road still has."""
        state = road.smoother.map.state
        known = set(state.variables.keys.tolist())
        self.factors = tuple(
            GivenFactor.of(one.factor, state, one.cycle)
            if one.points and known.issuperset(keys_of_factor(one.factor).tolist())
            else one
            for one in self.factors
        )

    def estimated(self, road: Road) -> None:
        """Add the newest pose, unless the loop has closed and no batch needs it."""
        if not road.closed or self.unsolvable is None:
            self.poses = read_only(np.concatenate([self.poses, road.poses[-1:]]))
            pose = road.poses[-1]
            if len(self.reckoned) and len(road.poses) > 1:
                pose = compose(self.reckoned[-1], relative(road.poses[-2], pose))
            self.reckoned = read_only(np.concatenate([self.reckoned, pose[None]]))

    def with_window(self, road: Road) -> Array:
        """Return the poses (P, 3) of all cycles, with the present ones of the window."""
        return unwrap(np.concatenate([self.poses[: road.smoother.first_cycle], road.poses]))

    def with_newest_path(self, road: Road, length: float) -> Array:
        """Return `with_window` where the newest path of a length (m) has kept its shape.

        An update may turn the window by more than cones tell apart, and poses before it are older.
        """
        poses, stations = self.with_window(road), path_lengths(self.reckoned)
        newest = stations > stations[-1] - length
        frame = compose(poses[-1], inverse(self.reckoned[-1]))
        poses[newest] = compose(frame, self.reckoned[newest])
        return unwrap(poses)

    def replaced(self, poses: Array) -> None:
        """Replace the poses (P, 3) of all cycles."""
        self.poses = self.corrected = read_only(unwrap(poses))

    def seen_in(self, sensor: Array, noise: NoiseLearner) -> SeenIn:
        """Return a lookup of the detections of given cycles within `LOOKUP_RANGE`, of orange cones too.

        Points are corrected by the calibration of the sensor, (5,) or (0,).
        """

        def seen_in(cycles: IntArray) -> DetectionColumns:
            chosen = [self._measured[k] for k in cycles.tolist()]
            twists = np.array([one.motion.odometry.twist for one in chosen]).reshape(-1, POSE)
            table = DetectionColumns.of([one.seen.with_others(one.orange) for one in chosen], twists=twists)
            table = table.where(np.hypot(*table.measured.T) < LOOKUP_RANGE)
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
        motions = [one.motion for one in cycles]
        steps, biases = noise.odometry_of_lap(motions), [one.bias for one in motions]
        chain = chained([*self.stamps], steps, settings.odometry, biases)
        table = DetectionTable.of([one.seen for one in cycles], twists=chain.twists)
        factors = tuple(one for one in self.factors if one.cycle < first_kept)
        return OpenLap(settings, chain, _for_map(table, noise), first_kept, start, revisits, factors)


def _for_map(table: C, noise: NoiseLearner) -> C:
    """Return a table with the corrections and covariances of the noise known now."""
    known = noise.for_map(Detections(0.0, table.measured, table.covariance, table.label))
    return replace(table, measured=known.points_vehicle, covariance=known.covariances)


# --- the record of a drive -------------------------------------------------------------------------------


REST: Final = 10.0  # distance after a failure on which phases do nothing (m)
KNOWN: Final = "the map was known before the drive"  # reason why a drive on a known map has no batch
LEARNED: Final = "the drive contradicts the prior of the calibration, which is estimated with a wider one"
"""Notice of the first cycle with wider priors of the calibrations."""


class Drive(Copyable):
    """What the phases share: record, batches, health monitor and priors of the calibrations."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.priors = settings  # settings with the present priors of the calibrations
        self.record = DriveRecord()
        self.solver = LapSolver(settings)
        self.monitor = HealthMonitor()
        self.revisits: tuple[Revisit, ...] = ()
        """Relative poses by which the open map was optimized where road was met again."""
        self.closed_by: Revisit | None = None  # relative pose that started the batch of the loop closure
        self.lap_seconds = nan  # wall time of the batch of the present map (s)
        self.placed_at: float | None = None  # stamp of the localization on a known map (s)
        self.keeps_map = False  # whether the known map is fixed
        self._rests_until = 0.0  # path (m)

    # --- priors and health -------------------------------------------------------------------------------

    def inflate_priors(self, road: Road, reading: Reading) -> str:
        """Widen the priors of calibrations that an open drive contradicts; return a notice the first time."""
        before = self.priors
        doubted, measured = reading.sensor_doubted, reading.measured
        self.priors = inflate_priors(road.smoother, before, doubted, measured)
        contradicted = doubted or measured is None
        is_new = before == self.settings != self.priors and contradicted
        return LEARNED if is_new else ""

    @property
    def can_repair(self) -> bool:
        """Whether a closed map can be repaired: by a batch of the drive, or a known map in place."""
        return self.record.unsolvable is None or (self.placed_at is not None and not self.keeps_map)

    # --- rest after a failure ----------------------------------------------------------------------------

    def rest(self, road: Road) -> None:
        """Cancel the running batch, and rest for `REST` metres."""
        self._rests_until = road.path.length + REST
        self.solver.give_up(road.next_cycle)

    def rests(self, road: Road) -> bool:
        return road.path.length < self._rests_until

    # --- batches -----------------------------------------------------------------------------------------

    def begin_batch(
        self, road: Road, noise: NoiseLearner, start: StartMap | None, revisits: tuple[Revisit, ...]
    ) -> None:
        """Start a batch of the drive with its revisits, from a map or from odometry."""
        self.record.linearize(road)
        window = road.smoother.first_cycle, road.next_cycle - 1
        lap = partial(self.record.lap, start=start, revisits=revisits, settings=self.priors, noise=noise)
        self.solver.begin(lap, window, road.smoother.times[-1])

    def outcome(self, road: Road, spent: float) -> Outcome | None:
        """Return the result of the batch if it is due in this cycle, which has taken `spent` (s)."""
        smoother = road.smoother
        return self.solver.outcome(road.next_cycle - 1, smoother.times, smoother.first_cycle, spent)

    def take(self, road: Road, solved: LapMarginal, revisit: Revisit | None = None) -> Array:
        """Replace the map by that of a batch, which a revisit may have started; return the jump (3,)."""
        if revisit is not None and solved.closed:
            self.closed_by = revisit
        elif revisit is not None:
            self.revisits = (*self.revisits, revisit)
        self.record.linearize(road)
        jump = take_marginal(road, solved, self.record.factors)
        self.lap_seconds = solved.seconds
        self._replaced(road, solved.poses[: solved.first_kept])
        return jump

    def take_known(self, road: Road, known: KnownMap, pose: Array, covariance: Array) -> Array:
        """Replace an open road by the known map on which the newest pose (3,) lies; return the jump (3,)."""
        motion = compose(pose, inverse(road.poses[-1]))
        earlier = compose(motion, self.record.with_window(road)[: road.smoother.first_cycle])
        self.solver.give_up(road.next_cycle)
        jump = take_known(road, known, pose, covariance)
        self._replaced(road, earlier)
        self.record.give_up(KNOWN)
        self.placed_at, self.keeps_map = road.smoother.times[-1], known.kept
        self.monitor.restart()
        return jump

    def _replaced(self, road: Road, earlier: Array) -> None:
        """Record the poses (k, 3) of the cycles before the window of a road with another map."""
        self.record.replaced(np.concatenate([earlier, road.poses]))
        road.orange.place(0, self.record.corrected)


@dataclass(frozen=True, eq=False)
class Step:
    """Result of a phase in a cycle."""

    phase: "Phase"  # phase of the next cycle
    jump: Array | None = None  # (3,) jump of the newest pose, if map or pose was replaced
    notice: str = ""
    health: Health | None = None  # health, if the phase has changed it


class Phase(Copyable):
    """What a cycle does besides mapping; this one never replaces the map."""

    uses_detections: ClassVar[bool] = True  # whether detections may change the road

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple["Phase", Health]:
        """Judge the estimate before its update; return the phase of this cycle, and the health."""
        return self, drive.monitor.update(evidence_of(road.smoother, classified.tested, None, reading))

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Act after the update of a cycle, which has taken `spent` (s); do nothing while the drive rests."""
        drive.record.estimated(road)
        return Step(self)

    def begin(self, road: Road, drive: Drive, noise: NoiseLearner) -> None:
        """Start the batch for which the last cycle has found a reason, if it has."""

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Continue from the result of a batch."""
        return Step(self)
