"""The loop of the track: when it closes, what is done once, and what is done afterwards."""

from collections.abc import Mapping
from dataclasses import replace
from math import ceil
from typing import Final

import numpy as np

from pathspace_graph.batch.lap import ClosedMap, LapMarginal
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.health import DEGRADED, GOOD, LOST, Evidence, Health, HealthMonitor
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.lengths import joined
from pathspace_graph.mapping.constellation import relative_pose
from pathspace_graph.mapping.motion import inflate_priors
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.registration import BEGINNING, HEADING, RefinedMotion, near_start
from pathspace_graph.mapping.smoother import CurveSmoother, Gating
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import boundaries_cross
from pathspace_graph.spline.bspline import BSpline

from .closing import go_on_from, hold_gauge
from .drive_record import LATE, DriveRecord, LapBatch, Unsolved
from .map_repair import MapRepair
from .relocalization import FOUND, KnownLoop, Search, evidence_of, start_anew
from .revisit import Revisits, recognize

OWN_PRIOR: Final = "the map goes on from the window's own prior"  # begins the notice where no batch came
STAYS_OPEN: Final = "the loop stays open"  # begins the notice where a batch did not agree
LONGEST_WAIT: Final = 1.0  # of a cycle for a batch (s), however long ago the cycle before it was
REST: Final = 10.0  # distance for which the loop is left as it is after a failure (m)
RECOGNITION_INTERVAL: Final = 10.0  # least distance of two attempts to recognize the place (m along the path)
RETURN_CYCLES: Final = 10  # least number of cycles of two attempts to find the beginning again by its cones
LONG_PATH: Final = 1000.0
"""Path from which on this distance grows with it (m), as the cost of an attempt does."""
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
        self.lap_seconds = float("nan")  # wall time (s) of the lap's batch, once it has replaced the prior
        self.late_cycles = 0  # cycles by which the slowest batch is late in a vehicle, by its wall time
        self.record = DriveRecord(self.settings, noise)
        self.revisits = Revisits(smoother, path, self.record)
        self.map_repair = MapRepair(smoother)
        self._smoother = smoother
        self._path = path
        self._monitor = HealthMonitor()
        self._known_loop = KnownLoop(smoother)
        self._search: Search | None = None
        self._lost = Health()  # as it was when the search began
        self._lap_batch: LapBatch | None = None
        self._batch_ends: list[int] = []
        self._boundaries_cross = False
        self._inflated = self.settings  # with the priors of the calibrations as they are now
        self._settled: float | None = None  # path driven (m) when the closed map was last replaced
        self._tried: dict[str, tuple[float, int]] = {}  # path (m) and cycle of the last attempt in each way
        self._open_until = 0.0  # path (m) up to which no return is looked for
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

    @property
    def first_kept(self) -> int | None:
        """Return the cycle whose pose must stay in the window until the lap is solved, if there is one."""
        return self._lap_batch.first_kept if self._lap_batch else None

    @property
    def batch_ends(self) -> tuple[int, ...]:
        """Return the cycles in which results of batches were taken, or they were or will be given up."""
        batch, ends = self._lap_batch, tuple(self._batch_ends)
        if batch is None or self._smoother.next_cycle <= batch.due <= batch.last:
            return ends
        return (*ends, batch.last + 1)

    @property
    def batches(self) -> tuple[int, int]:
        """Return how many batches have ended, and the newest cycle where one is under way, else -1.

        What has been got from other processes is the same while this is.
        """
        under_way = self._lap_batch is not None
        return len(self._batch_ends), self._smoother.next_cycle if under_way else -1

    def may_close(self) -> bool:
        """Return whether it is time to register the newest detections with the beginning of an open loop."""
        if self.closed or self._rests or self._lap_batch is not None or not self._is_near_start():
            return False
        return self._is_due("curves", self.settings.closing.check_interval)

    def _is_near_start(self) -> bool:
        return near_start(self._path, self._smoother.variables.poses[-1], self.settings.closing)

    def _is_due(self, way: str, interval: float, cycles: float = np.inf) -> bool:
        """Return whether to look for a return in a way again, some metres or cycles after the last time."""
        length, cycle = self._path.length, self._smoother.next_cycle
        tried, tried_cycle = self._tried.get(way, (-np.inf, 0))
        if length < self._open_until or (length < tried + interval and cycle < tried_cycle + cycles):
            return False
        self._tried[way] = length, cycle
        return True

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
        if self.health.condition == LOST and self._known_loop.is_whole and self._lap_batch is None:
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
        if self._lap_batch is not None:
            self._lap_batch.give_up()
            self._lap_batch = None
            self._batch_ends.append(self._smoother.next_cycle)

    @property
    def _rests(self) -> bool:
        return self._path.length < self._resumes

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
            self.record.prepare()
            if self._lap_batch is None and self._is_solvable():
                self._look_for_return()
        batch = self._lap_batch
        if not self.closed and batch is None:
            jump = self.revisits.use()
            if jump is not None:
                self.corrected_poses = self.record.poses
                return jump, REVISITED if len(self.revisits.found) == 1 else ""
        if batch is None:
            self._hold_gauge()
            may_repair = self._known_loop.is_whole and self._search is None and self.record.unsolvable is None
            if may_repair and self.map_repair.is_due(self._known_loop, self._path.length):
                self._begin_batch(self.map_repair.begin(self.record.poses))
        elif self._smoother.next_cycle - 1 >= batch.due:
            return self._end(batch, spent)
        return None, ""

    def wait(self) -> None:
        """Wait for the batch whose result the next cycle may take, however long that takes."""
        batch = self._lap_batch
        if batch is not None and batch.due <= self._smoother.next_cycle <= batch.last:
            batch.wait()

    def finish(self) -> Array | None:
        """Take the result of a batch that is under way, as no cycle follows; return the jump (3,) if any."""
        ended_later = self.settings.open_lap.ends[len(self._batch_ends) :]  # in the drive that is replayed
        if self._lap_batch is None or ended_later:
            return None
        self._lap_batch.wait()
        outcome, self._lap_batch = self._lap_batch.marginal(0.0), None
        self._batch_ends.append(self._smoother.next_cycle - 1)
        return None if outcome is None else self._take(outcome)[0]

    def resume(self) -> None:
        """Send the lap that was being solved when a snapshot was taken, which the process has not seen."""
        if self._lap_batch is not None:
            self._lap_batch.send()
        elif not self.closed:
            self.record.resume()

    def _end(self, batch: LapBatch, spent: float) -> tuple[Array | None, str]:
        """Take the result of a batch that is due, leave it to the next cycle, or give it up.

        The wait ends with the cycle's period, the time since the one before it.
        """
        cycle, times = self._smoother.next_cycle - 1, self._smoother.times
        period = float(np.ptp(times[-2:]))
        outcome: LapMarginal | Unsolved | None = LATE
        if cycle <= batch.last:
            outcome = batch.marginal(max(min(period, LONGEST_WAIT) - spent, 0.0))
        else:
            batch.give_up()
        if outcome is None:
            return None, ""
        if isinstance(outcome, LapMarginal) and period > 0.0:
            given = times[batch.due - self._smoother.first_cycle] - batch.t
            self.late_cycles = max(self.late_cycles, ceil((outcome.seconds - given) / period))
        self._lap_batch = None
        self._batch_ends.append(cycle)
        return self._take(outcome)

    def _take(self, outcome: LapMarginal | Unsolved) -> tuple[Array | None, str]:
        repairs, smoother = self.map_repair.is_tried(), self._smoother
        solved = outcome if isinstance(outcome, LapMarginal) else None
        notice = self.map_repair.end(solved) if repairs else ""
        if isinstance(outcome, Unsolved):
            if self.closed:
                return None, ""
            if outcome.is_final:
                self.record.give_up(outcome.reason)
                self._open_until = 0.0  # a registration may close the loop at once
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
        """Send the lap to its batch, which begins at a map that has just been closed, or at odometry.

        In a replay the batch ends in the recorded cycle.
        """
        open_lap, smoother = self.settings.open_lap, self._smoother
        first, cycle = smoother.first_cycle, smoother.next_cycle - 1
        wait = max(min(open_lap.cycles, cycle - first), int(open_lap.cycles_share * cycle))
        first_kept, due = min(first + wait, cycle), cycle + wait
        last = max(due, min(due + open_lap.late, first_kept + self.settings.max_poses - 1))
        recorded = open_lap.ends[len(self._batch_ends) :][:1]
        lap = self.record.lap(first_kept, start, self._inflated)
        due = min(max([due, *recorded]), last + 1)
        self._lap_batch = LapBatch(lap, smoother.times[-1], due, last)

    def _look_for_return(self) -> None:
        """Send the lap to a batch where the newest cones lie on early ones, or the newest curves do."""
        smoother, closing = self._smoother, self.settings.closing
        if self._is_due("cones", closing.check_interval, RETURN_CYCLES) and self._is_near_start():
            covariance = smoother.newest_covariance()
            revisit = self.record.return_to_beginning(covariance, smoother.variables.sensor)
            if revisit is not None:
                self._close_by_batch(revisit)
                return
        length = self._path.length
        if self._is_due("shape", RECOGNITION_INTERVAL * max(length / LONG_PATH, 1.0)):
            found = recognize(smoother)
            if found is not None:
                self.registered(found, within=length - closing.min_path)

    def registered(self, found: RefinedMotion, within: float = BEGINNING) -> None:
        """Send the lap to a batch: once moved, the newest pose is beside one `within` the first metres."""
        poses = self.record.with_window(self._smoother)
        newest = poses[-1:].copy()
        found.motion.move(newest)
        beside = (path_lengths(poses) < within) & (np.cos(poses[:, 2] - newest[0, 2]) > np.cos(HEADING))
        away = np.where(beside, np.hypot(*(poses[:, :2] - newest[0, :2]).T), np.inf)
        earlier, information = int(away.argmin()), np.asarray(np.linalg.inv(found.covariance), np.float64)
        ends = (earlier, poses[earlier]), (len(poses) - 1, newest[0])
        self._close_by_batch(relative_pose(*ends, newest[0], information))

    def _close_by_batch(self, revisit: Revisit) -> None:
        """Send the lap to a batch, which closes the loop if it agrees; until then the map stays open."""
        self._open_until = self._path.length + self.settings.open_lap.retry
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
