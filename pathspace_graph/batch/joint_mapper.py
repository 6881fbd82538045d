"""The map of several logs: each drive is solved alone and placed on the map, then all are solved as one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import SolveError, solving
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths
from pathspace_graph.io.log import Log
from pathspace_graph.io.moved import moved
from pathspace_graph.lengths import scaled
from pathspace_graph.mapping.motion import with_inflated_priors
from pathspace_graph.run import Stopwatch
from pathspace_graph.scale import chosen_scale
from pathspace_graph.settings.mapper import MapperSettings, Start, known_settings

from .joint import JointSystem, PlacedDrive, joint_state, revisits_between
from .mapper import (
    NAME,
    BatchMapper,
    BatchResult,
    frame_of,
    known_of,
    map_covariance,
    map_of,
    records_of,
    vehicle_of,
)
from .objections import unmapped
from .optimizer import Optimizer
from .placement import Driven, NotPlacedError, find_place
from .simplification import simplified


@dataclass(frozen=True, eq=False)
class JointResult:
    """The map of several drives, and what is known of each of them."""

    drives: dict[str, BatchResult]
    """Each drive that is in the map, by name; all have one map, in the frame of the first."""
    frames: dict[str, Array]
    """Pose (3,) of each vehicle at the first stamp of its log, which is the origin of its own frame."""
    left_out: dict[str, str]
    """Why each other drive is not in the map, by name."""


def solve_together(
    logs: Mapping[str, Log],
    make: Callable[[MapperSettings, Log], BatchMapper],
    settings: MapperSettings | None = None,
    start: Start | None = None,
    on_round: Callable[[], None] | None = None,
) -> JointResult:
    """Return one map of several logs by name, in the frame of the first log that is in it.

    `make` makes the mapper by which each log is solved alone. A log that can't be solved alone, or whose
    drive fits nowhere on the map of the others, is left out. SolveError where none is left.
    """
    settings = known_settings(settings)
    settings = replace(settings, scale=chosen_scale(settings, next(iter(logs.values()))))
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
    """Return one map of drives that were solved alone, at one scale.

    Drives of one vehicle, where its name is known, share the calibration of the sensor.
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
    """Return the drives that lie on the map of the base, and why each other doesn't, by name."""
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
    """Return the name of the drive with whose curves all begin: the first closed one, or else the longest."""
    closed = (name for name, one in alone.items() if one.map.closed)
    return next(closed, max(alone, key=lambda name: float(path_lengths(alone[name].trajectory)[-1])))


def driven(result: BatchResult) -> Driven:
    return Driven(result.optimum.state, result.system.detections, result.system.settings)


class _Joint:
    """The search for the optimum of all drives, from which those that contradict it are taken out."""

    def __init__(
        self, placed: Sequence[PlacedDrive], on_round: Callable[[], None] | None, watch: Stopwatch
    ) -> None:
        self.placed, self.left_out = list(placed), dict[str, str]()
        self._on_round, self._watch = on_round, watch

    def solve(self) -> None:
        """Search the optimum, and again without drives that contradict it."""
        base = base_of({one.name: one.alone for one in self.placed})
        self.system = JointSystem(self.placed)
        state = joint_state(self.system, next(one for one in self.placed if one.name == base))
        self.system.revisits += tuple(revisits_between(self.system, state))
        self.optimizer = Optimizer(self.system, on_round=self._on_round)
        self.at, self.convergence = self.optimizer.find(state)
        wrong = self._contradicting()
        if wrong and len(wrong) < len(self.placed):
            self.left_out |= wrong
            self.placed = [one for one in self.placed if one.name not in wrong]
            self.solve()
            return
        self._widen_priors()
        self._watch.lap("optimum")

    def _contradicting(self) -> dict[str, str]:
        """Return why drives don't agree with the optimum, by name."""
        found = {one.name: self.system.disagreement_of(d, self.at.state) for d, one in enumerate(self.placed)}
        return {name: why for name, why in found.items() if why}

    def _widen_priors(self) -> None:
        """Search the optimum again while it contradicts the prior of a calibration."""
        self.marginal, state, widened = known_of(self.system, self.at), self.at.state, False
        for d, settings in enumerate(self.system.priors):
            keys = state.calibration_keys(d)
            variance = np.diag(self.marginal.covariance(keys))
            wider = with_inflated_priors(state.variables.of(keys), variance, settings)
            if wider != settings:
                self.system.widen_priors_of(d, wider)
                widened = True
        if widened:
            self.at, self.convergence = self.optimizer.find(state)
            self._widen_priors()

    # --- the result --------------------------------------------------------------------------------------

    def result(self, scale: float) -> JointResult:
        """Return the result in metres of the logs, whose scene has a scale."""
        system, state, watch = self.system, self.at.state, self._watch
        settings = system.settings
        joint = map_covariance(state, self.marginal, settings)
        few = simplified(state, system.detections, settings)
        joint = few.change @ joint @ few.change.T
        watch.lap("simplify")
        track = replace(map_of(few, joint, settings), points=self._orange())
        drives, frames = dict[str, BatchResult](), dict[str, Array]()
        for d, (one, part) in enumerate(zip(self.placed, system.drives.parts(len(state.poses)), strict=True)):
            poses, seconds = state.poses[part], sum(watch.laps.values()) / len(self.placed)
            records, laps = records_of(few, one.chain, seconds, d)
            own = few.detections.of_drive(d)
            own = replace(own, cycle=own.cycle - part.start)
            vehicle = vehicle_of(state, self.marginal, settings, d)
            drive = BatchResult(
                estimator=NAME,
                settings=one.alone.settings,
                map=track,
                scatter=few.scatter,
                trajectory_t=one.chain.stamps,
                trajectory=poses.copy(),
                cycles=records,
                laps=laps,
                converged=self.convergence.converged,
                cost=self.convergence.cost,
                convergence=self.convergence,
                map_covariance=joint,
                calibration=vehicle.calibration,
                noise=one.alone.noise,
                vehicle=vehicle,
                online=None,
                seconds=watch.laps,
                system=system,
                optimum=self.at,
                objection=unmapped(own, poses),
                drive=d,
            )
            drives[one.name] = scaled(drive, scale)
            frames[one.name] = frame_of(one.chain, poses) * [scale, scale, 1.0]
        return JointResult(drives, frames, {})

    def _orange(self) -> dict[int, Any]:
        """Return the orange cones of the first drive that has some of a label, by label."""
        found: dict[int, Any] = {}
        for one in self.placed:
            own = moved(scaled(one.alone.map, 1.0 / one.alone.scale), one.motion).points
            found = {**own, **found}
        return found
