"""Fixed-lag online mapping, in the paper's order: predict, classify, expand, update, close, simplify."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, Self

import gtsam
import numpy as np

from pathspace_graph.checkpoint import Recovery
from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.front_end.gate import Admitted
from pathspace_graph.health import GOOD
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.results import RunNoise
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.lengths import joined, scaled
from pathspace_graph.loop.closing import simplify
from pathspace_graph.loop.track_loop import TrackLoop
from pathspace_graph.mapping.motion import known_noise, predict
from pathspace_graph.mapping.orange import OrangeCones, Sighting
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, known_settings
from pathspace_graph.snapshot import restore, save

from .estimate import MapperEstimate
from .growth import Growth

ROAD: Final = 10.0  # length of both boundaries beside a lost vehicle that make a road (m)


class FixedLagMapper(MapperEstimate):
    """Both boundaries of a track, mapped cycle by cycle as splines in one factor graph with the poses.

    Each cycle solves for the poses of the last `settings.lag` seconds and for every control point; all
    earlier information is a Gaussian prior. `odometry_sigma` (3,) is the standard deviation of one measured
    twist (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        self.scale = self.settings.scale or 1.0
        """Size of the scene: a cycle comes in its metres, and so does what is asked for."""
        noise = known_noise(odometry_sigma, self.scale)
        self.odometry_sigma = noise.odometry
        self.front_end = FrontEnd(self.settings, noise, self.scale)
        self.smoother = CurveSmoother(self.settings)
        """Variables, factors of the window, and the prior."""
        self.path = DrivenPath()
        self.growth = Growth(self.smoother)
        """Tentative tracks, through which the open curves grow."""
        self.orange = OrangeCones(self.settings.growth, self.settings.spline.sigma_shape)
        """Orange cones, which are points of the map."""
        self.smoother.attach(self.path, self.growth, self.orange)
        self.loop = TrackLoop(self.smoother, self.path, self.front_end.noise)
        if self.settings.open_lap.prior == "window":
            self.loop.record.give_up("no batch of the lap was asked for")
        self.recovery = Recovery()
        self.new_road: FixedLagMapper | None = None  # road beside a lost vehicle, from where the search began
        self._unused: Odometry | None = None  # twists of a cycle that was left out
        self._grown: frozenset[int] = frozenset()

    def update(
        self,
        odometry: Odometry,
        detections: Detections,
        factors: Sequence[gtsam.NonlinearFactor] = (),
        *,
        strict: bool = False,
    ) -> CycleResult:
        """Process one perception cycle: the twists since the last cycle, and its detections.

        A cycle that cannot be used (`front_end.gate`, `settings.online`) raises a ReadingError and changes
        nothing; impossible detections are dropped and counted in the result. The twists are a stream: each is
        held until the next one, those in force before the newest cycle are left out, and where some are lost,
        the last one is held.

        Where another process solves the lap as a batch, the call waits for it no longer than the time since
        the cycle before, and the map is replaced in a later cycle if need be. A replay of a log calls `wait`
        before, so that it does not depend on the speed of the machine.

        `factors` are GTSAM factors of your own, at scale 1, on poses in the window (`pose_key`,
        `next_pose_key`: `Pose2`), on control points (`control_keys`: `Point2`) and on the calibration. Each
        is relinearized at every step until one of its poses leaves the window; then it is part of the prior.
        One on control points alone is kept until the loop closes. SettingsError is raised, and nothing is
        changed, if a key is not a variable of the graph or a number not finite.

        Nothing else is raised. Where a step fails, the mapper goes back to before the cycle and takes it
        again with the loop left alone, or without detections, or not at all. The notice says which, and
        `recovery.failures` counts. If `strict`, it goes back, and what was raised is raised again.
        """
        factors = tuple(factors)
        self.recovery.before(
            self, self.front_end.gate, outside=self.loop.solver.got(self.smoother.next_cycle)
        )
        cycle, unused = self._admit(odometry, detections, factors), self._unused
        if unused is not None:
            cycle = replace(cycle, odometry=unused.followed_by(cycle.odometry))
        again = partial(self._process, cycle, factors)
        try:
            result = again()
        except Exception as error:  # a vehicle drives on, whatever has failed
            if strict:
                self.recovery.take_back(self, self.front_end.gate)
                raise
            return cycle.counted(self._without(cycle, factors, error))
        self.recovery.called(again)
        self._unused = None
        return cycle.counted(result)

    def _process(
        self, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor], *, careful: bool = False
    ) -> CycleResult:
        """Take the steps of the paper; a `careful` cycle leaves the loop as it is for some metres."""
        watch = Stopwatch()
        self.smoother.add_factors(factors)
        if factors:
            self.loop.record.give_up("the batch of the lap does not know the user's factors")
        if careful:
            self.loop.pause()
            self.new_road = None
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        self._predict(reading)
        watch.lap("predict")
        self._classify(reading)  # detections that no curve explains may expand one
        watch.lap("classify")
        grown = self._expand()
        watch.lap("expand")
        self._update(grown)
        watch.lap("update")
        learned = self.loop.inflate_priors(reading)
        closes = self.loop.close()
        watch.lap("close")
        if closes:
            simplify(self.smoother)
        watch.lap("simplify")
        jump, notice = self.loop.go_on(closes, watch.spent)
        if jump is not None:
            self._place_orange()
        watch.lap("swap")
        if self.loop.is_searching:
            jump, notice = self._find(reading)
        watch.lap("find")
        if self.closed:
            self.growth.clear()
        self.smoother.marginalize(self.loop.solver.first_kept)
        watch.lap("marginalize")
        notice = joined([notice, self.growth.notice, reading.notice, learned])
        return self._result(cycle.detections.t, watch.laps, jump, notice)

    def _without(
        self, cycle: Admitted, factors: Sequence[gtsam.NonlinearFactor], error: Exception
    ) -> CycleResult:
        """Go on where a cycle has failed: without the loop, or without detections, or without the cycle.

        The mapper is as it was before the cycle each time. The notice says what has failed.
        """
        self.recovery.failures += 1
        number, seen = self.recovery.failures, cycle.detections
        why = f": {type(error).__name__}: {error}" if number == 1 else f" (failure {number})"
        failed = " ".join(f"an update failed{why}".split())
        blind = replace(cycle, detections=seen.where(np.zeros(len(seen.labels), bool)))
        attempts = {"the loop is left as it is": cycle, "its detections are not used": blind}
        for consequence, attempt in attempts.items():
            self.recovery.take_back(self, self.front_end.gate)
            again = partial(self._process, attempt, factors, careful=True)
            try:
                result = again()
            except Exception:  # the next attempt does less
                continue
            self.recovery.called(again)
            self._unused = None
            return replace(result, notice=joined([failed, consequence, result.notice]))
        self.recovery.take_back(self, self.front_end.gate)
        self._unused = cycle.odometry
        return self._result(cycle.detections.t, {}, None, f"{failed}; the cycle is not used")

    def _admit(
        self, odometry: Odometry, detections: Detections, factors: Sequence[gtsam.NonlinearFactor]
    ) -> Admitted:
        try:
            self.smoother.check_factors(factors)
        except SettingsError:
            self.front_end.gate.refuse()
            raise
        return self.front_end.admit(odometry, detections)

    def finish(self) -> None:
        """Take the result of a batch that is under way, where the drive is over and no cycle follows.

        A lap that was recognized in the last metres of a drive closes only then.
        """
        if self.loop.finish() is not None:
            self._place_orange()

    def _place_orange(self) -> None:
        window = self.smoother.first_cycle, self.poses
        self.orange.place_again(self.smoother.variables.sensor, (0, self.corrected_poses), window)

    # --- the steps of the paper --------------------------------------------------------------------------

    def _predict(self, reading: Reading) -> None:
        """Add the pose of the cycle by the calibrated odometry, and extend the driven path."""
        motion, t = reading.motion, reading.detections.t
        predict(self.smoother, self.path, motion, t)
        cycle, twist = self.smoother.next_cycle - 1, motion.odometry.twist
        orange = Sighting(cycle, self.poses[-1].copy(), twist, reading.orange)
        self.orange.add(orange, self.smoother.variables.sensor)
        self.loop.record.measured(reading)

    def _classify(self, reading: Reading) -> None:
        detections, motion, cycle = reading.detections, reading.motion, self.smoother.next_cycle - 1
        new = self.smoother.map.detections.append(detections, cycle, motion.odometry.twist)
        tested = None
        if self.boundaries:
            tested = self.smoother.associate(self._grown, use=not self.loop.is_searching)
        self.loop.judge(tested, new, reading)
        if not self.closed:
            self.growth.observe(new, detections.t)

    def _expand(self) -> frozenset[int]:
        """Let open curves grow, and return the labels of those that did; their detections are tested next."""
        self._grown = frozenset()
        if not self.closed:
            path_ahead = self.path.ahead(self.poses[-1], self.settings.growth.reach)
            self._grown = self.growth.expand(path_ahead)
        self.smoother.deactivate_distant()
        return self._grown

    def _update(self, grown: frozenset[int]) -> None:
        """Take the Gauss-Newton steps of a cycle, each relinearized at the current estimate."""
        for _ in range(self.settings.steps_grown if grown else self.settings.steps):
            self.smoother.step(self.settings.sigma_step)

    # --- off the closed map ------------------------------------------------------------------------------

    def _find(self, reading: Reading) -> tuple[Array | None, str]:
        """Map the road beside a lost vehicle anew, until its place on the closed map is found."""
        if self.new_road is None:
            open_lap = replace(self.settings.open_lap, prior="window")
            odometry, sensor = self.smoother.variables.calibration, self.smoother.variables.sensor
            settings = replace(
                self.settings,
                scale=1.0,
                open_lap=open_lap,
                odometry=self.loop.priors.odometry.about(odometry.tolist()),
                calibration=self.loop.priors.calibration.about(sensor.tolist()),
            )
            self.new_road = FixedLagMapper(settings, self.odometry_sigma)
        road = self.new_road
        road._predict(reading)
        road._classify(reading)
        road._update(road._expand())
        road.smoother.marginalize()
        ends = [boundary.confirmed_end for boundary in road.boundaries.values()]
        sees_road = len(ends) == len(BOUNDARIES) and min(ends) > ROAD and road.loop.health.condition == GOOD
        jump, notice = self.loop.relocalize(sees_road=sees_road)
        if jump is not None:
            self.new_road = None
        return jump, notice

    def _result(self, t: float, stages: dict[str, float], jump: Array | None, notice: str) -> CycleResult:
        detections = self.smoother.map.detections
        used = int(detections.used[detections.cycle.searchsorted(self.smoother.next_cycle - 1) :].sum())
        left, right = (self.boundaries[b].size if b in self.boundaries else 0 for b in (LEFT, RIGHT))
        pose, sizes = (self.poses[-1].copy() if len(self.poses) else np.zeros(3)), (left, right)
        return CycleResult(t, pose, sizes, used, self.closed, stages, jump, notice, self.loop.health)

    # --- the snapshot ------------------------------------------------------------------------------------

    def noise_used(self) -> RunNoise:
        """Return the noise that is used now, and what was measured so far."""
        return scaled(self.front_end.noise_used, self.scale)

    def save(self, path: Path | str) -> None:
        """Write the whole mapper to one file, from which `restore` makes one that goes on to the same map.

        Nothing of the mapper changes. An earlier file is kept as a numbered backup, and at each moment the
        old or the new file is there. SettingsError is raised while a factor of your own is in the window.
        """
        count = self.smoother.user_factors.count
        if count:
            raise SettingsError(f"save: expected no factors of your own in the window, found {count}")
        save(self, path)

    @classmethod
    def restore(cls, path: Path | str) -> Self:
        """Return the mapper that `save` has written, with its settings; an InputError if the file is not so.

        A lap that was being solved when it was saved is solved again.
        """
        mapper = restore(path, cls, FixedLagMapper._look)
        mapper.loop.resume()
        return mapper

    def _look(self) -> None:
        self.outline()
        if self.smoother.times:
            self.vehicle_state()
            self.map()
