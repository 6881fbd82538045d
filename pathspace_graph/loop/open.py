"""The open map, which a batch of the drive closes; and a vehicle not yet found on a known map."""

from dataclasses import replace
from math import inf
from typing import ClassVar, Final

import numpy as np

from pathspace_graph.batch.association import LINE_STEP
from pathspace_graph.batch.known_map import KnownMap
from pathspace_graph.batch.start import REVISIT_INTERVAL, StartMap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths, to_vehicle
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.health import DEGRADED, GOOD, Health
from pathspace_graph.io.map import Map
from pathspace_graph.loop.closed import Closed, Search, widened
from pathspace_graph.loop.drive import Drive, DriveRecord, Phase, Step
from pathspace_graph.loop.lap_solver import Outcome, Unsolved
from pathspace_graph.mapping.path import HEADING
from pathspace_graph.mapping.road import Classified, Road
from pathspace_graph.places.find import (
    CLOSES_WITHIN,
    NEARBY,
    NEWEST_PATHS,
    REACH,
    KnownRoad,
    Prior,
    SampledCurves,
    newest_paths,
    newest_place,
    return_to_beginning,
    revisit_of,
)
from pathspace_graph.settings.mapper import MapperSettings

STAYS_OPEN: Final = "the loop stays open"  # beginning of the notice without a batch that agrees
REVISITED: Final = "the road was driven before: the open map was optimized with the earlier pass"
"""Notice of the first cycle with a revisit."""
RETRY: Final = 20.0  # least path from one batch of the lap to the next, where it does not agree (m)
MOST_CONES: Final = 4000  # most cones of a lap that is solved as a batch: with more it would not be in time
MOST_LAID_ON: Final = (
    300  # most control points of an open map that a batch replaces: a cycle takes their cube
)
TOO_LONG: Final = "the open road is too long"
NOT_REVISITED: Final = "an earlier pass of the road is not used"  # beginning of the notice of a failed batch


class Open(Phase):
    """Search for a return to the beginning, and for other road that is driven again."""

    CLOSED: ClassVar = Closed  # class of the phase after the loop has closed

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.returns = ReturnFinder(settings)
        self.revisits = Revisits(settings)
        self.asked_by: Revisit | None = None  # relative pose that started the newest batch
        self._found: Revisit | None = None  # found in the last cycle; its batch starts in this one
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
        """Start a batch where the newest detections match an earlier pass; take its result once it is due.

        The map stays as it is until the batch confirms the match.
        """
        if not drive.solver.is_busy:
            cones = sum(  # or equivalent places on a line
                boundary.length / LINE_STEP if self.settings.of_lines else len(boundary.cone_parameters)
                for boundary in road.boundaries.values()
            )
            if cones > MOST_CONES:
                drive.record.give_up("the lap has too many cones for a batch")
            if drive.record.unsolvable is not None:
                self._found = None
                said, self._said = self._said, True  # only the first notice says why
                return Step(self, notice="" if said else f"{STAYS_OPEN}: {drive.record.unsolvable}")
            if self._found is None:
                return self._search(road, drive, reading.noise)
            self.begin(road, drive, reading.noise)
        outcome = drive.outcome(road, spent)
        return Step(self) if outcome is None else self.take(road, drive, outcome)

    def _search(self, road: Road, drive: Drive, noise: NoiseLearner) -> Step:
        """Look for a return to the beginning, or else for other road that is driven again."""
        revisit, record = None, drive.record
        if road.path.length > self.settings.closing.min_path:
            revisit = self.returns.find(road, record, noise)
        self._closes = revisit is not None
        if self._closes:
            self.returns.rest(road, RETRY)
        else:
            revisit = self.revisits.find(road, record, noise)
            if revisit and sum(one.size for one in road.boundaries.values()) > MOST_LAID_ON:
                said, self._said = self._said, True
                return Step(self, notice="" if said else f"{NOT_REVISITED}: {TOO_LONG}")
        self._found = revisit
        return Step(self)

    def begin(self, road: Road, drive: Drive, noise: NoiseLearner) -> None:
        """Start the batch of the return or the revisit that the last cycle has found, if it has."""
        if self._found is not None:
            self.asked_by, self._found, self._taken_back = self._found, None, road.growth.taken_back
            start = None if self._closes else open_map(road, drive.record.with_window(road))
            drive.begin_batch(road, noise, start, (self.asked_by, *drive.revisits))

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
            jump = drive.take(road, outcome, self.asked_by)
            return Step(self.CLOSED(road), jump)
        if road.growth.taken_back > self._taken_back:
            return Step(self, notice=f"{failed}: a curve was taken back")
        notice = "" if drive.revisits else REVISITED  # only the first time
        return Step(self, drive.take(road, outcome, self.asked_by), notice)


def open_map(road: Road, poses: Array) -> StartMap:
    """Return the present map of an open road, with the poses (P, 3) of all cycles."""
    road.smoother.transform_to_origin()
    state = road.smoother.map.state
    ends = {label: boundary.confirmed_end for label, boundary in state.boundaries.items()}
    return StartMap(state.splines, poses, state.variables.calibrations.copy(), ends)


# --- a return to the beginning ---------------------------------------------------------------------------


RETURN_CYCLES: Final = 10  # number of cycles between attempts of a vehicle that hardly moves
ASTRAY: Final = 0.2  # largest error of the position by the path: farther away, no covariance is needed
SERVES: Final = 10.0  # path on which a covariance serves as the prior (m)


