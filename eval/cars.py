"""Experiments of whole cars: on a known map, several drives of one track, and recordings of a real car.

A real car has no truth. Its logs are mapped in three ways and compared with each other (docs/real.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from math import inf
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from scipy.special import expit

from pathspace_graph.batch import joint as several
from pathspace_graph.batch import known_map, simplification, start
from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.estimators import DEFAULT_BATCH, DEFAULT_ONLINE, make_batch, make_online, settings_of
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.front_end.front_end import judge_log, seen_cycles
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import Map, read_map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.places.find import STRETCH, SURE_ODDS, KnownRoad, place_on, seen_in
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from .experiment.run import CELLS, run_study
from .experiment.study import Study
from .experiment.tables import TextTable, by_name, estimate, last_laps
from .metrics.accuracy import consistency_at_cones, lap_metrics, map_nees, root_mean_square
from .metrics.alignment import aligned_distance, end_by_registration, maps_apart, motion_onto, shape_rmse
from .metrics.measures import METRICS, UNKNOWN, Metric, figure, figures
from .metrics.reference import truth_of
from .metrics.trajectory import interpolate_poses, position_rms, trajectory_errors

CARS: Final[Mapping[str, SimulationSettings]] = {
    "plain": SimulationSettings(laps=2),
    "drawn": SimulationSettings(laps=2, draw=True),
    "lines": replace(preset({"sensor": "line"}), laps=2),
}
"""Cars with white noise, others, each drawn with errors of its own, and cars that see points of lines."""


def on_tracks(
    tracks: Sequence[int], cars: Sequence[str] = ("plain", "drawn"), **same: Any
) -> list[dict[str, Any]]:
    """Return the arguments of a function of each car on each track, with the same others."""
    return [{"car": car, "track": track, **same} for track in tracks for car in cars]


def simulated(car: str, track: int, seed: int) -> Log:
    """Return a drive of a car on the generated track of a number."""
    return simulate(generate_track(np.random.default_rng(track)), CARS[car], seed)


# --- known maps --------------------------------------------------------------------------------------------

OWN, OTHER = "another drive's", "another track's"
SIGMA_SURVEY: Final = 0.15  # of the cones of a surveyed map (m)
SOON: Final = 8.0  # time after which the vehicle should be found (s)
WRONG: Final = 2.0  # distance (m) from the true pose at which the place where it was found is a wrong one


def known_of_track(car: str, track: int, begins: Sequence[float]) -> list[dict[str, Any]]:
    """Return the rows of the second drive of a track, on maps of the first one and of another track.

    It begins at some shares of the first lap's time.
    """
    first, second = (simulated(car, track, seed) for seed in (0, 1))
    truth, rows = truth_of(first), list[dict[str, Any]]()
    motion = motion_onto(truth_of(second).cones, truth.cones)
    rng = np.random.default_rng(track)
    maps = {
        OWN: mapped(first),
        "surveyed": surveyed(truth, rng),
        "surveyed, 7 cones moved": surveyed(truth, rng, 7),
        OTHER: mapped(simulated(car, track + 1000, 0)),
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
    """Return the map of surveyed cones, before `moved` neighbours on the left were put 2.5 m outwards."""
    rows = {label: truth.cones[truth.cone_labels == label] for label in (LEFT, RIGHT)}
    cones = {label: row + SIGMA_SURVEY * rng.normal(size=row.shape) for label, row in rows.items()}
    begin = int(rng.integers(len(cones[LEFT])))
    chosen = (begin + np.arange(moved)) % len(cones[LEFT])
    middle = np.array([cones[RIGHT][np.hypot(*(cones[RIGHT] - c).T).argmin()] for c in cones[LEFT][chosen]])
    if moved:
        outwards = cones[LEFT][chosen] - middle
        cones[LEFT][chosen] += 2.5 * outwards / np.hypot(*outwards.T)[:, None]
    return known_map.map_of_cones(cones[LEFT], cones[RIGHT], True, SIGMA_SURVEY)


def begun_later(log: Log, share: float) -> Log:
    """Return 40 s of a log from a share of its first half's time on, without truth: its frame is another."""
    t = log.odometry.t
    begin = float(t[0] + 0.5 * share * (t[-1] - t[0]))
    later = log.odometry.between(begin, float(t[-1]))
    cycles = tuple(cycle for cycle in log.cycles if later.t[0] < cycle.t < begin + 40.0)
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


def known_table(frame: pd.DataFrame) -> TextTable:
    """Return a row for each car and kind of map."""
    count = frame.groupby(["car", "kind"])["track"].transform("size").astype(str)
    named = {"cars": frame["car"], "known map": frame["kind"] + " (" + count + " drives)"}
    metrics = (
        Metric("found", "found", "%", 0),
        Metric("soon", f"within {SOON:.0f} s", "%", 0),
        Metric("wrong", "at a wrong place", "%", 0),
        Metric("error", "pose error", "m", 2),
        Metric("map", "rmse of the map", "m", 2),
    )
    return by_name(frame.assign(**named), [*named], metrics)


