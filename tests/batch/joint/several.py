"""Several drives of one short track: begun anywhere, the other way round, and on another track."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.joint import Driven, JointResult, driven, join
from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.factors.se2 import compose, inverse, to_vehicle
from pathspace_graph.io.log import Log
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_generator import generate_track

from ...scenes.drives import SHORT

Array = NDArray[np.float64]


def track(number: int) -> Track:
    return generate_track(np.random.default_rng(number), SHORT)


@cache
def lap(seed: int, begin: float = 0.0, number: int = 4, end: float = np.inf) -> Log:
    """A drive of a lap from `begin` (s) on, in the frame of the vehicle then."""
    return cut(simulate(track(number), SimulationSettings(laps=2), seed), begin, end)


@cache
def backwards() -> Log:
    """A drive of the same track the other way round."""
    one = track(4)
    start = np.append(one.start[:2], one.start[2] + np.pi)
    turned = replace(one, left=one.right[::-1], right=one.left[::-1], start=start)
    return simulate(turned, SimulationSettings(laps=1), 1)


def cut(log: Log, begin: float, end: float = np.inf) -> Log:
    """A log from one time to another (s), whose frame is that of the vehicle at its first twist."""
    kept = (log.odometry.t >= begin) & (log.odometry.t <= end)
    odometry = replace(log.odometry, t=log.odometry.t[kept], twist=log.odometry.twist[kept])
    cycles = tuple(one for one in log.cycles if odometry.t[0] <= one.t <= odometry.t[-1])
    truth = log.truth
    assert truth is not None
    start, later = true_start(log, begin), truth.pose_t >= odometry.t[0]
    poses, cones = compose(inverse(start), truth.poses[later]), to_vehicle(truth.cones, start[None])
    truth = replace(truth, pose_t=truth.pose_t[later], poses=poses, cones=cones, associations=None)
    return replace(log, odometry=odometry, cycles=cycles, truth=truth)


def true_start(log: Log, begin: float) -> Array:
    """The true pose (3,) at the first twist from a time (s) on."""
    truth = log.truth
    assert truth is not None
    t = log.odometry.t[log.odometry.t >= begin][0]
    x, y, theta = truth.poses.T
    return np.array([np.interp(t, truth.pose_t, column) for column in (x, y, np.unwrap(theta))])


def make(settings: MapperSettings, log: Log) -> BatchMapper:
    return BatchMapper(settings, log.noise, FixedLagMapper)


@cache
def alone(log: Log) -> BatchResult:
    """The batch of a drive alone."""
    return make(MapperSettings(), log).solve(log)


def driven_alone(log: Log) -> Driven:
    return driven(alone(log))


@cache
def together() -> JointResult:
    """Two drives of a track, begun in two places, and one of another track, as one batch."""
    logs = {"first": lap(0), "elsewhere": lap(1, 9.0), "other": lap(0, 0.0, 5)}
    return join({name: alone(log) for name, log in logs.items()})