class ReturnFinder(Copyable):
    """Search for a return of an open road, some metres or cycles after the last attempt.

    So that no cycle is slow, the covariance of the prior has its own, and so has each length of the newest
    path.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._tried = -inf, 0  # path length (m) and cycle of the last attempt
        self._attempts = 0
        self._known = -inf, np.zeros((3, 3))  # path length (m) of the newest covariance, and that
        self._rests_until = 0.0  # path length of the next attempt (m)

    def rest(self, road: Road, length: float) -> None:
        """Pause the search for a length (m) from here."""
        self._rests_until = road.path.length + length

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the newest pose relative to an early one, if it is recognized there."""
        length, cycle, closing = road.path.length, road.next_cycle, self._settings.closing
        tried, tried_cycle = self._tried
        waited = length >= tried + closing.check_interval or cycle >= tried_cycle + RETURN_CYCLES
        if length < self._rests_until or not waited:
            return None
        if not self._may_return(road, record):
            self._tried = length, cycle
            return None
        curves, smoother = None, road.smoother
        if length > self._known[0] + SERVES:
            self._known = length, smoother.newest_covariance()
            return None
        self._tried = length, cycle
        if self._settings.of_lines:
            smoother.transform_to_origin()
            smoother.refresh()
            ends = {label: boundary.confirmed_end for label, boundary in road.boundaries.items()}
            curves = SampledCurves.of(smoother.map.state.splines, ends)
        lengths, self._attempts = newest_paths(length), self._attempts + 1
        newest = lengths[self._attempts % len(lengths)]
        seen_in = record.seen_in(smoother.variables.sensor, noise)
        poses = record.with_newest_path(road, NEWEST_PATHS[-1])
        return return_to_beginning(seen_in, poses, self._known[1], road.settings, curves, (newest,))

    def _may_return(self, road: Road, record: DriveRecord) -> bool:
        """Whether the newest pose may be on the beginning again, whatever its covariance is."""
        if self._settings.of_lines:
            closing = self._settings.closing
            return bool(road.boundaries) and road.path.near_beginning(road.poses[-1], closing)
        poses = record.with_window(road)
        away = np.hypot(*(poses[path_lengths(poses) < CLOSES_WITHIN, :2] - poses[-1, :2]).T)
        return bool(away.min() < REACH[0] + ASTRAY * road.path.length)


# --- other road that is driven again ---------------------------------------------------------------------


REVISIT_ATTEMPTS: Final = 3.0  # distance between attempts (m along the path)
RETURN: Final = 30.0  # least path length between both passes (m)
DIVERGED: Final = 8.0  # least separation of the ways to both passes, seen from the place (m)
WAY: Final = 100.0  # length of the compared ways (m)
WAY_STEP: Final = 4.0  # step of their points (m)


class Revisits(Copyable):
    """Search for road that an open drive revisits."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self._next = RETURN  # path length of the next attempt (m)

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the window's oldest pose relative to one of an earlier pass, if an attempt finds it.

        The newest pose will stay in the window, and the batch's marginal has no measurement of such a pose.
        """
        length = road.path.length
        if length < self._next or self.settings.of_lines:
            return None
        self._next = length + REVISIT_ATTEMPTS
        poses = record.with_window(road)
        place, later = earlier_pass(poses), road.smoother.first_cycle
        if place is None or place >= later:
            return None
        seen_in = record.seen_in(road.smoother.variables.sensor, noise)
        nearby = Prior.about(poses[-1], *NEARBY)
        found = newest_place(seen_in, poses, np.array([place]), nearby, self.settings)
        if found is None:
            return None
        self._next = length + REVISIT_INTERVAL
        return revisit_of(found, poses, place, later)


def earlier_pass(poses: Array) -> int | None:
    """Return the nearest cycle of the first earlier pass by the newest of the poses (P, 3), if there is one.

    The ways to both passes must part: otherwise the drive came past its start, as in a lap.
    """
    newest = poses[-1]
    near = np.hypot(*(poses[:, :2] - newest[:2]).T) < NEARBY[1][0]
    if path_lengths(poses[near.argmax() :])[-1] <= RETURN:
        return None  # only the newest poses are near
    stations = path_lengths(poses)
    near &= np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING)
    near &= stations < stations[-1] - RETURN
    cycles = np.flatnonzero(near)
    for run in np.split(cycles, np.flatnonzero(np.diff(cycles) > 1) + 1) if len(cycles) else []:
        place = int(run[np.hypot(*(poses[run, :2] - newest[:2]).T).argmin()])
        if have_parted(poses, stations, place):
            return place
    return None


def have_parted(poses: Array, stations: Array, place: int) -> bool:
    """Whether the ways to the newest of the poses (P, 3) and to an earlier one at `place` part."""
    back, ways = np.arange(0.0, min(float(stations[place]), WAY), WAY_STEP), []
    for cycle in (place, -1):
        at = stations[cycle] - back
        points = np.column_stack([np.interp(at, stations, poses[:, k]) for k in range(2)])
        ways.append(to_vehicle(points, poses[cycle][None]))
    return bool((np.hypot(*(ways[0] - ways[1]).T) > DIVERGED).any())


# --- not yet found on a known map ---------------------------------------------------------------------------


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
        phase = Closed(road, self.known.crosses) if self.known.closed else OnOpenMap()
        return Step(phase, jump, "; ".join(filter(None, [step.notice, PLACED])), Health(DEGRADED, PLACED))

    def begin(self, road: Road, drive: Drive, noise: NoiseLearner) -> None:
        """Start a batch of the own road."""
        self.own.begin(road, drive, noise)

    def take(self, road: Road, drive: Drive, outcome: Outcome) -> Step:
        """Continue from a batch of the own road."""
        return self.own.take(road, drive, outcome)


class OnOpenMap(Phase):
    """Localization on a known open map, which is refined and grows past a tentative end."""