def odds_of_track(car: str, track: int) -> list[dict[str, Any]]:
    """Return a row for each search of the second drive of a track, on its own map and on another track's.

    There is one every 10 m from 20 m on. Each knows only the path and the detections of the last metres.
    """
    first, log = (simulated(car, track, seed) for seed in (0, 1))
    settings = settings_of(MapperSettings(), log)
    judged = judge_log(log, known_noise(log.noise), simplification.own_settings(settings))
    poses, truth = judged.chain.dead_reckoned(judged.chain.calibration_mean), truth_of(log)
    motion = motion_onto(truth.cones, truth_of(first).cones)
    true = compose(motion, interpolate_poses(truth.pose_t, truth.poses, judged.chain.stamps))
    table, driven, rows = start.all_detections(judged), path_lengths(poses), list[dict[str, Any]]()
    due = np.arange(20.0, driven[-1], 10.0)
    for kind, other in ((OWN, first), (OTHER, simulated(car, track + 1000, 0))):
        known = known_map.KnownMap.of(mapped(other), False, settings.of_lines)
        road = KnownRoad.of(known.splines, known.cones)
        for newest in np.unique(driven.searchsorted(due)).tolist():
            lately = np.flatnonzero(driven[: newest + 1] > driven[newest] - STRETCH)
            recent = seen_in(replace(table, cycle=table.cycle - lately[0]))
            place = place_on(road, recent, poses[lately], settings)
            odds = np.nan if place is None or place.odds == -inf else place.odds  # JSON has no infinity
            right = place is not None and np.hypot(*(place.pose - true[newest])[:2]) < WRONG
            rows.append(
                {"car": car, "track": track, "kind": kind, "odds": odds, "wrong": not right or kind == OTHER}
            )
    return rows


def odds_table(frame: pd.DataFrame) -> TextTable:
    """Return how many places are wrong, and how many their odds expect, by the log odds that they claim."""
    edges = (-100.0, 0.0, 2.0, 4.0, SURE_ODDS, 10.0, 15.0, 100.0)
    rows, expected = list[Sequence[str]](), expit(-frame["odds"])
    for name, chosen in {
        "no place": frame["odds"].isna(),
        **{f"{low:g} to {high:g}": frame["odds"].between(low, high) for low, high in pairwise(edges)},
    }.items():
        counts = frame["kind"][chosen].value_counts().reindex([OWN, OTHER], fill_value=0)
        wrong = figures([frame["wrong"][chosen].sum(), expected[chosen].sum()], 0, 1)
        rows.append((name, *map(str, counts), *(wrong if rows else [UNKNOWN, UNKNOWN])))
    return TextTable.of(("log odds", f"on {OWN}", f"on {OTHER}", "wrong", "wrong by the odds"), rows)


# --- several drives as one batch ---------------------------------------------------------------------------


def joint_of_track(car: str, track: int, drives: int) -> list[dict[str, Any]]:
    """Return a row for each map of 1, 2, 4 and so on drives of a track, each solved alone once."""
    logs = {str(seed): simulated(car, track, seed) for seed in range(drives)}
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
        joint = several.join(mapped)
        first, mapped = next(iter(joint.drives)), joint.drives
        own = {name: drive.moved(inverse(joint.frames[name])) for name, drive in mapped.items()}
    track, truths = mapped[first].map, {name: truth_of(logs[name]) for name in mapped}
    errors = [trajectory_errors(own[name].trajectory_t, own[name].trajectory, truths[name]) for name in own]
    return {
        "shape": shape_rmse(track, truths[first]),
        "nees": map_nees(track, truths[first]),
        "inside": consistency_at_cones(track, truths[first])["inside"],
        "ate": float(np.mean([position_rms(one) for one in errors])),
        "mapped": len(own),
    }


