"""The loop of the track: when it closes, what is done once, and what is done afterwards."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import nan
from typing import Final

import numpy as np

from pathspace_graph.batch.lap import ClosedMap, LapMarginal
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.health import DEGRADED, GOOD, LOST, Evidence, Health, HealthMonitor
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.lengths import joined
from pathspace_graph.mapping.motion import inflate_priors
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.smoother import CurveSmoother, Gating
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import boundaries_cross
from pathspace_graph.spline.bspline import BSpline

from .closing import SIGMA_STEP, apply_correspondences, go_on_from, hold_gauge
from .drive_record import DriveRecord
from .lap_solver import LapSolver, Outcome
from .map_repair import MapRepair
from .relocalization import FOUND, KnownLoop, Search, evidence_of, start_anew
from .returns import ReturnFinder
from .revisit import Revisits
from .worker import Unsolved

OWN_PRIOR: Final = "the map goes on from the window's own prior"  # begins the notice where no batch came
STAYS_OPEN: Final = "the loop stays open"  # begins the notice where a batch did not agree
REST: Final = 10.0  # distance for which the loop is left as it is after a failure (m)
REVISITED: Final = "the road was met again, and the open map is laid on its earlier pass"
"""Notice of the first cycle with a revisit."""
NEW_ROAD: Final = "the vehicle has left the closed map, and is on new road"
"""Reason of the health there, and notice of the first cycle."""
LEARNED: Final = "the drive contradicts the calibration, which is learned"
"""Notice of the cycle in which the priors of the calibrations are first doubted."""


class TrackLoop:
    """The batch of the open lap when the loop closes, and the search for a vehicle that is lost."""

    def __init__(self, smoother: CurveSmoother, path: DrivenPath, noise: NoiseLearner) -> None:
        self.settings = smoother.map.settings
        self.closed = False  # whether the loop has closed: the map has its final size
        self.closed_by: Revisit | None = None  # return that began the batch which closed it, or is to
        self.health = Health()  # how far the newest estimate can be trusted
        self.corrected_poses: Array = np.zeros((0, 3))  # (k, 3) of the first k cycles, since closing
        self.lap_seconds = nan  # wall time (s) of the lap's batch, once it has replaced the prior
        self.record = DriveRecord(self.settings, noise)
        self.solver = LapSolver(self.settings)
        self.returns = ReturnFinder(smoother, path, self.record)
        self.revisits = Revisits(smoother, path, self.record)
        self.map_repair = MapRepair(smoother)
        self._smoother = smoother
        self._path = path
        self._monitor = HealthMonitor()
        self._known_loop = KnownLoop(smoother)
        self._search: Search | None = None
        self._lost = Health()  # as it was when the search began
        self._boundaries_cross = False
        self._inflated = self.settings  # with the priors of the calibrations as they are now
        self._settled: float | None = None  # path driven (m) when the closed map was last replaced
        self._resumes = 0.0

    @property
    def priors(self) -> MapperSettings:
        """Return the settings with the priors of the calibrations as they are now."""
        return self._inflated

    @property
    def sigma_size(self) -> float:
        """Return the standard deviation of the size of the world, where it is no variable (-)."""
        return self.priors.odometry.sigma_size

    @property
    def is_searching(self) -> bool:
        """Return whether the vehicle is lost on a closed map, and is looked for."""
        return self._search is not None

    # --- what a cycle tells ------------------------------------------------------------------------------

    def judge(self, tested: Gating | None, new: slice, reading: Reading) -> None:
        """Judge the estimate by the tested detections, or remember the `new` rows of a lost vehicle."""
        smoother, detections = self._smoother, reading.detections
        if self._search is not None:
            corrected = smoother.map.detections.corrected(new, smoother.variables.sensor).copy()
            self._search.observe(smoother.variables.poses[-1], replace(detections, points_vehicle=corrected))
            return
        evidence = Evidence(detections.t)
        if tested is not None:
            evidence = evidence_of(smoother, tested, self._known_loop, reading.seen_again)
        motion = reading.motion
        self.health = self._monitor.update(replace(evidence, odometry=motion.fault, rests=motion.rests))
        if self.health.condition == GOOD and self._boundaries_cross:
            self.health = Health(DEGRADED, "the two boundaries of the map cross")
        if self._known_loop.is_whole and self.record.unsolvable is None:
            self.map_repair.contradictions.observe(smoother.map, self._known_loop, new, detections.t)
        if self.health.condition == LOST and self._known_loop.is_whole and not self.solver.is_busy:
            smoother.map.detections.release_all()  # the map stays as it was before
            self._search, self._lost = Search(smoother), self.health
            self.map_repair.contradictions.clear()
            self.record.give_up("the vehicle was lost")

    def inflate_priors(self, reading: Reading) -> str:
        """Widen the priors of calibrations that the drive contradicts while the loop is open; say so once."""
        if self.closed:
            return ""
        before = self._inflated
        self._inflated = inflate_priors(self._smoother, before, reading.sensor_doubted, reading.measured)
        contradicted = reading.sensor_doubted or reading.measured is None
        is_new = before == self.settings != self._inflated and contradicted
        return LEARNED if is_new else ""

    # --- the batch of the open lap -----------------------------------------------------------------------

    def pause(self) -> None:
        """Give up what is under way, and rest for `REST` metres: something has failed."""
        self._resumes = self._path.length + REST
        self.solver.give_up(self._smoother.next_cycle)

    @property
    def _rests(self) -> bool:
        return self._path.length < self._resumes

    def close(self) -> bool:
        """Return whether the loop closes in this cycle: the newest detections lie on the curves' beginning.

        They only start the batch of the lap, which closes it later, unless no batch can come.
        """
        smoother, settings = self._smoother, self.settings.closing
        if self.closed or self._rests or self.solver.is_busy or not smoother.map.state.boundaries:
            return False
        found = self.returns.by_curves()
        if found is None:
            return False
        if self.record.unsolvable is None:
            self._close_by_batch(self.returns.revisit_of(found))
            return False
        apply_correspondences(smoother, found)
        self.record.bent(smoother.solve_loop(settings.iterations, SIGMA_STEP), smoother)
        return True

    def go_on(self, closes: bool, spent: float) -> tuple[Array | None, str]:
        """Record the lap, have it solved when it closes, and go on from the result when it is due.

        The cycle has taken the time `spent` (s) so far. Return the jump (3,) of the newest pose if the map
        was replaced, and a notice.
        """
        if closes:
            self._closes()
            self.record.replaced(self.record.with_window(self._smoother))
            self.corrected_poses = self.record.poses
            self._boundaries_cross = self._crosses()
            return None, f"{OWN_PRIOR}: {self.record.unsolvable}"
        self.record.estimated(self._smoother.map.state)
        if self._rests:
            return None, ""
        if not self.closed and self._path.length > self.settings.closing.min_path:
            self._look_for_return()
        if not self.closed and not self.solver.is_busy:
            jump = self.revisits.use()
            if jump is not None:
                self.corrected_poses = self.record.poses
                return jump, REVISITED if len(self.revisits.found) == 1 else ""
        if not self.solver.is_busy:
            self._hold_gauge()
            self._repair()
            return None, ""
        smoother = self._smoother
        cycle = smoother.next_cycle - 1
        outcome = self.solver.outcome(cycle, smoother.times, smoother.first_cycle, spent)
        return (None, "") if outcome is None else self._take(outcome)

    def finish(self) -> Array | None:
        """Take the result of a batch that is under way, as no cycle follows; return the jump (3,) if any."""
        outcome = self.solver.last_outcome(self._smoother.next_cycle - 1)
        return None if outcome is None else self._take(outcome)[0]

    def resume(self) -> None:
        """Go on with the batch that was under way when a snapshot was taken."""
        self.solver.resume(prepares=not self.closed and self.record.unsolvable is None)

    def _look_for_return(self) -> None:
        """Send the lap to a batch where the newest cones lie on early ones, or the newest curves do."""
        if self.record.unsolvable is None:
            self.solver.prepare()
        if self.solver.is_busy or not self._is_solvable():
            return
        revisit = self.returns.by_cones() or self.returns.by_shape()
        if revisit is not None:
            self._close_by_batch(revisit)

    def _repair(self) -> None:
        """Send the drive to a batch where cones contradict the closed map."""
        may_repair = self._known_loop.is_whole and self._search is None and self.record.unsolvable is None
        if may_repair and self.map_repair.is_due(self._known_loop, self._path.length):
            self._begin_batch(self.map_repair.begin(self.record.poses))

    def _take(self, outcome: Outcome) -> tuple[Array | None, str]:
        repairs, smoother = self.map_repair.is_tried(), self._smoother
        solved = outcome if isinstance(outcome, LapMarginal) else None
        notice = self.map_repair.end(solved) if repairs else ""
        if isinstance(outcome, Unsolved):
            if self.closed:
                return None, ""
            if outcome.is_final:
                self.record.give_up(outcome.reason)
                self.returns.rest(0.0)  # a registration may close the loop at once
            return None, joined([STAYS_OPEN, outcome.reason], ": ")
        if repairs and (not notice or self._crosses(outcome.splines) > self._boundaries_cross):
            return None, ""
        if outcome.objection and not repairs:
            return None, joined([STAYS_OPEN, outcome.objection], ": ")
        if not self.closed:
            self._closes()
        self.lap_seconds = outcome.seconds
        jump, self._settled = go_on_from(smoother, outcome), self._path.length
        self.record.replaced(np.concatenate([outcome.poses[: outcome.first_kept], smoother.variables.poses]))
        self.corrected_poses = self.record.poses
        self._boundaries_cross = self._crosses()
        return jump, notice

    def _crosses(self, splines: Mapping[int, BSpline] | None = None) -> bool:
        if splines is None:
            self._smoother.refresh()
            splines = self._smoother.map.state.splines
        driven = self.record.poses[:, :2]
        return set(splines) == set(BOUNDARIES) and boundaries_cross(splines, SAMPLE, driven)

    def _hold_gauge(self) -> None:
        """Hold the gauge of the closed map after enough laps, unless factors of the user's may tell it."""
        smoother, boundaries = self._smoother, self._smoother.map.state.boundaries
        if not self.closed or self._search is not None or smoother.user_factors.given:
            return
        if self._settled is None:
            self._settled = self._path.length
        enough = self.settings.closing.gauge_laps * max(boundary.length for boundary in boundaries.values())
        if smoother.held is None and self._path.length > self._settled + enough:
            hold_gauge(smoother)

    def _closes(self) -> None:
        self.closed = True
        self._smoother.settle()

    def _begin_batch(self, start: ClosedMap | Revisit) -> None:
        """Send the lap to its batch, which begins at a map that has just been closed, or at odometry."""
        smoother = self._smoother
        window = smoother.first_cycle, smoother.next_cycle - 1
        lap = partial(self.record.lap, start=start, settings=self._inflated)
        self.solver.begin(lap, window, smoother.times[-1])

    def _close_by_batch(self, revisit: Revisit) -> None:
        """Send the lap to a batch, which closes the loop if it agrees; until then the map stays open."""
        self.returns.rest(self.settings.open_lap.retry)
        self.closed_by = revisit
        self._begin_batch(revisit)

    def _is_solvable(self) -> bool:
        """Return whether the lap can be solved as a batch; a lap of too many cones is given up."""
        boundaries = self._smoother.map.state.boundaries.values()
        if sum(len(boundary.cone_parameters) for boundary in boundaries) > self.settings.open_lap.max_cones:
            self.record.give_up("the lap has too many cones for a batch")
        return self.record.unsolvable is None

    # --- a vehicle that is lost --------------------------------------------------------------------------

    def relocalize(self, *, sees_road: bool) -> tuple[Array | None, str]:
        """Start the window anew where a lost vehicle is found; return its jump (3,) and a notice.

        Where no place of the map agrees, but it `sees_road`, it has left the map.
        """
        if self._search is None or self._rests:
            return None, ""
        found = self._search.find()
        if found is None:
            before, is_new = self.health, self._search.is_off_map and sees_road
            self.health = Health(DEGRADED, NEW_ROAD) if is_new else self._lost
            return None, NEW_ROAD if is_new and before == self._lost else ""
        first_cycle = max(self._search.first_cycle, self._smoother.first_cycle)
        self._search, self.health = None, Health(DEGRADED, FOUND)
        self._monitor.restart()
        return start_anew(self._smoother, first_cycle, found), FOUND
