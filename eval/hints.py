"""The study of hints: of how many spoiled logs is the cause named, and which good logs are accused?

Good logs of all kinds are judged: what is unusual about them is no mistake.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.io.overrides import Overrides, override
from pathspace_graph.labels import LEFT
from pathspace_graph.plausibility.judge import hints
from pathspace_graph.sim.mistakes import MISTAKES
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track

from .cars import generated
from .experiment.tables import Quantity, Table

Row = dict[str, Any]

AS_SIMULATED: Final = "as simulated"  # kind of good logs with nothing unusual
_SELF_NAMED: Final = (
    "positions",
    "speeds",
    "yaw rate",
    "y to the right",
    "stamps",
    "odometry",
    "covariances",
)
CAUSES: Final[dict[str, tuple[str, ...]]] = {  # that tell a mistake, by the longest beginning of its name
    **{name: (name,) for name in _SELF_NAMED},
    "all lengths": ("positions", "speeds"),
    "bearings": ("unexplained",),
    "sensor frame": ("sensor frame", "mounting"),
    "speeds in the map frame": ("odometry",),
    "detections in the map frame": ("map frame",),
    "detections 1 s late": ("clocks",),
    "all labels": ("labels",),
}


# --- good logs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Good:
    """A kind of good log: overrides of its simulation, a change of its track, and one of the log."""

    overrides: Overrides = field(default_factory=dict)
    road: Callable[[Track], Track] = lambda track: track
    edit: Callable[[Log], Log] = lambda log: log

    def log(self, track: Track, seed: int, laps: int) -> Log:
        settings = override(SimulationSettings(laps=laps), self.overrides, "")
        return self.edit(simulate(self.road(track), settings, seed))


def open_road(track: Track) -> Track:
    """Return the first half of a track."""
    left, right = track.left[: len(track.left) // 2], track.right[: len(track.right) // 2]
    return replace(track, left=left, right=right, closed=False)


def one_boundary(log: Log) -> Log:
    """Return the log with the detections of the left boundary only."""
    return _kept(log, lambda cycle: cycle.labels == LEFT)


def few_cones(log: Log) -> Log:
    """Return the log with the three nearest detections of each cycle."""
    return _kept(log, lambda cycle: np.argsort(np.argsort(np.hypot(*cycle.points_vehicle.T))) < 3)


def _kept(log: Log, chosen: Callable[[Detections], np.ndarray]) -> Log:
    kept = (cycle.where(chosen(cycle)) for cycle in log.cycles)
    return replace(log, cycles=tuple(cycle for cycle in kept if len(cycle.labels)), truth=None)


def stands_first(log: Log) -> Log:
    """Return the log of a vehicle that stands for ten seconds first, with fresh noise in each detection."""
    rng, odometry, first = np.random.default_rng(0), log.odometry, log.cycles[0]
    before = np.arange(0.0, 10.0, 0.02)
    twists = rng.normal(0.0, log.odometry_sigma, (len(before), 3))
    roots, points, standing = np.linalg.cholesky(first.covariances), first.points_vehicle, []
    for t in np.arange(0.0, 10.0, 0.1).tolist():
        noise = np.einsum("mij,mj->mi", roots, rng.normal(size=points.shape))
        standing.append(replace(first, t=t, points_vehicle=points + noise))
    driving = [replace(cycle, t=cycle.t + 10.0) for cycle in log.cycles]
    stamps = np.append(before, odometry.t - odometry.t[0] + 10.0)
    whole = Odometry(stamps, np.vstack([twists, odometry.twist]))
    return replace(log, odometry=whole, cycles=(*standing, *driving), truth=None)


def backs_up(log: Log) -> Log:
    """Return the log of a vehicle that goes the same way backward: time runs the other way."""
    end = float(log.odometry.t[-1])
    odometry = Odometry(end - log.odometry.t[::-1], -log.odometry.twist[::-1])
    cycles = [replace(cycle, t=end - cycle.t) for cycle in log.cycles[::-1] if cycle.t <= end]
    return replace(log, odometry=odometry, cycles=tuple(cycles), truth=None)


def in_unix_time(log: Log) -> Log:
    odometry = replace(log.odometry, t=log.odometry.t + 1.7e9)
    cycles = tuple(replace(cycle, t=cycle.t + 1.7e9) for cycle in log.cycles)
    return replace(log, odometry=odometry, cycles=cycles, truth=None)


_SENSOR, _ODOMETRY = SensorSettings(), OdometryNoise()
GOOD: Final = {
    AS_SIMULATED: Good(),
    "field of view of 180 degrees": Good({"sensor.fov": np.pi}),
    "field of view of 360 degrees": Good({"sensor.fov": 2.0 * np.pi}),
    **{f"range of {metres:g} m": Good({"sensor.range_max": metres}) for metres in (5.0, 8.0, 20.0)},
    "noise times 3": Good(
        {
            "sensor.range_sigma": 3.0 * _SENSOR.range_sigma,
            "sensor.range_sigma_growth": 3.0 * _SENSOR.range_sigma_growth,
            "sensor.bearing_sigma": 3.0 * _SENSOR.bearing_sigma,
            "odometry.white": tuple(3.0 * sigma for sigma in _ODOMETRY.white),
            "odometry.scale": 3.0 * _ODOMETRY.scale,
            "odometry.gyro_bias": 3.0 * _ODOMETRY.gyro_bias,
        }
    ),
    **{f"{rate:g} cycles per second": Good({"sensor.rate": rate}) for rate in (2.0, 5.0, 20.0)},
    "30 % of the cones missed": Good({"sensor.detection_probability": 0.7, "sensor.blind_fraction": 0.15}),
    "5 false positives in a cycle": Good({"sensor.false_positives": 5.0}),
    "30 % wrong colours": Good({"sensor.wrong_colour": 0.3}),
    "without colours": Good({"faults.sensor.colourless": 1.0}),
    "yaw-rate bias of 0.02 rad/s": Good({"faults.odometry.yaw_rate_bias": 0.02}),
    "wheel slip of 50 %": Good({"faults.odometry.slip": 0.5}),
    "latency of 100 ms": Good({"faults.sensor.latency": 0.1}),
    "sensor turned by 2 degrees": Good({"faults.sensor.yaw": 0.0349}),
    "sensor 0.2 m to the left": Good({"faults.sensor.lateral": 0.2}),
    "ranges 4 % too long": Good({"faults.sensor.range_scale": 0.04}),
    "odometry missing for 2 s": Good({"faults.odometry.gap": 2.0}),
    "no detections for 5 s": Good({"faults.sensor.dropout": 5.0}),
    "driven the other way round": Good({"faults.vehicle.wrong_way": True}),
    "one boundary": Good(edit=one_boundary),
    "three cones in a cycle": Good(edit=few_cones),
    "stands for 10 s first": Good(edit=stands_first),
    "backs up": Good(edit=backs_up),
    "odometry at 10 Hz": Good(
        edit=lambda log: replace(log, odometry=Odometry(log.odometry.t[::5], log.odometry.twist[::5]))
    ),
    "stamps since 1970": Good(edit=in_unix_time),
    "open road": Good(road=open_road),
}


# --- the measurement -------------------------------------------------------------------------------------


def parts_of(tracks: Sequence[int], mistakes: Sequence[str]) -> list[dict[str, Any]]:
    """Return the arguments of `judge`: good logs of all kinds, of which the plain ones are spoiled too."""
    return [
        {"track": track, "kind": kind, "mistakes": mistakes if kind == AS_SIMULATED else ()}
        for track, kind in product(tracks, GOOD)
    ]


def judge(track: int, kind: str, mistakes: Sequence[str]) -> list[Row]:
    """Return a row for the good log of a kind, and for each of those that are spoiled by mistakes."""
    log = GOOD[kind].log(generated(track), seed=0, laps=1)
    spoiled = [{"name": name, **judged(MISTAKES[name](log), causes_of(name))} for name in mistakes]
    rows = [{"kind": "good", "name": kind, **judged(log)}, *({"kind": "spoiled", **row} for row in spoiled)]
    return [{"track": track, **row} for row in rows]


def causes_of(mistake: str) -> tuple[str, ...]:
    """Return the causes of which one must be named."""
    return CAUSES[max((begin for begin in CAUSES if mistake.startswith(begin)), key=len)]


def judged(log: Log, causes: Sequence[str] = ()) -> Row:
    """Return what is said of a log, and whether one of the causes is named."""
    found = [hint.cause for hint in hints(log)]
    is_named = any(cause in found for cause in causes)
    return {"accused": bool(found), "named": is_named, "causes": "; ".join(found)}


def hints_table(rows: pd.DataFrame) -> Table:
    """Return the number of logs whose cause is named, for each mistake, or that are accused."""
    spoiled, good = rows[rows["kind"] == "spoiled"], rows[rows["kind"] == "good"]
    groups = {str(name): of["named"] for name, of in spoiled.groupby("name", sort=False)}
    groups |= {"all mistakes": spoiled["named"], "good logs, accused of any": good["accused"]}
    figures = tuple((name, *Quantity.row((hits.sum(), len(hits)), 0)) for name, hits in groups.items())
    return Table(("mistake", "named", "logs"), figures)