def joint_table(frame: pd.DataFrame) -> TextTable:
    """Return a row for each kind of car and number of drives, with the shape by that of half as many."""
    shape = frame.groupby(["car", "track", "drives"])["shape"].mean()
    half = shape.reindex(pd.MultiIndex.from_arrays([frame["car"], frame["track"], frame["drives"] // 2]))
    count = frame["drives"].astype(str) + np.where(frame["drives"] > 1, " drives", " drive")
    named = {"cars": frame["car"], "drives of a track": count}
    metrics = (
        Metric("shape", "rmse of the shape", "m"),
        Metric("ratio", "by half as many", digits=2),
        Metric("nees", "NEES", digits=2),
        Metric("inside", "within 2σ", "%", 1),
        Metric("ate", "trajectory error", "m"),
    )
    return by_name(frame.assign(ratio=frame["shape"] / half.to_numpy(), **named), [*named], metrics)


# --- logs of a real car ----------------------------------------------------------------------------------

RUNS: Final = (DEFAULT_ONLINE, DEFAULT_BATCH, "landmark-fixed-lag")


def real_tables(folders: Sequence[Path], out: Path, **how: Any) -> dict[str, TextTable]:
    """Map logs that `convert` has written by all estimators of `RUNS`; `how` is that of `run_records`."""
    logs = {folder.name: read_log(folder) for folder in folders}
    study = Study(name="real", logs={folder.name: (folder,) for folder in folders}, estimators=RUNS)
    runs = last_laps(run_study(study, out, keep=True, **how))
    shown = {  # metrics of each run, with short titles
        "closed_at_end": "closed",
        "end_off": "end off by",
        "end_turn": "turned by",
        "reckoned_off": "dead reckoning off by",
        "reckoned_turn": "dead reckoning turned by",
        "crossings": "crossings",
        "crossings_own": "own crossings",
        "reported_degraded": "degraded",
        "reported_lost": "lost",
        "ms_processor": "update",
    }
    metrics = [replace(METRICS[key], title=title) for key, title in shown.items()]
    return {
        "runs": by_name(runs, ("track", "estimator"), metrics),
        "maps": maps_table(runs, out / CELLS),
        "joint": real_joint_table(logs),
        "measured": measured_table(logs),
    }


def maps_table(runs: pd.DataFrame, cells: Path) -> TextTable:
    """Return the distance between the maps of each two drives around the same cones: under a metre."""
    maps = {(run.track, run.estimator): read_map(cells / run.cell) for run in runs.itertuples()}
    rows = []
    for pair in combinations(runs["track"].unique(), 2):
        apart = [aligned_distance(*(maps[track, name] for track in pair)) for name in RUNS]
        if min(apart) < 1.0:
            rows.append((", ".join(pair), *figures(apart, 2)))
    return TextTable.of(("maps", *(f"{name} [m]" for name in RUNS)), rows)


def real_joint_table(logs: Mapping[str, Log]) -> TextTable:
    """Return how far each drive's own batch is from that of all drives, and both from the last pose."""
    alone = {name: solve_alone(log) for name, log in logs.items()}
    joint, rows = several.join(alone), []
    for name, together in joint.drives.items():
        apart = maps_apart(alone[name].map, together.map).statistics()["both"]
        pose = compose(inverse(joint.frames[name]), together.trajectory[-1])
        end = end_by_registration(seen_cycles(logs[name]), logs[name].measured)
        ends = [
            np.nan if end is None else np.hypot(*(of - end)[:2]) for of in (alone[name].trajectory[-1], pose)
        ]
        rows.append((name, *figures([*apart.values(), *ends], 2)))
    apart_by = ("map apart, mean [m]", "rms [m]", "p95 [m]", "largest [m]")
    return TextTable.of(("drive", *apart_by, "end off by, alone [m]", "together [m]"), rows)


def measured_table(logs: Mapping[str, Log]) -> TextTable:
    """Return what was measured on each drive, and over all of them the mean with its interval."""
    errors_of = {  # errors of the sensor, with titles and units
        "latency": ("latency [ms]", 1e3),
        "yaw": ("yaw [°]", 180.0 / np.pi),
        "range_scale": ("scale [%]", 100.0),
    }
    header = (
        *("log", "vx [m/s]", "vy [m/s]", "wz [rad/s]", "along at 10 m [m]", "across at 10 m [m]"),
        *("stays along [%]", "stays across [%]", *(title for title, _ in errors_of.values())),
    )
    units, places = [unit for _, unit in errors_of.values()], [SENSOR.index(name) for name in errors_of]
    rows, errors, at = [], [], np.array([10.0])
    for name, found in ((name, log.measured) for name, log in logs.items()):
        if found is None or found.along is None or found.across is None:
            continue
        rays = (found.along, found.across)
        values = [*found.odometry, *(ray.sigmas(at)[0] for ray in rays), *(100.0 * ray.share for ray in rays)]
        errors.append(found.sensor[places] * units)
        halves = 1.96 * found.sensor_sigma[places] * units
        texts = (figure(*pair, 1) for pair in zip(errors[-1].tolist(), halves.tolist(), strict=True))
        rows.append((name, *figures(values, 4, 4, 4, 2, 2, 0, 0), *texts))
    if len(errors) > 1:
        means = (figure(*estimate(column), 1) for column in np.transpose(errors))
        rows.append(("all drives", *[UNKNOWN] * 7, *means))
    return TextTable.of(header, rows)
