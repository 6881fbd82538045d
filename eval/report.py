"""The figures of the pages: each experiment measures some tables, which are written as tidy CSV.

An experiment has a folder of its own, from which a stopped report goes on. Most are studies, which
`report.toml` lists with their tables; the others are functions here. A table is named after its experiment.
It has a row for each figure, and says by which command, at which commit, on which machine and when it was
measured. `docs/hooks.py` shows the files of `docs/figures` on the pages.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.estimators import DEFAULT_BATCH, DEFAULT_ONLINE
from pathspace_graph.io.parsing import parse_toml, read_text
from pathspace_graph.settings.mapper import ScalingSettings

from . import cars
from .benchmark import QUICK, RIVAL, measure_scaling, measure_speed, scaling_table
from .experiment import faults, tables
from .experiment.run import make_plan, origin_of, rows_of, run_study
from .experiment.study import Study, StudyDrive, find_study, read_study_file
from .experiment.tables import TextTable, by_metric, by_name, last_laps
from .metrics.measures import METRICS, UNKNOWN, Metric
from .metrics.reference import landmark_rmse, solve_oracle_landmarks, truth_of

FILE: Final = Path(__file__).with_suffix(".toml")
STUDIES: Final = parse_toml(read_text(FILE), FILE)
Tables = dict[str, TextTable]  # of an experiment, by what follows its name; empty for the one of that name


@dataclass(frozen=True, kw_only=True)
class ReportPlan:
    """What is driven; each experiment keeps its runs in a folder, and returns the tables that it measures."""

    quick: bool = False  # drive little, to see that everything works
    tracks: tuple[Path, ...] = ()  # folders of track files that are driven beside the generated tracks
    real: tuple[Path, ...] = ()  # folders of logs of a real car
    jobs: int = 1
    on_cell: Callable[[int, int], None] | None = None  # observer of the progress of a study

    @property
    def how(self) -> dict[str, Any]:
        """Return how studies run."""
        return {"jobs": self.jobs, "on_cell": self.on_cell}

    def study(self, folder: Path) -> Tables:
        """Drive the study of the folder's name as `report.toml` says, and make its tables."""
        about = STUDIES[folder.name]
        study = smaller(read_study_file(find_study(Path(folder.name))), about.get("drives", {}))
        if folder.name == "accuracy" and not self.quick:
            study = replace(study, tracks=(*study.tracks, *self.tracks))
        if folder.name == "faults":
            study = faults.at_strength(study, 0.5)
            study = faults.only(study, faults.kinds(study)[:1]) if self.quick else study
        if self.quick:
            grids = tuple({key: values[:1] for key, values in grid.items()} for grid in study.grids[:1])
            study = replace(study, grids=grids, variants=dict([*study.variants.items()][:1]))
            study = smaller(study, about.get("quick", {"tracks": [0], "seeds": [0], "laps": 1}))
        frame = run_study(study, folder, **self.how)
        if "beside" in about:
            other = run_study(smaller(study, about["beside"]), folder / "beside", **self.how)
            frame = pd.concat([frame, other], ignore_index=True)
        found = dict[str, TextTable]()
        for part, wanted in about["tables"].items():
            options = {key: value for key, value in wanted.items() if key not in {"kind", "metrics"}}
            if "metrics" in wanted:
                options["metrics"] = [METRICS[key] for key in wanted["metrics"]]
            found[part] = KINDS[wanted["kind"]](study, frame, **options)
        if folder.name == "camera":
            drives = dict.fromkeys(cell.drive for cell in make_plan(study).cells)
            parts = [{"drive": drive} for drive in drives]
            limit = tables.mean(
                METRICS["rmse"], rows_of(landmark_limit, parts, folder / "landmarks", **self.how)
            )
            frame = found[""].frame
            frame.loc[len(frame)] = ["landmarks, given all", limit, *[UNKNOWN] * (frame.shape[1] - 2)]
        return found

    def joint(self, folder: Path) -> Tables:
        tracks, drives = ((50,), 2) if self.quick else ((50, 51, 52), 8)
        parts = cars.on_tracks(tracks, drives=drives)
        return {"": cars.joint_table(rows_of(cars.joint_of_track, parts, folder, **self.how))}

    def known(self, folder: Path) -> Tables:
        tracks, begins = ((60,), (0.3,)) if self.quick else (range(60, 68), (0.0, 0.3, 0.6))
        parts = cars.on_tracks(tracks, begins=begins)
        drives = rows_of(cars.known_of_track, parts, folder, **self.how)
        every = cars.on_tracks(tracks, [*cars.CARS])
        searches = rows_of(cars.odds_of_track, every, folder / "odds", **self.how)
        return {"": cars.known_table(drives), "odds": cars.odds_table(searches)}

    def speed(self, _: Path) -> Tables:
        return measure_speed(self.quick, self.real)

    def real_logs(self, folder: Path) -> Tables:
        if not self.real:
            raise SettingsError("--only real: expected logs in --real, found none")
        return cars.real_tables(self.real, folder, **self.how)

    def scale(self, folder: Path) -> Tables:
        settings = QUICK if self.quick else ScalingSettings(cones_max=800.0, laps=10)
        points = measure_scaling((DEFAULT_ONLINE, RIVAL), settings, folder=folder, on_cell=self.on_cell)
        return {"": scaling_table(points, settings)}


EXPERIMENTS: Final[Mapping[str, Callable[[ReportPlan, Path], Tables]]] = {
    **dict.fromkeys(STUDIES, ReportPlan.study),
    "known": ReportPlan.known,
    "joint": ReportPlan.joint,
    "speed": ReportPlan.speed,
    "scale": ReportPlan.scale,
    "real": ReportPlan.real_logs,
}


