"""Schedule of the batches of a drive: one lap at a time, in another process, with a due cycle."""

from collections.abc import Callable, Sequence
from math import ceil
from typing import Final

import numpy as np

from pathspace_graph.batch.lap import LapMarginal, OpenLap
from pathspace_graph.copies import Copyable
from pathspace_graph.settings.mapper import MapperSettings

from .worker import BATCH_LATE, LapBatch, Unsolved

LONGEST_WAIT: Final = 1.0  # longest wait of a cycle for a batch (s)
MOST_LATE: Final = 100  # most cycles by which a batch may be late, after which it is abandoned
CYCLES_SHARE: Final = 0.03  # of a long lap's cycles, after which its result is due, where these are more

Outcome = LapMarginal | Unsolved


class LapSolver(Copyable):
    """The running batch, if there is one, and the cycles in which batches have ended."""

    def __init__(self, settings: MapperSettings) -> None:
        self.late_cycles = 0  # cycles by which the slowest batch would be late in a vehicle, by wall time
        self._settings = settings.open_lap
        self._max_poses = settings.max_poses
        self._batch: LapBatch | None = None
        self._ends: tuple[int, ...] = ()

    @property
    def is_busy(self) -> bool:
        """Whether a batch is running."""
        return self._batch is not None

    @property
    def first_kept(self) -> int | None:
        """Return the first cycle whose pose must stay in the window for a running batch."""
        return self._batch.first_kept if self._batch else None

    def ends(self, next_cycle: int) -> tuple[int, ...]:
        """Return the cycles in which batches ended, with the latest possible one of a batch that is due."""
        batch, ends = self._batch, self._ends
        if batch is None or next_cycle <= batch.due <= batch.last:
            return ends
        return (*ends, batch.last + 1)

    # --- the batch ---------------------------------------------------------------------------------------

    def begin(self, lap: Callable[[int], OpenLap], window: tuple[int, int], t: float) -> None:
        """Send a lap, built for its first kept cycle, at t (s) in the newest cycle of the window.

        The result is due some cycles later; in a replay, in the recorded cycle.
        """
        settings, (first, cycle) = self._settings, window
        wait = max(min(settings.cycles, cycle - first), int(CYCLES_SHARE * cycle))
        first_kept, due = min(first + wait, cycle), cycle + wait
        last = max(due, min(due + MOST_LATE, first_kept + self._max_poses - 1))
        recorded = settings.ends[len(self._ends) :][:1]
        due = min(max([due, *recorded]), last + 1)
        self._batch = LapBatch(lap(first_kept), t, due, last)

    def give_up(self, next_cycle: int) -> None:
        """Cancel the running batch."""
        if self._batch is not None:
            self._batch.give_up()
            self._batch = None
            self._ends = (*self._ends, next_cycle)

    # --- results -----------------------------------------------------------------------------------------

    def wait(self, next_cycle: int) -> None:
        """Wait without limit for the batch whose result may be due in the next cycle."""
        batch = self._batch
        if batch is not None and batch.due <= next_cycle <= batch.last:
            batch.wait()

    def outcome(self, cycle: int, times: Sequence[float], first_cycle: int, spent: float) -> Outcome | None:
        """Return the result of the batch if it is due and ready; None otherwise.

        The window has stamps `times` (s) from `first_cycle` on. The wait ends with the period of the cycle,
        of which `spent` (s) is over. A batch past its last cycle is cancelled.
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
        """Wait for the result of the running batch after the last cycle of a drive.

        In a replay, a batch that ended later keeps running.
        """
        if self._batch is None or self._settings.ends[len(self._ends) :]:
            return None
        self._batch.wait()
        outcome, self._batch = self._batch.marginal(0.0), None
        self._ends = (*self._ends, cycle)
        return outcome
