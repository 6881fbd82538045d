"""Simulated cars on generated tracks: where they are on a known map, and what several drives are worth."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.batch.joint import join
from pathspace_graph.batch.known_map import map_of_cones
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.estimators import DEFAULT_BATCH, DEFAULT_ONLINE, make_batch, make_online, settings_of
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from .experiment.statistics import estimate
from .experiment.tables import Table
from .metrics.accuracy import lap_metrics, root_mean_square
from .metrics.alignment import motion_onto, shape_rmse
from .metrics.consistency import consistency_at_cones, map_nees
from .metrics.reference import truth_of
from .metrics.trajectory import interpolate_poses, position_rms, trajectory_errors

Columns = Mapping[str, tuple[str, int, float]]  # of a table, by their key: heading, digits, factor

CARS: Final[Mapping[str, SimulationSettings]] = {
    "plain": SimulationSettings(laps=2),
    "drawn": SimulationSettings(laps=2, draw=True),
}
"""Cars with white noise, and others, each drawn with errors of its own."""


def on_tracks(tracks: Sequence[int], **same: Any) -> list[dict[str, Any]]:
    """Return the arguments of a function of each car on each track, with the same others."""
    return [{"car": car, "track": track, **same} for track in tracks for car in CARS]


def drive(car: str, track: int, seed: int) -> Log:
    """Return a drive of a car on the generated track of a number."""
    return simulate(generate_track(np.random.default_rng(track)), CARS[car], seed)


def over_tracks(title: str, parts: Mapping[str, pd.DataFrame], columns: Columns) -> Table:
    """Return a row for each part, over tracks: the drives of one are no sample."""
    rows = []
    for label, part in parts.items():
        means = part.groupby("track")[[*columns]].mean()
        texts = (estimate(means[key]).text(digits, factor) for key, (_, digits, factor) in columns.items())
        rows.append((label, *texts))
    return Table.of((title, *(heading for heading, _, _ in columns.values())), rows)


# --- known maps --------------------------------------------------------------------------------------------

OWN, SURVEYED, MOVED, OTHER = "another drive's", "surveyed", "surveyed, 7 cones moved", "another track's"
SIGMA_SURVEY: Final = 0.15  # of the cones of a surveyed map (m)
MOVED_CONES, MOVED_BY = 7, 2.5  # number of neighbours on the left that were moved, and how far (m)
SOON: Final = 8.0  # time after which the vehicle should be found (s)
DRIVEN: Final = 40.0  # time that is driven on a known map (s)
WRONG: Final = 2.0  # distance (m) from the true pose at which the place where it was found is a wrong one
KNOWN: Final[Columns] = {
    "found": ("found [%]", 0, 100.0),
    "soon": (f"within {SOON:.0f} s [%]", 0, 100.0),
    "wrong": ("at a wrong place [%]", 0, 100.0),
    "error": ("pose error [m]", 2, 1.0),
    "map": ("rmse of the map [m]", 2, 1.0),
}


def known_of_track(car: str, track: int, begins: Sequence[float]) -> list[dict[str, Any]]:
    """Return the rows of the second drive of a track, on maps of the first one and of another track.

    It begins at some shares of the first lap's time.
    """
    first, second = (drive(car, track, seed) for seed in (0, 1))
    truth, rows = truth_of(first), list[dict[str, Any]]()
    motion = motion_onto(truth_of(second).cones, truth.cones)
    rng = np.random.default_rng(track)
    maps = {
        OWN: mapped(first),
        SURVEYED: surveyed(truth, rng),
        MOVED: surveyed(truth, rng, MOVED_CONES),
        OTHER: mapped(drive(car, track + 1000, 0)),
    }
    for kind, known in maps.items():
        rmse = np.nan if kind == OTHER else lap_metrics(known, truth, 0).rmse
        for share in begins:
            about = {"car": car, "track": track, "kind": kind, "begin": share, "map": rmse}
            rows.append(about | drive_on(known, second, share, motion))
    return rows


def mapped(log: Log) -> Map:
    """Return the online map of a drive."""
    return run_online(log, make_online(DEFAULT_ONLINE, MapperSettings(), log), name=DEFAULT_ONLINE).map


def surveyed(truth: Truth, rng: np.random.Generator, moved: int = 0) -> Map:
    """Return the map of surveyed cones, before `moved` neighbours on the left were put elsewhere."""
    rows = {label: truth.cones[truth.cone_labels == label] for label in (LEFT, RIGHT)}
    cones = {label: row + SIGMA_SURVEY * rng.normal(size=row.shape) for label, row in rows.items()}
    begin = int(rng.integers(len(cones[LEFT])))
    chosen = (begin + np.arange(moved)) % len(cones[LEFT])
    middle = np.array([cones[RIGHT][np.hypot(*(cones[RIGHT] - c).T).argmin()] for c in cones[LEFT][chosen]])
    if moved:
        outwards = cones[LEFT][chosen] - middle
        cones[LEFT][chosen] += MOVED_BY * outwards / np.hypot(*outwards.T)[:, None]
    return map_of_cones(cones[LEFT], cones[RIGHT], True, SIGMA_SURVEY)


def begun_later(log: Log, share: float) -> Log:
    """Return a log from a share of its first half's time on, without truth, which is in another frame."""
    t = log.odometry.t
    begin = float(t[0] + 0.5 * share * (t[-1] - t[0]))
    later = log.odometry.between(begin, float(t[-1]))
    cycles = tuple(cycle for cycle in log.cycles if later.t[0] < cycle.t < begin + DRIVEN)
    return replace(log, odometry=later, cycles=cycles, truth=None)


