"""The open road: its map grows, and where road is driven again, a batch of the drive replaces it."""

from dataclasses import replace
from typing import ClassVar, Final

from pathspace_graph.batch.association import LINE_STEP
from pathspace_graph.batch.start import StartMap
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings

from .closed import Closed
from .drive import Drive, Phase, Step
from .lap_solver import Outcome
from .returns import ReturnFinder
from .revisit import Revisits
from .worker import Unsolved

STAYS_OPEN: Final = "the loop stays open"  # beginning of the notice without a batch that agrees
REVISITED: Final = "the road was driven before: the open map was optimized with the earlier pass"
"""Notice of the first cycle with a revisit."""
NOT_REVISITED: Final = "an earlier pass of the road is not used"  # beginning of the notice of a failed batch


class Open(Phase):
    """Search for a return to the beginning, and for other road that is driven again."""

    CLOSED: ClassVar = Closed  # class of the phase after the loop has closed

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.returns = ReturnFinder(settings)
        self.revisits = Revisits(settings)
        self.asked_by: Revisit | None = None  # relative pose that started the newest batch
        self._closes = False  # whether that batch is to close the loop
        self._taken_back = 0  # how often curves had been taken back before
        self._said = False  # whether a notice has said why there is no batch

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Search for road that is driven again, which starts a batch; apply the batch's result."""
        learned = drive.inflate_priors(road, reading)
        drive.record.estimated(road)
        step = Step(self) if drive.rests(road) else self._step(road, drive, reading, spent)
        return replace(step, notice="; ".join(filter(None, [step.notice, learned])))

    def _step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        if not drive.solver.is_busy:
            if not self._is_solvable(road, drive):
                return self._stay_open(drive)
            self._begin_batch(road, drive, reading)
        if not drive.solver.is_busy:
            return Step(self)
        outcome = drive.outcome(road, spent)
        return Step(self) if outcome is None else self.take(road, drive, outcome)

    def _begin_batch(self, road: Road, drive: Drive, reading: Reading) -> None:
        """Start a batch if the newest detections match those of the beginning, or of another earlier pass.

        The map stays as it is until the batch confirms the match.
        """
        revisit, record, noise = None, drive.record, reading.noise
        if road.path.length > self.settings.closing.min_path:
            drive.solver.prepare()
            revisit = self.returns.find(road, record, noise)
        self._closes, start = revisit is not None, None
        if revisit is None:
            revisit = self.revisits.find(road, record, noise)
            if revisit is None:
                return
            start = open_map(road, record.with_window(road))
        else:
            self.returns.rest(road, self.settings.open_lap.retry)
        self.asked_by, self._taken_back = revisit, road.growth.taken_back
        drive.begin_batch(road, reading, start, (revisit, *drive.revisits))

    def _is_solvable(self, road: Road, drive: Drive) -> bool:
        """Whether a batch can solve the lap; one with too many cones is given up."""
        cones = sum(  # or equivalent places on a line
            boundary.length / LINE_STEP if self.settings.of_lines else len(boundary.cone_parameters)
            for boundary in road.boundaries.values()
        )
        if cones > self.settings.open_lap.max_cones:
            drive.record.give_up("the lap has too many cones for a batch")
        return drive.record.unsolvable is None

    def _stay_open(self, drive: Drive) -> Step:
        """Continue without a batch; the first notice says why."""
        said, self._said = self._said, True
        return Step(self, notice="" if said else f"{STAYS_OPEN}: {drive.record.unsolvable}")

    # --- results -----------------------------------------------------------------------------------------

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Close the loop, or replace the open map, by a batch that confirms the match.

        Otherwise the notice says why not. A curve that was taken back meanwhile is not that of the batch.
        """
        failed = STAYS_OPEN if self._closes else NOT_REVISITED
        if isinstance(outcome, Unsolved):
            return Step(self, notice=f"{failed}: {outcome.reason}")
        if outcome.objection:
            return Step(self, notice=f"{failed}: {outcome.objection}")
        assert self.asked_by is not None
        if self._closes:
            road.smoother.settle()
            jump = drive.close(road, outcome, self.asked_by)
            return Step(self.CLOSED(road, drive), jump)
        if road.growth.taken_back > self._taken_back:
            return Step(self, notice=f"{failed}: a curve was taken back")
        notice = "" if drive.revisits else REVISITED  # only the first time
        return Step(self, drive.lay_on(road, outcome, self.asked_by), notice)


def open_map(road: Road, poses: Array) -> StartMap:
    """Return the present map of an open road, with the poses (P, 3) of all cycles."""
    road.smoother.transform_to_origin()
    state = road.smoother.map.state
    ends = {label: boundary.confirmed_end for label, boundary in state.boundaries.items()}
    return StartMap(state.splines, poses, state.variables.calibrations.copy(), ends)
