"""Several drives of one track as one problem: one set of curves, and a chain of poses for each drive.

Common observations connect the drives: curves, their stations, and poses of a later drive in the frame of an
earlier one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, SolveError, solving
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import compose, inverse, move_points, path_lengths
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.graph.variables import CALIBRATION_KEY, SENSOR_KEY, Drives, pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.lengths import scaled
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.places.find import (
    STRETCH,
    Constellation,
    KnownRoad,
    Prior,
    find,
    find_return,
    revisit_of,
    seen_in,
    sure,
)
from pathspace_graph.run import Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, Start, known_settings

from .association import locate_poses
from .lap import disagreement
from .mapper import BatchMapper, BatchResult, Found, frame_of_drive, results_of, with_wider_priors
from .simplification import boundary_of
from .start import REVISIT_INTERVAL
from .system import BatchSystem, Optimizer


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A drive that was solved alone, and its place on the common map."""

    name: str
    alone: BatchResult
    motion: Array  # (3,) from the frame of the drive to that of the map
    vehicle: str = ""  # name of the vehicle, if the log has it

    @property
    def chain(self) -> LogOdometry:
        return self.alone.system.chains[0]

    @property
    def state(self) -> State:
        """Optimum of the drive alone, in its own frame."""
        return self.alone.optimum.state

    @property
    def settings(self) -> MapperSettings:
        """Settings with the drive's own priors of its calibrations."""
        return self.alone.system.settings

    @property
    def poses(self) -> Array:
        """Poses (P, 3) of the drive alone, in the frame of the map."""
        return compose(self.motion, self.state.poses)


def drives_of(placed: Sequence[PlacedDrive]) -> Drives:
    """Lay out drives and sensors; the drives of a named vehicle share one sensor."""
    first = np.cumsum([0, *(len(one.chain) for one in placed[:-1])]).tolist()
    names = [one.vehicle or f"/{k}" for k, one in enumerate(placed)]
    known = list(dict.fromkeys(names))
    return Drives(tuple(first), tuple(known.index(name) for name in names))


def joint_system(placed: Sequence[PlacedDrive]) -> BatchSystem:
    """Build the problem of several drives with one set of curves, and the revisits of each alone."""
    drives = drives_of(placed)
    revisits = [
        replace(one, earlier=one.earlier + begin, later=one.later + begin)
        for drive, begin in zip(placed, drives.first, strict=True)
        for one in drive.alone.system.revisits
    ]
    detections = DetectionTable.of_drives([one.alone.system.detections for one in placed], drives)
    chains, priors = [one.chain for one in placed], [one.settings for one in placed]
    return BatchSystem(detections, chains, priors, revisits)


def joint_state(placed: Sequence[PlacedDrive], known: PlacedDrive) -> State:
    """Build a state of the curves of one drive and the poses of all, each as placed alone."""
    drives = drives_of(placed)
    state = State(drives=drives)
    for label, spline in known.state.splines.items():
        curve = replace(spline, control_points=move_points(known.motion, spline.control_points))
        state.add_boundary(label, *boundary_of(curve, placed[0].settings))
    variables, poses = state.variables, np.concatenate([one.poses for one in placed])
    own = np.concatenate([one.state.variables.calibration for one in placed])
    variables.insert(CALIBRATION_KEY + np.arange(len(placed)), own)
    sensors = np.array([one.state.variables.sensor for one in placed])
    if sensors.size:
        numbers = np.array(drives.sensors)
        means = [sensors[numbers == number].mean(axis=0) for number in range(numbers.max() + 1)]
        variables.insert(SENSOR_KEY + np.arange(len(means)), np.concatenate(means))
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    locate_poses(state)
    return state


def revisits_between(system: BatchSystem, state: State) -> list[Revisit]:
    """Return poses of each later drive in the frame of one of an earlier drive, by their common cones."""
    settings, found = system.settings, list[Revisit]()
    table = system.detections.cones(settings.of_lines)
    table.correct(state.variables.sensor)
    driven = path_lengths(state.poses)
    for part in state.drives.parts(len(driven))[1:]:
        before, due = float(driven[part.start]), REVISIT_INTERVAL
        for newest in range(part.start, part.stop):
            if driven[newest] - before < due:
                continue
            due = driven[newest] - before + REVISIT_INTERVAL
            poses = state.poses[: newest + 1]
            again = find_return(seen_in(table), poses, before, settings)
            if again is not None:
                found.append(revisit_of(again[0], poses, again[1], newest))
    return found


