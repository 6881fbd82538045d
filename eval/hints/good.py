"""Good logs of all kinds: what is unusual about them is no mistake, and none of them may be accused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.sim.faults import Faults, OdometryFaults, SensorFaults, VehicleFaults
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings
from pathspace_graph.sim.track import Track

Edit = Callable[[Log], Log]
NOISE: Final = 3.0
"""The noisy logs have noise that is larger by this factor."""
STANDING: Final = 10.0
"""A vehicle stands for this time (s) before it drives."""


@dataclass(frozen=True)
class Good:
    """Describes a kind of good log."""

    simulation: SimulationSettings = field(default_factory=SimulationSettings)
    """The drive has these settings, but for its laps."""
    edit: Edit | None = None
    """The log is changed by this afterwards."""
    open_road: bool = False
    """The track is open: its second half is not there."""


def _sensor(**values: float) -> Good:
    return Good(SimulationSettings(sensor=SensorSettings(**values)))  # type: ignore[arg-type]


def _faulty(faults: Faults) -> Good:
    return Good(SimulationSettings(faults=faults))


def _noisy() -> Good:
    sensor, odometry = SensorSettings(), OdometryNoise()
    return Good(
        SimulationSettings(
            sensor=replace(
                sensor,
                range_sigma=NOISE * sensor.range_sigma,
                range_sigma_growth=NOISE * sensor.range_sigma_growth,
                bearing_sigma=NOISE * sensor.bearing_sigma,
            ),
            odometry=OdometryNoise(
                white=(NOISE * odometry.white[0], NOISE * odometry.white[1], NOISE * odometry.white[2]),
                scale=NOISE * odometry.scale,
                gyro_bias=NOISE * odometry.gyro_bias,
            ),
        )
    )


def one_boundary(log: Log) -> Log:
    """Returns the log with the detections of the left boundary only."""
    return _kept(log, lambda cycle: cycle.labels == LEFT)


def few_cones(log: Log) -> Log:
    """Returns the log with the three nearest detections of each cycle."""
    return _kept(log, lambda cycle: np.argsort(np.argsort(np.hypot(*cycle.points_vehicle.T))) < 3)


def _kept(log: Log, chosen: Callable[[Detections], np.ndarray]) -> Log:
    cycles = []
    for cycle in log.cycles:
        keep = chosen(cycle)
        if keep.any():
            cycles.append(
                replace(
                    cycle,
                    points_vehicle=cycle.points_vehicle[keep],
                    covariances=cycle.covariances[keep],
                    labels=cycle.labels[keep],
                )
            )
    return replace(log, cycles=tuple(cycles), truth=None)


def stands_first(log: Log) -> Log:
    """Returns the log of a vehicle that stands for ten seconds first, with fresh noise in each reading."""
    rng, odometry, first = np.random.default_rng(0), log.odometry, log.cycles[0]
    before = np.arange(0.0, STANDING, 0.02)
    twists = rng.normal(0.0, log.odometry_sigma, (len(before), 3))
    roots = np.linalg.cholesky(first.covariances)
    standing = [
        replace(
            first,
            t=t,
            points_vehicle=first.points_vehicle
            + np.einsum("mij,mj->mi", roots, rng.normal(size=first.points_vehicle.shape)),
        )
        for t in np.arange(0.0, STANDING, 0.1).tolist()
    ]
    driving = [replace(cycle, t=cycle.t + STANDING) for cycle in log.cycles]
    whole = Odometry(
        np.append(before, odometry.t - odometry.t[0] + STANDING), np.vstack([twists, odometry.twist])
    )
    return replace(log, odometry=whole, cycles=(*standing, *driving), truth=None)


def backs_up(log: Log) -> Log:
    """Returns the log of a vehicle that goes the same way backward: time runs the other way."""
    end = float(log.odometry.t[-1])
    odometry = Odometry(end - log.odometry.t[::-1], -log.odometry.twist[::-1])
    cycles = [replace(cycle, t=end - cycle.t) for cycle in log.cycles[::-1] if cycle.t <= end]
    return replace(log, odometry=odometry, cycles=tuple(cycles), truth=None)


def slow_odometry(log: Log) -> Log:
    """Returns the log with every fifth twist."""
    return replace(log, odometry=Odometry(log.odometry.t[::5], log.odometry.twist[::5]))


def in_unix_time(log: Log) -> Log:
    """Returns the log with stamps since 1970."""
    cycles = [replace(cycle, t=cycle.t + 1.7e9) for cycle in log.cycles]
    return replace(
        log, odometry=replace(log.odometry, t=log.odometry.t + 1.7e9), cycles=tuple(cycles), truth=None
    )


def half_of(track: Track) -> Track:
    """Returns a track without the second half of its cones, which is open."""
    left, right = track.left[: len(track.left) // 2], track.right[: len(track.right) // 2]
    return replace(track, left=left, right=right, closed=False)


GOOD: Final[dict[str, Good]] = {
    "as simulated": Good(),
    "field of view of 180 degrees": _sensor(fov=np.pi),
    "field of view of 360 degrees": _sensor(fov=2.0 * np.pi),
    "range of 5 m": _sensor(range_max=5.0),
    "range of 8 m": _sensor(range_max=8.0),
    "range of 20 m": _sensor(range_max=20.0),
    "noise times 3": _noisy(),
    "2 cycles per second": _sensor(rate=2.0),
    "5 cycles per second": _sensor(rate=5.0),
    "20 cycles per second": _sensor(rate=20.0),
    "30 % of the cones missed": _sensor(detection_probability=0.7, blind_fraction=0.15),
    "5 false positives in a cycle": _sensor(false_positives=5.0),
    "30 % wrong colours": _sensor(wrong_colour=0.3),
    "without colours": _faulty(Faults(sensor=SensorFaults(colourless=1.0))),
    "yaw-rate bias of 0.02 rad/s": _faulty(Faults(odometry=OdometryFaults(yaw_rate_bias=0.02))),
    "wheel slip of 50 %": _faulty(Faults(odometry=OdometryFaults(slip=0.5))),
    "latency of 100 ms": _faulty(Faults(sensor=SensorFaults(latency=0.1))),
    "sensor turned by 2 degrees": _faulty(Faults(sensor=SensorFaults(yaw=0.0349))),
    "sensor 0.2 m to the left": _faulty(Faults(sensor=SensorFaults(lateral=0.2))),
    "ranges 4 % too long": _faulty(Faults(sensor=SensorFaults(range_scale=0.04))),
    "odometry missing for 2 s": _faulty(Faults(odometry=OdometryFaults(gap=2.0))),
    "no detections for 5 s": _faulty(Faults(sensor=SensorFaults(dropout=5.0))),
    "driven the other way round": _faulty(Faults(vehicle=VehicleFaults(wrong_way=True))),
    "one boundary": Good(edit=one_boundary),
    "three cones in a cycle": Good(edit=few_cones),
    "stands for 10 s first": Good(edit=stands_first),
    "backs up": Good(edit=backs_up),
    "odometry at 10 Hz": Good(edit=slow_odometry),
    "stamps since 1970": Good(edit=in_unix_time),
    "open road": Good(open_road=True),
}
"""These are the kinds of good logs by name."""
