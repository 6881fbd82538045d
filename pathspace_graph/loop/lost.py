"""The lost vehicle: search its place on the closed map, and map the road beside it separately."""

from dataclasses import replace
from typing import Final

from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, GOOD, Health, HealthMonitor
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.settings.mapper import MapperSettings

from .drive import Drive, Phase, Step
from .known_loop import evidence_of
from .relocalization import FOUND, Search, restart_window

ROAD: Final = 10.0  # least length of both boundaries of new road (m)
NEW_ROAD: Final = "the vehicle has left the closed map, and is on new road"
"""Reason of the health on new road, and notice of the first cycle."""


class Lost(Phase):
    """Search for a lost vehicle; detections do not change the closed map."""

    uses_detections = False

    def __init__(self, closed: Phase, road: Road, health: Health) -> None:
        """Start when the vehicle on a closed map becomes lost, with the health that says why."""
        self.closed = closed  # phase of a vehicle that is found
        self.search = Search(road)
        self.new_road: Road | None = None  # road mapped while lost, in its own frame
        self._monitor = HealthMonitor()  # monitor of the new road
        self._lost = self._health = health

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Record the detections for the search; the health is that of the last attempt."""
        self.search.look(road, classified, reading)
        return self, self._health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Map the road beside the vehicle, and restart the window where the search finds the vehicle."""
        drive.record.estimated(road)
        if drive.rests(road):
            self.new_road = None
            return Step(self)
        sees_road = self._map_new_road(road, drive, reading)
        found = self.search.find(road.smoother)
        if found is None:
            return self._continue(self.search.is_off_map and sees_road)
        first_cycle = max(self.search.first_cycle, road.smoother.first_cycle)
        drive.monitor.restart()
        jump = restart_window(road.smoother, first_cycle, found)
        return Step(self.closed, jump, FOUND, Health(DEGRADED, FOUND))

    def _map_new_road(self, road: Road, drive: Drive, reading: Reading) -> bool:
        """Map the road beside the vehicle as an open one, with the known calibration.

        Return whether it has both boundaries, and its estimate is good.
        """
        if self.new_road is None:
            self.new_road, self._monitor = type(road)(_as_known(road, drive)), HealthMonitor()
        new = self.new_road
        motion, detections = reading.motion, reading.detections
        new.predict(motion, reading.orange)
        classified = new.classify(detections, motion.odometry.twist)
        evidence = evidence_of(new.smoother, classified.tested, None, reading)
        health = self._monitor.update(evidence)
        new.expand()
        new.update()
        new.marginalize()
        ends = [boundary.confirmed_end for boundary in new.boundaries.values()]
        return new.has_both_boundaries and min(ends) > ROAD and health.condition == GOOD

    def _continue(self, is_new: bool) -> Step:
        """Continue the search; on new road, where no place of the map agrees, the health is degraded."""
        before = self._health
        self._health = Health(DEGRADED, NEW_ROAD) if is_new else self._lost
        notice = NEW_ROAD if is_new and before == self._lost else ""
        return Step(self, notice=notice, health=self._health)


def _as_known(road: Road, drive: Drive) -> MapperSettings:
    """Return the settings with the present estimate as mean of the calibrations' priors."""
    variables, priors = road.smoother.variables, drive.priors
    return replace(
        road.settings,
        odometry=priors.odometry.about(variables.calibration.tolist()),
        calibration=priors.calibration.about(variables.sensor.tolist()),
    )
