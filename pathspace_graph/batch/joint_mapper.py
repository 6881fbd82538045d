"""The map of several logs: each drive is solved alone and placed on the map, then all are solved together."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SettingsError, SolveError, solving
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.lengths import scaled
from pathspace_graph.run import Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, Start, known_settings

from .joint import JointSystem, PlacedDrive, joint_state, revisits_between
from .mapper import BatchMapper, BatchResult, Found, frame_of, map_of, result_of, with_wider_priors
from .optimizer import Optimizer
from .placement import Driven, NotPlacedError, find_place


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

    Drives of one vehicle, if its name is known, share the calibration of the sensor.
    """
    scale, watch = next(iter(alone.values())).scale, Stopwatch()
    with threadpool_limits(limits=1), solving("the joint batch"):
        placed, left_out = place_all(alone, vehicles or {})
        watch.lap("place")
        joint = _Joint(placed, on_round, watch)
        joint.solve()
        result = joint.result(scale)
    return replace(result, left_out=left_out | joint.left_out)


def place_all(
    alone: Mapping[str, BatchResult], vehicles: Mapping[str, str]
) -> tuple[list[PlacedDrive], dict[str, str]]:
    """Place drives on the map of the base; return them, and by name why others do not fit."""
    known = base_of(alone)
    motions, left_out = {known: np.zeros(3)}, dict[str, str]()
    for name, one in alone.items():
        if name == known:
            continue
        try:
            motions[name] = find_place(driven(alone[known]), driven(one))
        except NotPlacedError as error:
            left_out[name] = str(error)
    names = [name for name in alone if name in motions]
    back = inverse(motions[names[0]])
    placed = [
        PlacedDrive(name, alone[name], compose(back, motions[name]), vehicles.get(name, "")) for name in names
    ]
    return placed, left_out


def base_of(alone: Mapping[str, BatchResult]) -> str:
    """Name of the drive whose curves are the start: the first closed one, or else the longest."""
    closed = (name for name, one in alone.items() if one.map.closed)
    return next(closed, max(alone, key=lambda name: float(path_lengths(alone[name].trajectory)[-1])))


def driven(result: BatchResult) -> Driven:
    return Driven(result.optimum.state, result.system.detections, result.system.settings)


class _Joint:
    """Search for the optimum of all drives; drives that contradict it are left out."""

    def __init__(
        self, placed: Sequence[PlacedDrive], on_round: Callable[[], None] | None, watch: Stopwatch
    ) -> None:
        self.placed, self.left_out = list(placed), dict[str, str]()
        self._on_round, self._watch = on_round, watch

    def solve(self) -> None:
        """Search the optimum, again without drives that contradict it."""
        base = base_of({one.name: one.alone for one in self.placed})
        self.system = JointSystem(self.placed)
        state = joint_state(self.system, next(one for one in self.placed if one.name == base))
        self.system.revisits += tuple(revisits_between(self.system, state))
        optimizer = Optimizer(self.system, on_round=self._on_round)
        found = Found(optimizer, *optimizer.find(state))
        why = {one.name: self.system.disagreement_of(d, found.at.state) for d, one in enumerate(self.placed)}
        wrong = {name: reason for name, reason in why.items() if reason}
        if wrong and len(wrong) < len(self.placed):
            self.left_out |= wrong
            self.placed = [one for one in self.placed if one.name not in wrong]
            self.solve()
            return
        self.found, self.known = with_wider_priors(found)
        self._watch.lap("optimum")

    def result(self, scale: float) -> JointResult:
        """Return the result in metres of the logs, whose scene has a scale."""
        track = map_of(self.found, self.known, self._orange(), self._watch)
        drives, frames = dict[str, BatchResult](), dict[str, Array]()
        for d, one in enumerate(self.placed):
            drive = result_of(
                self.found,
                self.known,
                track,
                settings=one.alone.settings,
                noise=one.alone.noise,
                chain=one.chain,
                seconds=self._watch.laps,
                drive=d,
            )
            drives[one.name] = scaled(drive, scale)
            frames[one.name] = frame_of(one.chain, drive.trajectory) * [scale, scale, 1.0]
        return JointResult(drives, frames, {})

    def _orange(self) -> dict[int, PointBoundary]:
        """Return the orange cones of the first drive that has some of a label, by label."""
        found = dict[int, PointBoundary]()
        for one in self.placed:
            own = scaled(one.alone.map, 1.0 / one.alone.scale).moved(one.motion).points
            found = {**own, **found}
        return found