def drive_on(known: Map, log: Log, share: float, motion: Array) -> dict[str, Any]:
    """Return how a drive goes that begins later on a known map, onto whose frame a motion (3,) leads."""
    truth, later = truth_of(log), begun_later(log, share)
    mapper = FixedLagMapper.on(known, settings_of(MapperSettings(), later), later.noise)
    result = run_online(later, mapper, name=DEFAULT_ONLINE)
    found_at = mapper.placed_at
    if found_at is None:
        return {"found": 0.0, "soon": 0.0, "wrong": 0.0, "error": np.nan}
    true = compose(motion, interpolate_poses(truth.pose_t, truth.poses, result.trajectory_t))
    away = np.hypot(*(result.trajectory - true)[result.trajectory_t >= found_at, :2].T)
    soon, wrong = float(found_at - later.odometry.t[0] <= SOON), float(away[0] > WRONG)
    return {"found": 1.0, "soon": soon, "wrong": wrong, "error": root_mean_square(away)}


def known_table(frame: pd.DataFrame) -> Table:
    """Return a row for each car and kind of map."""
    groups = frame.groupby(["car", "kind"], sort=False)
    parts = {f"{car}, {kind} ({len(part)} drives)": part for (car, kind), part in groups}
    return over_tracks("cars, known map", parts, KNOWN)


# --- several drives as one batch ---------------------------------------------------------------------------

JOINT: Final[Columns] = {
    "shape": ("rmse of the shape [m]", 3, 1.0),
    "ratio": ("by half as many", 2, 1.0),
    "nees": ("NEES", 2, 1.0),
    "inside": ("within 2σ [%]", 1, 100.0),
    "ate": ("trajectory error [m]", 3, 1.0),
}


def joint_of_track(car: str, track: int, drives: int) -> list[dict[str, Any]]:
    """Return a row for each map of 1, 2, 4 and so on drives of a track, each solved alone once."""
    logs = {str(seed): drive(car, track, seed) for seed in range(drives)}
    alone = {name: solve_alone(log) for name, log in logs.items()}
    names, rows, count = [*logs], list[dict[str, Any]](), 1
    while count <= drives:
        for begin in range(0, drives, count):
            group = {name: logs[name] for name in names[begin : begin + count]}
            rows.append({"car": car, "track": track, "drives": count} | metrics_of_group(group, alone))
        count *= 2
    return rows


def solve_alone(log: Log) -> BatchResult:
    """Return the default batch of a log."""
    result = make_batch(DEFAULT_BATCH, MapperSettings(), log).solve(log)
    assert isinstance(result, BatchResult)
    return result


def metrics_of_group(logs: Mapping[str, Log], alone: Mapping[str, BatchResult]) -> dict[str, Any]:
    """Return the metrics of the map of some drives, in the frame of the first, and of their trajectories."""
    first, mapped = next(iter(logs)), {name: alone[name] for name in logs}
    own = mapped
    if len(logs) > 1:
        joint = join(mapped)
        first, mapped = next(iter(joint.drives)), joint.drives
        own = {name: drive.moved(inverse(joint.frames[name])) for name, drive in mapped.items()}
    track, truths = mapped[first].map, {name: truth_of(logs[name]) for name in mapped}
    errors = [trajectory_errors(own[name].trajectory_t, own[name].trajectory, truths[name]) for name in own]
    return {
        "shape": shape_rmse(track, truths[first]),
        "nees": map_nees(track, truths[first]).ratio,
        "inside": consistency_at_cones(track, truths[first])["inside"],
        "ate": float(np.mean([position_rms(one) for one in errors])),
        "mapped": len(own),
    }


def joint_table(frame: pd.DataFrame) -> Table:
    """Return a row for each kind of car and number of drives, with the shape by that of half as many."""
    shape = frame.groupby(["car", "track", "drives"])["shape"].mean()
    parts = {}
    for (car, count), part in frame.groupby(["car", "drives"], sort=False):
        half = [shape.get((car, track, count // 2), np.nan) for track in part["track"]]
        parts[f"{car}, {count} drive{'s' if count > 1 else ''}"] = part.assign(ratio=part["shape"] / half)
    return over_tracks("cars, drives of a track", parts, JOINT)
