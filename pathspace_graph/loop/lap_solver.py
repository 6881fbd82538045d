"""The batches of a drive: one lap at a time is solved in another process, and taken when it is due."""

from collections.abc import Callable, Sequence
from math import ceil
from typing import Final

import numpy as np

from pathspace_graph.batch.lap import LapMarginal, OpenLap
from pathspace_graph.copies import Copyable
from pathspace_graph.settings.mapper import MapperSettings

from . import worker
from .worker import BATCH_LATE, LapBatch, Unsolved

LONGEST_WAIT: Final = 1.0  # of a cycle for a batch (s), however long ago the cycle before it was

Outcome = LapMarginal | Unsolved


class LapSolver(Copyable):
    """The batch that is under way, if there is one, and the cycles in which batches have ended."""

    def __init__(self, settings: MapperSettings) -> None:
        self.late_cycles = 0  # cycles by which the slowest batch is late in a vehicle, by its wall time
        self._settings = settings.open_lap
        self._max_poses = settings.max_poses
        self._batch: LapBatch | None = None
        self._ends: tuple[int, ...] = ()
        self._prepared = False

    @property
    def is_busy(self) -> bool:
        """Return whether a batch is under way."""
        return self._batch is not None

    @property
    def first_kept(self) -> int | None:
        """Return the cycle whose pose must stay in the window until the lap is solved, if there is one."""
        return self._batch.first_kept if self._batch else None

    def ends(self, next_cycle: int) -> tuple[int, ...]:
        """Return the cycles in which results of batches were taken, or they were or will be given up."""
        batch, ends = self._batch, self._ends
        if batch is None or next_cycle <= batch.due <= batch.last:
            return ends
        return (*ends, batch.last + 1)

    # --- the process -------------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Start the process, once, so that it is ready when a lap is over."""
        if not self._prepared:
            self._prepared = True
            worker.submit(worker.nothing)

    def resume(self, prepares: bool) -> None:
        """Send the lap that was being solved when a snapshot was taken, or start the process again."""
        if self._batch is not None:
            self._batch.send()
        elif self._prepared and prepares:
            worker.submit(worker.nothing)

    def begin(self, lap: Callable[[int], OpenLap], window: tuple[int, int], t: float) -> None:
        """Send a lap, given the first cycle whose pose is kept, at t (s) in the newest cycle of the window.

        The result is due some cycles later, and in a replay in the recorded cycle.
        """
        settings, (first, cycle) = self._settings, window
        wait = max(min(settings.cycles, cycle - first), int(settings.cycles_share * cycle))
        first_kept, due = min(first + wait, cycle), cycle + wait
        last = max(due, min(due + settings.late, first_kept + self._max_poses - 1))
        recorded = settings.ends[len(self._ends) :][:1]
        due = min(max([due, *recorded]), last + 1)
        self._batch = LapBatch(lap(first_kept), t, due, last)

    def give_up(self, next_cycle: int) -> None:
        """Take a batch that is under way from the process."""
        if self._batch is not None:
            self._batch.give_up()
            self._batch = None
            self._ends = (*self._ends, next_cycle)

    # --- results -----------------------------------------------------------------------------------------

    def wait(self, next_cycle: int) -> None:
        """Wait for the batch whose result the next cycle may take, however long that takes."""
        batch = self._batch
        if batch is not None and batch.due <= next_cycle <= batch.last:
            batch.wait()

    def outcome(self, cycle: int, times: Sequence[float], first_cycle: int, spent: float) -> Outcome | None:
        """Return the result of a batch in a cycle from which on it is due; None leaves it to the next one.

        The window has stamps `times` (s) from `first_cycle` on. The wait ends with the cycle's period, the
        time since the one before it, of which `spent` (s) is over. A batch that is too late is given up.
        """
        batch = self._batch
        if batch is None or cycle < batch.due:
            return None
        period = float(np.ptp(times[-2:]))
        outcome: Outcome | None = BATCH_LATE
        if cycle <= batch.last:
            outcome = batch.marginal(max(min(period, LONGEST_WAIT) - spent, 0.0))
        else:
            batch.give_up()
        if outcome is None:
            return None
        if isinstance(outcome, LapMarginal) and period > 0.0:
            given = times[batch.due - first_cycle] - batch.t
            self.late_cycles = max(self.late_cycles, ceil((outcome.seconds - given) / period))
        self._batch = None
        self._ends = (*self._ends, cycle)
        return outcome

    def last_outcome(self, cycle: int) -> Outcome | None:
        """Return the result of a batch that is under way, as no cycle follows the given one.

        In a replay, a batch that ended later is left under way.
        """
        if self._batch is None or self._settings.ends[len(self._ends) :]:
            return None
        self._batch.wait()
        outcome, self._batch = self._batch.marginal(0.0), None
        self._ends = (*self._ends, cycle)
        return outcome
