"""A known map: search the vehicle's place on it, and map a separate road meanwhile."""

from typing import Final

from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, GOOD, Health
from pathspace_graph.io.map import Map
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.places.find import KnownRoad
from pathspace_graph.settings.mapper import MapperSettings

from .closed import Closed
from .drive import Drive, Phase, Step
from .lap_solver import Outcome
from .lost import Search, widened
from .open import Open

SEEKING: Final = "the vehicle is not found on the known map yet"  # reason of the health during the search
PLACED: Final = "the vehicle is found on the known map"  # notice of the localization


class Seeking(Phase):
    """Search for the vehicle's place on a known map, with an open road of its own."""

    def __init__(
        self, settings: MapperSettings, track: Map, start: Array | None = None, keep: bool = False
    ) -> None:
        self.known = known = KnownMap.of(track, keep, settings.of_lines)
        self.start = start  # (3,) start pose of the drive on the known map, if given
        self.own: Phase = Open(settings)
        self._road = KnownRoad.of(known.splines, known.cones)
        self._search: Search | None = None

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Judge the own road, and record the detections for the search."""
        self.own, health = self.own.judge(road, drive, classified, reading)
        if self._search is None:
            self._search = Search(road, self._road, self.start)
        self._search.look(road, classified, reading)
        return self, Health(DEGRADED, SEEKING) if health.condition == GOOD else health

    def step(self, road: Road, drive: Drive, reading: Reading, spent: float) -> Step:
        """Replace the own road by the known map once its place is found; otherwise continue with it."""
        step = self.own.step(road, drive, reading, spent)
        if step.jump is not None:
            self._search = None  # the recorded path is no longer valid
        self.own = step.phase
        if road.closed:
            return step
        place = None if drive.rests(road) or self._search is None else self._search.find()
        if place is None:
            return Step(self, step.jump, step.notice, step.health)
        jump = drive.take_known(road, self.known, place.pose, widened(place))
        phase = Closed(road, drive) if self.known.closed else OnOpenMap()
        return Step(phase, jump, "; ".join(filter(None, [step.notice, PLACED])), Health(DEGRADED, PLACED))

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Continue from a batch of the own road."""
        return self.own.take(road, drive, outcome)


class OnOpenMap(Phase):
    """Localization on a known open map, which is refined and grows past a tentative end."""
