"""The drive, which all phases share, and the interface of a phase."""

from dataclasses import dataclass
from functools import partial
from math import nan
from typing import ClassVar, Final

import numpy as np

from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.batch.start import StartMap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.health import Health, HealthMonitor
from pathspace_graph.mapping.motion import inflate_priors
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.settings.mapper import MapperSettings

from .closing import lay_on_known, swap_in
from .drive_record import DriveRecord
from .known_loop import evidence_of
from .lap_solver import LapSolver, Outcome

REST: Final = 10.0  # distance after a failure on which phases do nothing (m)
KNOWN: Final = "the map was known before the drive"  # reason why a drive on a known map has no batch
LEARNED: Final = "the drive contradicts the prior of the calibration, which is estimated with a wider one"
"""Notice of the first cycle with wider priors of the calibrations."""


class Drive(Copyable):
    """What the phases share: record, batches, health monitor and priors of the calibrations."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.priors = settings  # settings with the present priors of the calibrations
        self.record = DriveRecord(settings)
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
        self, road: Road, reading: Reading, start: StartMap | None, revisits: tuple[Revisit, ...]
    ) -> None:
        """Start a batch of the drive with its revisits, from a map or from odometry."""
        window = road.smoother.first_cycle, road.next_cycle - 1
        lap = partial(
            self.record.lap, start=start, revisits=revisits, settings=self.priors, noise=reading.noise
        )
        self.solver.begin(lap, window, reading.detections.t)

    def outcome(self, road: Road, spent: float) -> Outcome | None:
        """Return the result of the batch if it is due in this cycle, which has taken `spent` (s)."""
        smoother = road.smoother
        return self.solver.outcome(road.next_cycle - 1, smoother.times, smoother.first_cycle, spent)

    def close(self, road: Road, solved: LapMarginal, returned_by: Revisit) -> Array:
        """Close the loop of an open road by the batch of a return; return the jump (3,)."""
        self.closed_by = returned_by
        return self.swap_in(road, solved)

    def lay_on(self, road: Road, solved: LapMarginal, revisit: Revisit) -> Array:
        """Replace an open map by the batch of a revisit; return the jump (3,)."""
        self.revisits = (*self.revisits, revisit)
        return self.swap_in(road, solved)

    def swap_in(self, road: Road, solved: LapMarginal) -> Array:
        """Replace map and prior of a road by those of a batch; return the jump (3,) of the newest pose."""
        jump = swap_in(road, solved)
        self.lap_seconds = solved.seconds
        self.record.replaced(np.concatenate([solved.poses[: solved.first_kept], road.poses]))
        road.place_orange(self.record.corrected)
        return jump

    def lay_on_known(self, road: Road, known: KnownMap, pose: Array, covariance: Array) -> Array:
        """Replace an open road by the known map on which the newest pose (3,) lies; return the jump (3,)."""
        motion = compose(pose, inverse(road.poses[-1]))
        earlier = compose(motion, self.record.with_window(road)[: road.smoother.first_cycle])
        self.solver.give_up(road.next_cycle)
        jump = lay_on_known(road, known, motion, covariance)
        self.record.replaced(np.concatenate([earlier, road.poses]))
        self.record.give_up(KNOWN)
        self.placed_at, self.keeps_map = road.smoother.times[-1], known.kept
        road.place_orange(self.record.corrected)
        self.monitor.restart()
        return jump


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

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Continue from the result of a batch."""
        return Step(self)
