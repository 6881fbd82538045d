"""The lost vehicle: its place on the closed map is searched, and the road beside it is mapped anew."""

from dataclasses import replace
from typing import Final

from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, GOOD, Health, HealthMonitor
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.settings.mapper import MapperSettings

from .drive import Drive, Phase, Step
from .known_loop import evidence_of
from .relocalization import FOUND, Search, start_anew

ROAD: Final = 10.0  # length of both boundaries beside a lost vehicle that make a road (m)
NEW_ROAD: Final = "the vehicle has left the closed map, and is on new road"
"""Reason of the health there, and notice of the first cycle."""


class Lost(Phase):
    """The search for a lost vehicle, while the closed map stays as it was."""

    uses_detections = False

    def __init__(self, closed: Phase, road: Road, health: Health) -> None:
        """Begin where a vehicle on a closed map has become lost, for the reason of its health."""
        self.closed = closed  # phase to which a vehicle comes back that is found
        self.search = Search(road)
        self.new_road: Road | None = None  # road beside the vehicle, in a frame of its own
        self._monitor = HealthMonitor()  # of the new road
        self._lost = self._health = health

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Remember what is seen; the health is that of the last attempt."""
        self.search.look(road, classified, reading)
        return self, self._health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Map the road beside the vehicle, and start the window anew where the vehicle is found."""
        drive.record.estimated(road)
        if drive.rests(road):
            self.new_road = None
            return Step(self)
        sees_road = self._map_new_road(road, drive, reading)
        found = self.search.find(road.smoother)
        if found is None:
            return self._go_on(self.search.is_off_map and sees_road)
        first_cycle = max(self.search.first_cycle, road.smoother.first_cycle)
        drive.monitor.restart()
        jump = start_anew(road.smoother, first_cycle, found)
        return Step(self.closed, jump, FOUND, Health(DEGRADED, FOUND))

    def _map_new_road(self, road: Road, drive: Drive, reading: Reading) -> bool:
        """Map the road beside the vehicle as an open one, with the calibration as it is known.

        Return whether both boundaries are there, and the estimate is good.
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

    def _go_on(self, is_new: bool) -> Step:
        """Go on searching; on new road, where no place of the map agrees, the vehicle is not lost."""
        before = self._health
        self._health = Health(DEGRADED, NEW_ROAD) if is_new else self._lost
        notice = NEW_ROAD if is_new and before == self._lost else ""
        return Step(self, notice=notice, health=self._health)


def _as_known(road: Road, drive: Drive) -> MapperSettings:
    """Return the settings with the priors of the calibrations about their present estimate."""
    variables, priors = road.smoother.variables, drive.priors
    return replace(
        road.settings,
        odometry=priors.odometry.about(variables.calibration.tolist()),
        calibration=priors.calibration.about(variables.sensor.tolist()),
    )
