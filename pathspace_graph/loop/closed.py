"""The closed map: localization, refinement, and repair where cones contradict it."""

from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, GOOD, LOST, Health
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.spline.boundary import boundaries_cross

from .closing import fix_gauge
from .drive import Drive, Phase, Step
from .known_loop import KnownLoop, evidence_of
from .lap_solver import Outcome
from .lost import Lost
from .map_repair import MapRepair
from .worker import Unsolved


class Closed(Phase):
    """Refinement and repair of a closed map."""

    def __init__(self, road: Road, drive: Drive) -> None:
        """Start just after the curves were closed."""
        self.map_repair = MapRepair(road.settings)
        self.known_loop = KnownLoop()
        self._boundaries_cross = _crosses(road, drive)
        self._settled = road.path.length  # path length at the last replacement of the map (m)
        road.growth.tentative.clear()

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Judge estimate and map by the tested detections; the phase becomes `Lost` for a lost vehicle."""
        smoother, is_whole = road.smoother, road.has_both_boundaries
        known = self.known_loop if is_whole else None
        health = drive.monitor.update(evidence_of(smoother, classified.tested, known, reading))
        if health.condition == GOOD and self._boundaries_cross:
            health = Health(DEGRADED, "the two boundaries of the map cross")
        if is_whole and drive.can_repair:
            loop = self.known_loop.of(smoother)
            self.map_repair.observe(smoother.map, loop, classified.new, reading.detections.t)
        if health.condition != LOST or not is_whole or drive.solver.is_busy:
            return self, health
        smoother.map.detections.release_all()  # they must not change the map
        self.map_repair.tracks.clear()
        drive.record.give_up("the vehicle was lost")
        return Lost(self, road, health), health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Fix the gauge after enough laps, repair the map, and apply the batch of a repair."""
        drive.record.estimated(road)
        if drive.rests(road):
            return Step(self)
        if drive.solver.is_busy:
            outcome = drive.outcome(road, spent)
            return Step(self) if outcome is None else self.take(road, drive, outcome)
        smoother = road.smoother
        if not smoother.user_factors.given and smoother.held is None:  # user factors may observe the gauge
            longest = max(boundary.length for boundary in road.boundaries.values())
            if road.path.length > self._settled + road.settings.closing.gauge_laps * longest:
                fix_gauge(smoother)
        return Step(self, notice=self._repair(road, drive, reading))

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Apply a repaired map that explains the contradictions, if nothing speaks against it."""
        solved = None if isinstance(outcome, Unsolved) or outcome.objection else outcome
        notice = self.map_repair.end(solved)
        if solved is None or not notice:
            return Step(self)
        jump = drive.take(road, solved)
        self._boundaries_cross = _crosses(road, drive)
        self._settled = road.path.length
        return Step(self, jump, notice)

    def _repair(self, road: Road, drive: Drive, reading: Reading) -> str:
        """Start a batch of the drive if cones contradict the map; repair a known map in place.

        Return the notice of a repair in place.
        """
        t, driven = reading.detections.t, road.path.length
        if not road.has_both_boundaries or not drive.can_repair:
            return ""
        if not self.map_repair.is_due(self.known_loop, road.smoother, t, driven):
            return ""
        if drive.record.unsolvable is None:
            drive.begin_batch(road, reading, self.map_repair.begin(road.smoother, drive.record.poses), ())
            return ""
        self.known_loop = KnownLoop()
        return self.map_repair.in_place(road.smoother)


def _crosses(road: Road, drive: Drive) -> bool:
    """Whether both boundaries cross beside the driven path."""
    road.smoother.refresh()
    splines, driven = road.smoother.map.state.splines, drive.record.poses[:, :2]
    return set(splines) == set(BOUNDARIES) and boundaries_cross(splines, SAMPLE, driven)
