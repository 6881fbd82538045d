"""How a vehicle finds itself on a known map: anywhere on it, on that of another track, on a changed one."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.batch.known_map import map_of_cones
from pathspace_graph.estimators import DEFAULT_ONLINE, make_online, settings_of
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .cars import Columns, generated, over_tracks
from .experiment.tables import Table
from .metrics.accuracy import lap_metrics
from .metrics.reference import truth_of
from .metrics.registration import motion_onto
from .metrics.trajectory import interpolate_poses

OWN, SURVEYED, MOVED, OTHER = "another drive's", "surveyed", "surveyed, 7 cones moved", "another track's"
SIGMA_SURVEY: Final = 0.15  # of the cones of a surveyed map (m)
MOVED_CONES, MOVED_BY = 7, 2.5  # number of neighbours on the left that were moved, and how far (m)
SOON: Final = 8.0  # time after which the vehicle should be found (s)
DRIVEN: Final = 40.0  # time that is driven on a known map (s)
WRONG: Final = 2.0  # distance (m) from the true pose at which the place where it was found is a wrong one
COLUMNS: Final[Columns] = {
    "found": ("found [%]", 0, 100.0),
    "soon": (f"within {SOON:.0f} s [%]", 0, 100.0),
    "wrong": ("at a wrong place [%]", 0, 100.0),
    "error": ("pose error [m]", 2, 1.0),
    "map": ("rmse of the map [m]", 2, 1.0),
}


def of_track(
    car: str, track: int, settings: SimulationSettings, begins: Sequence[float]
) -> list[dict[str, Any]]:
    """Return the rows of the second drive of a track, on maps of the first one and of another track.

    It begins at some shares of the first lap's time.
    """
    first, second = (simulate(generated(track), settings, seed) for seed in (0, 1))
    elsewhere = simulate(generated(track + 1000), settings, 0)
    truth, rows = truth_of(first), list[dict[str, Any]]()
    motion = motion_onto(truth_of(second).cones, truth.cones)
    rng = np.random.default_rng(track)
    maps = {
        OWN: mapped(first),
        SURVEYED: surveyed(truth, rng),
        MOVED: surveyed(truth, rng, MOVED_CONES),
        OTHER: mapped(elsewhere),
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
    is_soon, is_wrong = found_at - later.odometry.t[0] <= SOON, away[0] > WRONG
    return {
        "found": 1.0,
        "soon": float(is_soon),
        "wrong": float(is_wrong),
        "error": float(np.sqrt(np.mean(away**2))),
    }


def known_table(frame: pd.DataFrame) -> Table:
    """Return a row for each car and kind of map."""
    groups = frame.groupby(["car", "kind"], sort=False)
    parts = {f"{car}, {kind} ({len(part)} drives)": part for (car, kind), part in groups}
    return over_tracks("cars, known map", parts, COLUMNS)
