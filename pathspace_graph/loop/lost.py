"""The lost vehicle: search its place on the closed map."""

from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, Health
from pathspace_graph.mapping.road import Classified, Road

from .drive import Drive, Phase, Step
from .relocalization import FOUND, Search, restart_window


class Lost(Phase):
    """Search for a lost vehicle; detections do not change the closed map."""

    uses_detections = False

    def __init__(self, closed: Phase, road: Road, health: Health) -> None:
        """Start when the vehicle on a closed map becomes lost, with the health that says why."""
        self.closed = closed  # phase of a vehicle that is found
        self.search = Search(road)
        self._health = health

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Record the detections for the search."""
        self.search.look(road, classified, reading)
        return self, self._health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Restart the window where the search finds the vehicle."""
        drive.record.estimated(road)
        found = None if drive.rests(road) else self.search.find(road.smoother)
        if found is None:
            return Step(self)
        first_cycle = max(self.search.first_cycle, road.smoother.first_cycle)
        drive.monitor.restart()
        jump = restart_window(road.smoother, first_cycle, found)
        return Step(self.closed, jump, FOUND, Health(DEGRADED, FOUND))