# --- the place of a drive --------------------------------------------------------------------------------


LEAST_DRIVEN: Final = 30.0  # least length of a drive (m)
ABOUT_START: Final = (5.0, 2.0, 0.1), (15.0, 0.3)
"""Sigmas (m, m, rad) and largest distance (m, rad) of the starts of two drives of an open road."""

OTHER_TRACK: Final = "it fits nowhere on the map of the other drives"
OTHER_WAY: Final = "it goes the other way round"
TWO_PLACES: Final = "it fits in two places of the map of the other drives"
OTHER_START: Final = "its cones do not determine where it begins on the open road of the other drives"


class NotPlacedError(Exception):
    """A drive has no sure place on the map; the message says why."""


@dataclass(frozen=True, eq=False)
class Driven:
    """A drive that was solved alone: curves, poses, and the detections on the curves."""

    state: State
    detections: DetectionTable
    settings: MapperSettings

    @cached_property
    def driven(self) -> Array:
        """Length (m) of the path to each pose (P,)."""
        return path_lengths(self.state.poses)

    def seen(self, begin: float = 0.0, end: float = np.inf) -> Constellation:
        """Return the cones or points of lines detected on a stretch of the drive (m), in its frame."""
        cycles = np.flatnonzero((self.driven >= begin) & (self.driven <= end))
        table, of_lines = seen_in(self.detections)(cycles), self.settings.of_lines
        return Constellation.of(table, self.state.poses, self.settings.growth, of_lines=of_lines)

    @cached_property
    def road(self) -> KnownRoad:
        """The drive's map as a known road."""
        road = KnownRoad.of(self.state.splines)
        return road if self.settings.of_lines else replace(road, seen=self.seen())


def find_place(known: Driven, drive: Driven) -> Array:
    """Find the motion (3,) of a drive onto a known one; NotPlacedError if none is sure.

    Hypotheses along an open road are ambiguous, so both drives must begin at about the same place there.
    """
    if drive.driven[-1] < LEAST_DRIVEN:
        raise NotPlacedError(f"it is shorter than {LEAST_DRIVEN:g} m")
    if not known.state.closed:
        begin = find(drive.seen(0.0, STRETCH), known.road.seen, Prior.about(np.zeros(3), *ABOUT_START))
        if (place := sure(begin)) is None:
            raise NotPlacedError(OTHER_START)
        return place.pose
    motion, found = _by_stretches(known.road, drive)
    if motion is not None:
        return motion
    backwards, _ = _by_stretches(known.road.backwards(), drive)
    if backwards is not None:
        raise NotPlacedError(OTHER_WAY)
    raise NotPlacedError(TWO_PLACES if found else OTHER_TRACK)


def _by_stretches(road: KnownRoad, drive: Driven) -> tuple[Array | None, bool]:
    """Return the motion of the first stretch with a sure place, and whether one fits anywhere."""
    fits, ends = False, np.arange(STRETCH, float(drive.driven[-1]) + STRETCH, STRETCH)
    for end in np.minimum(ends, drive.driven[-1]).tolist():
        within = (drive.driven >= end - STRETCH) & (drive.driven <= end)
        poses = drive.state.poses[within]
        seen = drive.seen(end - STRETCH, end).seen_from(poses[-1])
        place = find(seen, road.seen, road.along(poses))
        if place is not None and sure(place):
            return compose(place.pose, inverse(poses[-1])), True
        fits |= place is not None and place.odds > -np.inf
    return None, fits


# --- the batch of several drives -------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JointResult:
    """The map of several drives, and the result of each."""

    drives: dict[str, BatchResult]
    """Result of each drive in the map, by name; all have one map, in the frame of the first."""
    frames: dict[str, Array]
    """Pose (3,) of each vehicle at the first stamp of its log, the origin of its own frame."""
    left_out: dict[str, str]
    """Reason for which each other drive is not in the map, by name."""


