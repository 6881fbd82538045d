"""The open road: its map grows until a return to its beginning starts the batch that closes the loop."""

from dataclasses import replace
from typing import ClassVar, Final

from pathspace_graph.batch.association import LINE_STEP
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.changes import solve_loop
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.mapping.registration import RefinedMotion
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings

from .closed import Closed
from .closing import SIGMA_STEP, apply_correspondences, simplify
from .drive import Drive, Phase, Step
from .lap_solver import Outcome
from .returns import ReturnFinder
from .revisit import Revisits
from .worker import Unsolved

OWN_PRIOR: Final = "the map goes on from the window's own prior"  # beginning of the notice without a batch
STAYS_OPEN: Final = "the loop stays open"  # beginning of the notice of a rejected batch
REVISITED: Final = "the road was driven before: the open map was optimized with the earlier pass"
"""Notice of the first cycle with a revisit."""


class Open(Phase):
    """Search for a return to the beginning, and for other road that is driven again."""

    CLOSED: ClassVar = Closed  # class of the phase after the loop has closed

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.returns = ReturnFinder(settings.closing)
        self.revisits = Revisits(settings)
        self.returned_by: Revisit | None = None  # relative pose that started the newest batch

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Search for a return, which starts a batch; apply the batch's result, or a revisit."""
        learned = drive.inflate_priors(road, reading)
        drive.record.estimated(road)
        step = Step(self) if drive.rests(road) else self._step(road, drive, reading, spent)
        return replace(step, notice="; ".join(filter(None, [step.notice, learned])))

    def _step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        if not drive.solver.is_busy:
            if not self._is_solvable(road, drive):
                found = self.returns.by_curves(road)
                return Step(self) if found is None else self._close_by_prior(road, drive, found)
            self._begin_batch(road, drive, reading)
        if drive.solver.is_busy:
            outcome = drive.outcome(road, spent)
            return Step(self) if outcome is None else self.take(road, drive, outcome)
        revisit = self.revisits.find(road, drive.record, reading.noise)
        if revisit is None:
            return Step(self)
        notice = "" if drive.revisits else REVISITED  # only the first time
        return Step(self, drive.lay_on(road, revisit), notice)

    def _begin_batch(self, road: Road, drive: Drive, reading: Reading) -> None:
        """Start a batch of the lap if the newest detections, cones or curves match earlier ones.

        The map stays open until the batch confirms the match.
        """
        if road.path.length <= self.settings.closing.min_path:
            return
        drive.solver.prepare()
        revisit = self.returns.find(road, drive.record, reading.noise)
        if revisit is not None:
            self.returns.rest(road, self.settings.open_lap.retry)
            self.returned_by = revisit
            drive.begin_batch(road, reading, revisit)

    def _is_solvable(self, road: Road, drive: Drive) -> bool:
        """Whether a batch can solve the lap; one with too many cones is given up."""
        cones = sum(  # or equivalent places on a line
            boundary.length / LINE_STEP if self.settings.of_lines else len(boundary.cone_parameters)
            for boundary in road.boundaries.values()
        )
        if cones > self.settings.open_lap.max_cones:
            drive.record.give_up("the lap has too many cones for a batch")
        return drive.record.unsolvable is None

    # --- closing -----------------------------------------------------------------------------------------

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Close the loop by a batch that confirms it; otherwise the notice says why it stays open."""
        if isinstance(outcome, Unsolved):
            if outcome.is_final:
                drive.record.give_up(outcome.reason)
                self.returns.rest(road, 0.0)  # a registration may close the loop at once
            return Step(self, notice=f"{STAYS_OPEN}: {outcome.reason}")
        if outcome.objection:
            return Step(self, notice=f"{STAYS_OPEN}: {outcome.objection}")
        road.smoother.settle()
        jump = drive.close(road, outcome, self.returned_by)
        return Step(self.CLOSED(road, drive), jump)

    def _close_by_prior(self, road: Road, drive: Drive, found: RefinedMotion) -> Step:
        """Close the loop by the window's own prior, as no batch is possible."""
        smoother = road.smoother
        apply_correspondences(smoother, found)
        keyframes = solve_loop(smoother, self.settings.closing.iterations, SIGMA_STEP)
        drive.record.bent(keyframes, road)
        simplify(smoother)
        smoother.settle()
        drive.record.replaced(drive.record.with_window(road))
        return Step(self.CLOSED(road, drive), notice=f"{OWN_PRIOR}: {drive.record.unsolvable}")
