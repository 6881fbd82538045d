"""A known map: search the vehicle's place on it, and map a separate road meanwhile."""

from functools import partial
from typing import Final

import numpy as np

from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.health import DEGRADED, GOOD, Health
from pathspace_graph.io.map import Map
from pathspace_graph.mapping.constellation import LAID_NEWEST, Constellation, Expected, lay
from pathspace_graph.mapping.registration import Motion, RefinedMotion
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.settings.mapper import MapperSettings

from .closed import Closed
from .drive import Drive, Phase, Step
from .lap_solver import Outcome
from .open import Open
from .relocalization import Place, Search

SEEKING: Final = "the vehicle is not found on the known map yet"  # reason of the health during the search
PLACED: Final = "the vehicle is found on the known map"  # notice of the localization

PLACES: Final = 4  # places by curves that are checked by cones
ANYWHERE_CONES: Final = 12
"""Least number of matched cones; half of them are enough where odometry gives the approximate place."""
ANYWHERE_PATH: Final = 20.0
"""Least path length (m): two roads of equal width and spacing may look alike for one bend."""
CURVES_PATH: Final = 50.0  # least path length for a place by curves alone (m)
CURVES_SCORE: Final = 0.75
"""Least score of a place by curves alone. Places had at most 0.71 on maps of other tracks, and 0.66 to 0.89
on the right map."""
NEAR: Final = Expected.within(8.0, 0.3, (2.0, 2.0, 0.1))
"""Largest difference between the places by curves and by cones."""


class Seeking(Phase):
    """Search for the vehicle's place on a known map, with an open road of its own."""

    def __init__(
        self, settings: MapperSettings, track: Map, start: Array | None = None, keep: bool = False
    ) -> None:
        self.known = known = KnownMap.of(track, keep, settings.of_lines)
        self.start = start  # (3,) start pose of the drive on the known map, if given
        self.own: Phase = Open(settings)
        self._known = known.smoother(settings)
        self._cones = known.constellation
        self._search: Search | None = None

    def judge(
        self, road: Road, drive: Drive, classified: Classified, reading: Reading
    ) -> tuple[Phase, Health]:
        """Judge the own road, and record the detections for the search."""
        self.own, health = self.own.judge(road, drive, classified, reading)
        if self._search is None:
            self._search = Search(road, self.start)
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
        place = None if drive.rests(road) else self._place(road, drive, reading)
        if place is None:
            return Step(self, step.jump, step.notice, step.health)
        jump = drive.lay_on_known(road, self.known, *place)
        phase = Closed(road, drive) if self.known.closed else OnOpenMap()
        return Step(phase, jump, "; ".join(filter(None, [step.notice, PLACED])), Health(DEGRADED, PLACED))

    def _place(self, road: Road, drive: Drive, reading: Reading) -> tuple[Motion, Array] | None:
        """Return the motion onto the known map, and the covariance (3, 3) of the newest pose there.

        If the map has cones, they must agree as well.
        """
        search = self._search
        if search is None:
            return None
        if self.start is not None:
            choose = search.by_score
        elif self._cones is not None:
            choose = partial(self._by_cones, road, drive, reading, self._cones)
        else:
            choose = partial(self._by_curves, road, search)
        found = search.find(self._known, choose)
        return None if found is None else (found.motion, search.widened(found))

    def _by_curves(self, road: Road, search: Search, places: list[Place] | None) -> RefinedMotion | None:
        """Return the motion onto a place of a map without cones, after a long path with a good fit."""
        if not places or road.path.length < CURVES_PATH or places[0].score < CURVES_SCORE:
            return None
        return search.by_score(places)

    def _by_cones(
        self, road: Road, drive: Drive, reading: Reading, known: Constellation, places: list[Place] | None
    ) -> RefinedMotion | None:
        """Return the motion onto the only one of the best places where the newest cones match known ones."""
        record, newest = drive.record, road.poses[-1]
        if not places or record.unsolvable is not None or road.path.length < ANYWHERE_PATH:
            return None
        poses = record.with_window(road)
        first = int(path_lengths(poses).searchsorted(path_lengths(poses)[-1] - LAID_NEWEST))
        table = record.seen_in(road.smoother.variables.sensor, reading.noise)(np.arange(first, len(poses)))
        seen = Constellation.of(table, poses, road.settings.growth).seen_from(newest)
        chosen, agree = list[Place](), list[RefinedMotion]()
        for place in places:
            if len(chosen) == PLACES or any(place.is_near(other) for other in chosen):
                continue
            chosen.append(place)
            pose = newest[None].copy()
            place.found.motion.move(pose)
            laid = lay(seen, known, pose[0], NEAR.information, (NEAR.radius, NEAR.turn))
            if laid is not None and laid.is_sure and laid.count >= ANYWHERE_CONES:
                motion = Motion(newest[:2].copy(), laid.pose - newest)
                covariance = np.asarray(np.linalg.inv(laid.information), np.float64)
                agree.append(RefinedMotion(motion, place.found.matches, covariance))
        return agree[0] if len(agree) == 1 else None

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Continue from a batch of the own road."""
        return self.own.take(road, drive, outcome)


class OnOpenMap(Phase):
    """Localization on a known open map, which is refined and grows past a tentative end."""