def solve_together(
    logs: Mapping[str, Log],
    make: Callable[[MapperSettings, Log], BatchMapper],
    settings: MapperSettings | None = None,
    start: Start | None = None,
    on_round: Callable[[], None] | None = None,
) -> JointResult:
    """Solve one map of several logs by name, in the frame of the first log that is in it.

    `make` makes the mapper that solves each log alone. A log that cannot be solved alone, or whose drive fits
    nowhere on the map of the others, is left out. SolveError if none is left.
    """
    settings = known_settings(settings)
    scales = {name: log.scale for name, log in logs.items()}
    if len(set(scales.values())) > 1:
        raise SettingsError(f"scale: expected logs of one scale, found {scales}")
    alone, left_out = dict[str, BatchResult](), dict[str, str]()
    for name, log in logs.items():
        try:
            alone[name] = make(settings, log).solve(log, start, on_round)
        except SolveError as error:
            left_out[name] = str(error)
    if not alone:
        raise SolveError(next(iter(left_out.values())))
    joint = join(alone, {name: log.source.get("vehicle", "") for name, log in logs.items()}, on_round)
    return replace(joint, left_out=left_out | joint.left_out)


def join(
    alone: Mapping[str, BatchResult],
    vehicles: Mapping[str, str] | None = None,
    on_round: Callable[[], None] | None = None,
) -> JointResult:
    """Solve one map of drives that were solved alone, at one scale.

    Drives of one vehicle, if its name is known, share the calibration of the sensor. Drives without a sure
    place on the map of the base, and those that contradict the optimum, are left out.
    """
    scale, vehicles, watch = next(iter(alone.values())).scale, vehicles or {}, Stopwatch()
    with threadpool_limits(limits=1), solving("the joint batch"):
        known = base_of(alone)
        motions, left_out = {known: np.zeros(3)}, dict[str, str]()
        for name, result in alone.items():
            try:
                if name != known:
                    motions[name] = find_place(driven(alone[known]), driven(result))
            except NotPlacedError as error:
                left_out[name] = str(error)
        names = [name for name in alone if name in motions]
        back = inverse(motions[names[0]])
        placed = [
            PlacedDrive(name, alone[name], compose(back, motions[name]), vehicles.get(name, ""))
            for name in names
        ]
        watch.lap("place")
        while True:
            base = base_of({one.name: one.alone for one in placed})
            system = joint_system(placed)
            state = joint_state(placed, next(one for one in placed if one.name == base))
            system.revisits += tuple(revisits_between(system, state))
            optimizer = Optimizer(system, on_round=on_round)
            found = Found(optimizer, *optimizer.find(state))
            contradicted = dict[str, str]()
            for d, (one, part) in enumerate(zip(placed, state.drives.parts(len(state.poses)), strict=True)):
                poses, variables = found.at.state.poses[part], found.at.state.variables
                to_own = compose(one.state.poses[0], inverse(poses[0]))
                calibration = variables.calibration.reshape(-1, CALIBRATION_SIZE)[d]
                if why := disagreement(one.alone.system, compose(to_own, poses), calibration):
                    contradicted[one.name] = why
            if not contradicted or len(contradicted) == len(placed):
                break
            left_out |= contradicted
            placed = [one for one in placed if one.name not in contradicted]
        found, known_system = with_wider_priors(found)
        watch.lap("optimum")
        orange = dict[int, PointBoundary]()  # of the first drive that has some of a label
        for one in placed:
            own = scaled(one.alone.map, 1.0 / one.alone.scale).moved(one.motion).points
            orange = {**own, **orange}
        origins = [(one.alone.settings, one.alone.noise) for one in placed]
        drives, frames = dict[str, BatchResult](), dict[str, Array]()
        for one, result in zip(placed, results_of(found, known_system, origins, orange, watch), strict=True):
            drives[one.name] = scaled(result, scale)
            frames[one.name] = frame_of_drive(one.chain, result.trajectory) * [scale, scale, 1.0]
    return JointResult(drives, frames, left_out)


def base_of(alone: Mapping[str, BatchResult]) -> str:
    """Name of the drive whose curves are the start: the first closed one, or else the longest."""
    closed = (name for name, one in alone.items() if one.map.closed)
    return next(closed, max(alone, key=lambda name: float(path_lengths(alone[name].trajectory)[-1])))


def driven(result: BatchResult) -> Driven:
    return Driven(result.optimum.state, result.system.detections, result.system.settings)