def landmark_limit(drive: StudyDrive) -> list[dict[str, Any]]:
    """Return the rmse (m) of the landmark batch that is told all about a drive."""
    log, _ = drive.load()
    rmse = landmark_rmse(solve_oracle_landmarks(log)[1], truth_of(log))
    return [{"track": drive.track, "rmse": rmse}]


def smaller(study: Study, parts: Mapping[str, Any]) -> Study:
    """Return a study with some parts replaced; of its noises those that are named are kept."""
    noise = {name: study.noise[name] for name in parts.get("noise", study.noise)}
    return replace(study, **{**parts, "noise": noise})


def write_report(
    plan: ReportPlan, folder: Path, names: Sequence[str] = ()
) -> Iterator[tuple[Path, TextTable]]:
    """Run experiments, by default all that the plan has logs for; write and yield each table."""
    for name in names:
        check_name(name, EXPERIMENTS, "--only: expected an experiment")
    every = [name for name in EXPERIMENTS if name != "real" or plan.real]
    if plan.quick:  # the others have no table of their own kind
        every = ["accuracy", "skidpad", "camera", "faults", "robust", "speed", "scale"]
    for name in names or every:
        run = origin_of(__name__)
        given = {"accuracy": " --tracks TRACKS" * bool(plan.tracks), "real": " --real LOGS"}
        given["speed"] = given["real"] * bool(plan.real)
        about = {
            "commit": run["commit"],
            "machine": run["processor"],
            "date": run["date"][:10],
            "command": f"pathspace-graph report --only {name}{given.get(name, '')}{' --quick' * plan.quick}",
        }
        for part, table in EXPERIMENTS[name](plan, folder / name).items():
            file = folder / f"{'_'.join(filter(None, (name, part)))}.csv"
            tables.write_csv(file, table.tidy.assign(**about))
            yield file, table


# --- kinds of tables -------------------------------------------------------------------------------------


def laps_table(
    study: Study, frame: pd.DataFrame, laps: Sequence[int], metrics: Sequence[Metric]
) -> TextTable:
    """Return metrics of the online map after some laps, and of the batch where it ran."""
    online, batch = (frame[frame["estimator"] == name] for name in (DEFAULT_ONLINE, DEFAULT_BATCH))
    shown = [lap for lap in laps if lap <= study.laps] or [study.laps]
    columns = {f"lap {lap}": online[online["lap"] == lap] for lap in shown}
    return by_metric(columns | ({"batch": last_laps(batch)} if len(batch) else {}), metrics)


def estimators_table(
    study: Study,
    frame: pd.DataFrame,
    metrics: Sequence[Metric],
    estimators: Sequence[str] = (),
    lap: int | None = None,
) -> TextTable:
    """Return metrics of estimators, one in each column, after a lap or at the end of the last one."""
    chosen = frame[frame["estimator"].isin(estimators or study.estimators)]
    chosen = chosen if lap is None else chosen[chosen["lap"] == lap]
    return by_metric(dict(iter(last_laps(chosen).groupby("estimator", sort=False))), metrics)


def tracks_table(_: Study, frame: pd.DataFrame) -> TextTable:
    """Return the online map and that of the batch, track by track: too few drives for an interval."""
    online, batch = (frame[frame["estimator"] == name] for name in (DEFAULT_ONLINE, DEFAULT_BATCH))
    first, last = online[online["lap"] == 1], last_laps(online)
    columns = {
        "rmse, lap 1 [m]": ("rmse", first),
        "rmse, last lap [m]": ("rmse", last),
        "rmse, batch [m]": ("rmse", last_laps(batch)),
        "missed, lap 1 [%]": ("missed", first),
        "size [% of cones]": ("size_share", last),
        "within 2σ [%]": ("inside", last),
        "NEES": ("nees", last),
    }
    texts = pd.DataFrame(index=pd.Index(frame["track"].unique(), name="track"))
    for title, (key, runs) in columns.items():
        values = runs.groupby("track")[key].agg(METRICS[key].over) if key in runs else pd.Series(dtype=float)
        texts[title] = [METRICS[key].text(value) for value in values.reindex(texts.index)]
    return TextTable(texts.reset_index().astype(str))


def rmse_table(_: Study, frame: pd.DataFrame) -> TextTable:
    """Return the rmse of every online estimator after each lap."""
    laps = frame[frame["lap"] > 0]
    several = laps.groupby("estimator", sort=False)["lap"].transform("nunique") > 1
    texts = pd.DataFrame(
        {
            name: {lap: tables.mean(METRICS["rmse"], of) for lap, of in runs.groupby("lap")}
            for name, runs in laps[several].groupby("estimator", sort=False)
        }
    )
    texts = texts.sort_index().fillna(UNKNOWN).rename_axis("rmse after lap [m]")
    return TextTable(texts.reset_index().astype(str))


def skidpad_table(_: Study, frame: pd.DataFrame, metrics: Sequence[Metric]) -> TextTable:
    """Return every estimator: its trajectory error over the whole drive, and its map at the end."""
    square = (frame["ate"] ** 2).groupby([frame[name] for name in tables.RUN_OF]).transform("mean")
    return by_name(last_laps(frame.assign(ate=square**0.5)), ("estimator",), metrics)


KINDS: Final[Mapping[str, Callable[..., TextTable]]] = {
    "laps": laps_table,
    "estimators": estimators_table,
    "tracks": tracks_table,
    "rmse": rmse_table,
    "skidpad": skidpad_table,
    "differences": tables.contrast_table,
    "runs": lambda _, frame, names, metrics: by_name(last_laps(frame), names, metrics),
    "faults": lambda study, frame: faults.fault_table(study, faults.outcomes(study, frame)),
}
"""Tables of a study and its results, with options."""
