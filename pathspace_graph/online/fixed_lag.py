"""Fixed-lag online mapping, in the order of the paper: predict, classify, expand, update, close."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import gtsam
import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.front_end.gate import Admitted
from pathspace_graph.graph.variables import POSE
from pathspace_graph.health import Health
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop import worker
from pathspace_graph.loop.drive import Drive, Phase
from pathspace_graph.loop.open import Open
from pathspace_graph.loop.seeking import Seeking
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.mapping.road import Road
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, known_settings

from .estimate import MapperEstimate


@dataclass(frozen=True, eq=False)
class _Before:
    """Copy of a mapper's state before a cycle."""

    front_end: FrontEnd
    road: Road
    drive: Drive
    phase: Phase
    health: Health

    @classmethod
    def of(cls, mapper: "FixedLagMapper") -> Self:
        front_end, road = mapper.front_end.copy(), mapper.road.copy()
        return cls(front_end, road, mapper.drive.copy(), mapper.phase.copy(), mapper.health)


class FixedLagMapper(MapperEstimate):
    """Fixed-lag smoother of both boundaries of a track, as splines in one factor graph with the poses.

    Each cycle solves for the poses of the last `settings.lag` seconds and for every control point. All
    earlier information is in a Gaussian prior. `odometry_sigma` (3,) is the standard deviation of one
    measured twist (m/s, m/s, rad/s).
    """

    ROAD: ClassVar = Road  # class of the estimate
    FIRST_PHASE: ClassVar = Open  # class of the first phase

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        noise = known_noise(odometry_sigma)
        self.failures = 0  # number of failed updates
        self.front_end = FrontEnd(self.settings, noise)
        self.road: Road = self.ROAD(self.settings)
        self.drive = Drive(self.settings)
        self.phase: Phase = self.FIRST_PHASE(self.settings)
        self.health = Health()  # health of the newest estimate
        self._unused: Odometry | None = None  # twists of a skipped cycle
        worker.submit(worker.nothing)  # start the process now: a cycle would wait for it

    @classmethod
    def on(
        cls,
        track: Map,
        settings: MapperSettings | None = None,
        odometry_sigma: Array | KnownNoise | None = None,
        *,
        start: Array | None = None,
        keep: bool = False,
    ) -> Self:
        """Return a mapper on a known map; all results are in its frame once the vehicle is found on it.

        Until then the mapper maps a road of its own. `start` (3,) in m, m and rad, map frame, is the
        approximate first pose; it is required on an open map and optional on a closed one. Detections refine
        the map, unless `keep` fixes it. SettingsError is raised for a map without both curves or without
        covariances.
        """
        mapper = cls(settings, odometry_sigma)
        pose = None if start is None else np.array(start, float)
        mapper.phase = Seeking(mapper.settings, track, pose, keep)
        return mapper

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        *,
        strict: bool = False,
    ) -> CycleResult:
        """Process one perception cycle: the twists since the last cycle, and its detections.

        An unusable cycle (`front_end.gate`, `settings.mapper`) raises a ReadingError and changes nothing.
        Impossible detections are dropped and counted. Each twist is held until the next one; twists that end
        before the newest cycle are left out.

        The call waits for a running batch no longer than the time since the previous cycle. A replay calls
        `wait` first, so that the map does not depend on the speed of the machine.

        `factors` are GTSAM factors of your own, on poses in the window (`pose_key`,
        `next_pose_key`: `Pose2`), on control points (`control_keys`: `Point2`) and on the calibration. Each
        is relinearized at every step until one of its poses leaves the window; then it is part of the prior.
        The batch of the lap includes the factors as rows, since one in Python cannot reach its process:
        linearized in this cycle, or when the batch begins if it is on control points. There, and after the
        loop has closed, the curves have other knots. So one on control points becomes one on the points of
        the curves that determine them. A factor without information is left out.
        SettingsError is raised, and nothing changes, if a key is not a variable of the graph or a number is
        not finite.

        No other error is raised, unless `strict`: if a step fails, the mapper restores its state before the
        cycle and retries with less, as the notice says, and `failures` counts.
        """
        factors = tuple(factors)
        cycle = self._admit(odometry, detections, factors)
        before = _Before.of(self)
        try:
            result = self._process(cycle, factors)
        except Exception as error:  # the vehicle drives on, whatever fails
            if strict:
                self._go_back(before)
                raise
            result = self._without(before, cycle, factors, error)
        else:
            self._unused = None
        return cycle.counted(result)

    def _process(self, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor]) -> CycleResult:
        """Run the steps of the paper, and the step of the phase."""
        watch, road, drive = Stopwatch(), self.road, self.drive
        factors = road.smoother.informative(factors)
        held = road.add_factors(factors)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        road.predict(reading.motion, reading.orange)
        drive.record.measured(reading)
        drive.record.given(factors, road)
        watch.lap("predict")
        twist, use = reading.motion.odometry.twist, self.phase.uses_detections
        classified = road.classify(reading.detections, twist, use=use)
        phase, health = self.phase.judge(road, drive, classified, reading)
        watch.lap("classify")
        grown = road.expand()  # through detections that no curve explains
        watch.lap("expand")
        road.update()
        watch.lap("update")
        step = phase.step(road, drive, reading, watch.spent)
        watch.lap("loop")
        road.marginalize(drive.solver.first_kept)
        watch.lap("marginalize")
        self.phase, self.health = step.phase, step.health or health
        notice = "; ".join(filter(None, [held, step.notice, grown, reading.notice]))
        return self._result(cycle.detections.t, watch.laps, step.jump, notice)

    def _without(
        self, before: _Before, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor], error: Exception
    ) -> CycleResult:
        """Retry a failed cycle with the road alone, then without detections; otherwise skip the cycle.

        Each attempt starts from the state before the cycle. The notice says what failed.
        """
        self.failures += 1
        why = f": {type(error).__name__}: {error}" if self.failures == 1 else f" (failure {self.failures})"
        failed, seen = " ".join(f"an update failed{why}".split()), cycle.detections
        blind = replace(cycle, detections=seen.where(np.zeros(len(seen.labels), bool)))
        attempts = {"the loop is left as it is": cycle, "its detections are not used": blind}
        for consequence, attempt in attempts.items():
            self._go_back(before)
            self.drive.rest(self.road)
            try:
                result = self._process(attempt, factors)
            except Exception:  # the next attempt does less
                continue
            self._unused = None
            return replace(result, notice="; ".join(filter(None, [failed, consequence, result.notice])))
        self._go_back(before)
        self._unused = cycle.odometry
        return self._result(cycle.detections.t, {}, None, f"{failed}; the cycle is not used")

    def _go_back(self, before: _Before) -> None:
        """Restore the state before a cycle; `before` can be used again."""
        self.front_end, self.road = before.front_end.copy(), before.road.copy()
        self.drive, self.phase = before.drive.copy(), before.phase.copy()
        self.health = before.health

    def _admit(
        self, odometry: Odometry, detections: Detections, factors: Sequence[gtsam.NonlinearFactor]
    ) -> Admitted:
        try:
            self.road.smoother.check_factors(factors)
        except SettingsError:
            self.front_end.gate.refuse()
            raise
        cycle, unused = self.front_end.admit(odometry, detections), self._unused
        return cycle if unused is None else replace(cycle, odometry=unused.followed_by(cycle.odometry))

    def finish(self) -> None:
        """Wait for a running batch and use its result, after the last cycle of a drive.

        A return in the last metres of a drive closes the loop only here.
        """
        outcome = self.drive.solver.last_outcome(self.road.next_cycle - 1)
        if outcome is not None:
            self.phase = self.phase.take(self.road, self.drive, outcome).phase

    def _result(self, t: float, stages: dict[str, float], jump: Array | None, notice: str) -> CycleResult:
        road = self.road
        left, right = (road.boundaries[b].size if b in road.boundaries else 0 for b in (LEFT, RIGHT))
        pose = road.poses[-1].copy() if len(road.poses) else np.zeros(POSE)
        detections, closed = road.smoother.map.detections, road.closed
        used = int(detections.used[detections.cycle.searchsorted(road.next_cycle - 1) :].sum())
        return CycleResult(t, pose, (left, right), used, closed, stages, jump, notice, self.health)

    def noise_used(self) -> RunNoise:
        """Return the noise in use, and the newest measurement."""
        return self.front_end.noise_used
