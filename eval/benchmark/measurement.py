"""One run of the mapper, timed beside the landmark graph and GTSAM's ISAM2, and the figures of it.

Both get every cycle right after the mapper. BLAS has one thread. All times but that of the batch are
processor times of the thread, so that other work on the machine hardly changes them. From closing until the
map is replaced by one that was solved as a batch, the cycles come as they do in a car, since another process
solves meanwhile.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.console import progress
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.accuracy import mean_of
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.noise import ray_sigmas
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import ObservedCycle, run_online, split_odometry, timed_update
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

RIVAL: Final = "landmark-fixed-lag"  # estimator that gets the same cycles in turn
WARM_UP: Final = 50  # number of cycles after which the window is full, before which the means do not begin


class ToldLandmarks:
    """GTSAM's ISAM2 over the cycles of a log whose associations are known, as a user would write it.

    A pose for each cycle, a point for each cone, odometry factors between poses, and a bearing-range factor
    for each detection: all GTSAM's own, in C++, with default parameters. `update` and the newest pose are
    timed; building the graph is not.
    """

    def __init__(self, log: Log) -> None:
        """Begin before the first cycle; ValueError where the log has no associations."""
        if log.truth is None or log.truth.associations is None:
            raise ValueError("expected a simulated log, whose associations are known, found one without")
        self.isam = gtsam.ISAM2()
        self._cycles: Iterator[tuple[Odometry, Detections]] = split_odometry(log)
        ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
        self._cones: Iterator[IntArray] = iter(np.split(log.truth.associations, ends[:-1]))
        self._sigma = log.odometry_sigma
        self._pose: Array = np.zeros(3)
        self._count = 0
        self._seen: set[int] = set()

    def advance(self) -> float:
        """Take the next cycle; return the processor time (s) of its update."""
        odometry, detections = next(self._cycles)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        key = gtsam.symbol("x", self._count)
        self._add_pose(graph, odometry, detections.t)
        values.insert(key, gtsam.Pose2(*self._pose))
        self._add_detections(graph, values, detections, next(self._cones))
        begin = time.thread_time()
        self.isam.update(graph, values)
        newest = self.isam.calculateEstimatePose2(key)
        seconds = time.thread_time() - begin
        self._pose = np.array([newest.x(), newest.y(), newest.theta()])
        self._count += 1
        return seconds

    def _add_pose(self, graph: gtsam.NonlinearFactorGraph, odometry: Odometry, t: float) -> None:
        key = gtsam.symbol("x", self._count)
        if self._count == 0:
            known = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-3, 1e-3, 1e-4]))  # the origin of the map
            graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(), known))
            return
        motion = integrate_odometry(odometry, t, self._sigma)
        noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*motion.delta), noise))
        self._pose = compose(self._pose, motion.delta)

    def _add_detections(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, detections: Detections, cones: IntArray
    ) -> None:
        """Add bearing and range of each detection of a cone; false positives are left out."""
        points, key = detections.points_vehicle, gtsam.symbol("x", self._count)
        ranges = np.hypot(*points.T)
        along, across = ray_sigmas(points, detections.covariances).T
        sigmas = np.stack([across / ranges, along], axis=1)
        points_map = to_map(points, self._pose[None])
        for i in np.flatnonzero(cones >= 0).tolist():
            cone = int(cones[i])
            landmark = gtsam.symbol("l", cone)
            if cone not in self._seen:
                self._seen.add(cone)
                values.insert(landmark, points_map[i])
            bearing = gtsam.Rot2.relativeBearing(points[i])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[i])
            graph.add(gtsam.BearingRangeFactor2D(key, landmark, bearing, ranges[i], noise))


@dataclass(frozen=True, eq=False)
class Measurement:
    """Result of one run."""

    cycles: Sequence[CycleRecord]  # cycles, with processor times in place of wall times
    rival: Sequence[float]  # time of each update of the landmark graph (s)
    isam2: Sequence[float]  # time of each update of ISAM2 (s)
    solve: float = math.nan  # time of the batch of the open lap in its own process (s)

    @property
    def closing(self) -> int | None:
        """Cycle that closed the loop; None where the loop stayed open."""
        return next((k for k, record in enumerate(self.cycles) if record.closed), None)

    @property
    def swap(self) -> int | None:
        """Last cycle that replaced the map by one that was solved as a batch; None where none did."""
        return max((k for k, record in enumerate(self.cycles) if record.jump is not None), default=None)


def measure_drive(seed: int, laps: int) -> Measurement:
    """Map a simulated drive on a generated track; the seed is that of the track, the drive and its noise."""
    track = generate_track(np.random.default_rng(seed))
    return measure(simulate(track, SimulationSettings(laps=laps), seed), MapperSettings())


def measure(log: Log, settings: MapperSettings) -> Measurement:
    """Map a log online, and give each cycle to the rivals right afterwards."""
    mapper, told = FixedLagMapper(settings, log.noise), ToldLandmarks(log)
    rival, cycles = make_online(RIVAL, settings, log), split_odometry(log)
    records, rivals, isam2 = list[CycleRecord](), list[float](), list[float]()
    interval = log.cycles[-1].t / len(log.cycles)

    def observe(cycle: ObservedCycle) -> None:
        records.append(replace(cycle.record, seconds=cycle.processor))
        so_far = Measurement(records, rivals, isam2)
        # a batch of the lap, which is always shorter than the lag, may be under way in its own process
        if so_far.closing is not None and so_far.swap is None:
            time.sleep(interval if cycle.result.t - records[so_far.closing].t < settings.lag else 0.0)
        *_, seconds = timed_update(rival, *next(cycles))
        rivals.append(seconds)
        isam2.append(told.advance())
        advance()

    with progress("benchmark", len(log.cycles)) as advance:
        run_online(log, mapper, observers=[observe])
    return Measurement(records, rivals, isam2, mapper.lap_seconds)


def figures(run: Measurement) -> dict[str, float]:
    """Return times of updates (ms), of the batch of the lap (s), and ratios to the rivals, by name.

    What the run was too short for is absent.
    """
    times = 1e3 * np.array([record.seconds for record in run.cycles])
    rival, isam2 = (1e3 * np.asarray(of, float) for of in (run.rival, run.isam2))
    mean, p99 = mean_of(times[WARM_UP:]), float(np.quantile(times, 0.99))
    single = {"closing": run.closing, "swap": run.swap}
    cycles = {name: cycle for name, cycle in single.items() if cycle is not None}
    found = {
        "mean_by_landmark": mean / mean_of(rival[WARM_UP:]),
        "mean_by_isam2": mean / mean_of(isam2[WARM_UP:]),
        "p99_by_isam2": p99 / float(np.quantile(isam2, 0.99)),
        "mean": mean_of(times),
        "p99": p99,
        "slowest_other": float(np.delete(times, [*cycles.values()]).max()),
    }
    found |= {name: float(times[cycle]) for name, cycle in cycles.items()}
    return found | ({"solve": run.solve} if "swap" in cycles else {})
