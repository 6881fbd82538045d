"""The figures of the pages: measured in one run, kept as data, and shown as tables between markers.

Each experiment is a study or a benchmark with a folder of its own, which is resumed where a run was stopped.
Its tables are views of what it has measured. A page shows a table between `<!-- report: NAME -->` and
`<!-- end report -->`. Where the sources of the estimators are no longer those that were measured, a line
under the table says so.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final, Self

import pandas as pd

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.io.parsing import read_json, read_text
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.sim.mistakes import MISTAKES

from . import real, views
from .benchmark.measurement import measure_drive, metrics
from .benchmark.roads import QUICK, make_drives
from .benchmark.scaling import measure_scaling, scaling_figures
from .experiment.faults import at_strength, kinds, only, suite
from .experiment.provenance import sources_digest
from .experiment.run import run_study
from .experiment.study import Baseline, Study, find_study, read_study_file
from .experiment.tables import TextTable
from .hints import HintStudy
from .joint import JointStudy, joint_table
from .known import KnownStudy, known_table
from .views import ESTIMATORS, LANDMARKS, ONLINE, Figure, Rows, View

FORMAT: Final = "pathspace-figures/1"
FILE: Final = "figures.json"
ABLATIONS: Final = ("stations", "gauge", "robust", "density", "lag", "relinearize", "degree", "covariance")
"""Studies of parts of the method, driven by one estimator on the generated tracks for two laps."""
ONE_SEED: Final = ("gauge", "robust")  # those with so many variants that they are driven with one seed
PAGES: Final = {  # tables of each page, from the root of the project
    "README.md": ("readme-accuracy", "readme-compared", "readme-lines", "readme-speed", "readme-real"),
    "docs/results.md": (
        *("results-speed", "results-tracks", "results-laps", "results-compared", "results-scaling"),
    ),
    "docs/real.md": ("real-runs", "real-maps", "real-joint", "real-measured"),
    "docs/closing.md": ("skidpad",),
    "docs/studies.md": (
        "camera",
        "closing",
        "hard",
        "lines",
        "endurance",
        "reach",
        "known",
        "joint",
        "paper",
    ),
    "docs/reliability.md": ("faults", "recovery", "hints"),
    "docs/ablations.md": ("centerline", *ABLATIONS),
}
GENERATED: Final = (0, 1, 2)  # seeds of the generated tracks, also of the benchmark
SPEED: Final = {  # figures of the benchmark, each with its label
    "mean_by_isam2": "mean update by that of GTSAM's `ISAM2` on landmarks, given every association",
    "p99_by_isam2": "99th percentile by that of `ISAM2`",
    "mean_by_landmark": "mean update by that of `landmark-fixed-lag`",
    "mean": "mean update [ms]",
    "p99": "99th percentile of an update [ms]",
    "closing": "the update that closes the loop [ms]",
    "swap": "the update that swaps the map [ms]",
    "slowest_other": "the slowest of all other updates [ms]",
    "solve": "the batch of the open lap, in its own process [s]",
}
README: Final = ("rmse", "missed", "reach_median")
COMPARED: Final = (  # metrics of the wider comparison
    *("missed_2m", "missed_1m", "rmse_capped", "mapped_to_truth", "truth_to_mapped", "ghost_landmarks"),
    *("ghost_metres", "along", "across", "nees", "inside", "closed", "bytes", "bytes_covariance"),
)
CLOSING: Final = ("rmse", "rmse_by_batch", "turn_from_batch", "turn_nees", "inside", "ate")
"""Metrics by which a closed map is held against that of the batch."""
REACH: Final = ("reach_median", "reach_p10", "reach_short", "reach_error", "rmse")
PAPER: Final = ("rmse", "missed", "size", "ate", "inside")
CENTRE_LINE: Final = (
    *("rmse", "missed", "nees", "inside", "centre", "centre_nees", "half_width", "half_width_nees"),
)
_MARKED: Final = re.compile(r"(<!-- report: ([\w-]+) -->\n)(.*?)(<!-- end report -->)", re.DOTALL)


@dataclass(frozen=True)
class MeasuredTable:
    """A table of figures, and how they were measured."""

    command: str
    commit: str  # commit of the sources, where that was known
    date: str
    sources: str  # digest of the sources of the estimators
    header: tuple[str, ...]
    rows: Rows

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        rows = ((label, tuple(Figure(**figure) for figure in figures)) for label, figures in content["rows"])
        return cls(**{**content, "header": tuple(content["header"]), "rows": tuple(rows)})

    def markdown(self, sources: str) -> str:
        """Return the table in Markdown; `sources` is the digest of the present sources."""
        rows = tuple((label, *(figure.text for figure in figures)) for label, figures in self.rows)
        text = f"\n{TextTable('', self.header, rows).markdown()}\n"
        if sources == self.sources:
            return text
        commit = f"commit {self.commit}, " if self.commit else ""
        return f"{text}*Measured at {commit}{self.date}; the estimators have changed since.*\n\n"


Tables = dict[str, MeasuredTable]
Views = dict[str, View]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is driven; each experiment keeps its runs in a folder, and returns the tables that it measures."""

    quick: bool = False  # drive little, to see that everything works
    tracks: tuple[Path, ...] = ()  # folders of track files that are driven beside the generated tracks
    real: tuple[Path, ...] = ()  # folders of logs of a real car
    jobs: int = 1
    on_cell: Callable[[int, int], None] | None = None  # observer of the progress of a study

    def accuracy(self, folder: Path) -> Views:
        tracks: tuple[Path | int, ...] = GENERATED[:1] if self.quick else (*GENERATED, *self.tracks)
        estimators, seeds, laps = (ESTIMATORS[:3], (0, 1), 2) if self.quick else (ESTIMATORS, (0, 1), 5)
        base = Baseline(estimator=ONLINE)
        drives: dict[str, Any] = {"tracks": tracks, "estimators": estimators, "seeds": seeds, "laps": laps}
        study = Study(name="accuracy", baseline=base, metrics=PAPER, **drives)
        frame, shown = self._run(study, folder), tuple(dict.fromkeys([1, 2, laps]))
        return {
            "readme-accuracy": views.lap_columns(frame, shown, README),
            "readme-compared": views.compared_table(frame),
            "results-tracks": views.tracks_table(frame),
            "results-laps": views.laps_table(frame),
            "results-compared": views.metrics_table(frame, COMPARED),
            "closing": views.lap_columns(frame, shown, CLOSING),
            "reach": views.difference_table(study, frame[frame["lap"] == 1], LANDMARKS, REACH),
            "paper": views.study_table(study, frame),
        }

    def skidpad(self, folder: Path) -> Views:
        seeds, names = tuple(range(2 if self.quick else 10)), ESTIMATORS[: 2 if self.quick else 4]
        study = Study(name="skidpad", tracks=(Path("skidpad"),), estimators=names, seeds=seeds, laps=1)
        return {"skidpad": views.skidpad_table(self._run(study, folder))}

    def camera(self, folder: Path) -> Views:
        """Drive the study `camera` with one seed, whose noise is another one on each track."""
        return {"camera": views.camera_table(self._shipped("camera", folder, seeds=(0,))[1])}

    def hard(self, folder: Path) -> Views:
        study, frame = self._shipped("hard", folder)
        return {"hard": views.lap_columns(frame, tuple(dict.fromkeys([1, 2, study.laps])), CLOSING)}

    def lines(self, folder: Path) -> Views:
        """Drive the study `lines`, and at its second spacing the landmark graph beside it."""
        study, frame = self._shipped("lines", folder / "curves")
        name = list(study.noise)[1]
        beside = replace(study, estimators=(LANDMARKS,), noise={name: study.noise[name]})
        frame = pd.concat([frame, self._run(beside, folder / "landmarks")], ignore_index=True)
        return {
            "readme-lines": views.compared_table(frame[frame["noise"] == name]),
            "lines": views.lines_table(frame),
        }

    def endurance(self, folder: Path) -> Views:
        study, frame = self._shipped("endurance", folder)
        shown = [lap for lap in (3, 10, 30, 100) if lap <= study.laps] or [study.laps]
        return {"endurance": views.lap_columns(frame, shown, ("rmse", "inside", "nees", "ate"))}

    def centerline(self, folder: Path) -> Views:
        """Drive estimators of two boundaries, whose centre line is held against the true one."""
        study, frame = self._shipped("centerline", folder, tracks=GENERATED, seeds=(0,))
        return {"centerline": views.metrics_table(frame, CENTRE_LINE, study.estimators)}

    def ablation(self, folder: Path) -> Views:
        """Drive the study of the folder's name for two laps, under the first and the last of its noises."""
        name = folder.name
        noises = list(read_study_file(find_study(Path(name))).noise.items())
        small: dict[str, Any] = {"tracks": GENERATED, "laps": 2, "noise": dict([noises[0], noises[-1]])}
        small["seeds"] = (0,) if name in ONE_SEED else (0, 1)
        study, frame = self._shipped(name, folder, **small)
        return {name: views.study_table(study, frame)}

    def faults(self, folder: Path) -> Views:
        """Drive the suite of faults at the middle strengths."""
        study = at_strength(suite(), 0.5)
        if self.quick:
            study = replace(only(study, kinds(study)[:1]), tracks=(0,), laps=1)
        frame = self._run(study, folder)
        recovery = views.faults_table(study, frame, views.RECOVERY)
        return {"faults": views.faults_table(study, frame), "recovery": recovery}

    def hints(self, folder: Path) -> Views:
        small: dict[str, Any] = {"mistakes": tuple(MISTAKES)[:2]} if self.quick else {}
        study = HintStudy(tracks=GENERATED[: 1 if self.quick else 3], seeds=(0,), **small)
        return {"hints": views.hints_table(study.measure(folder=folder, **self._how))}

    def joint(self, folder: Path) -> Views:
        small: dict[str, Any] = {"tracks": (50,), "drives": 2} if self.quick else {}
        frame = JointStudy(**small).measure(folder=folder, **self._how)
        return {"joint": joint_table(frame)}

    def known(self, folder: Path) -> Views:
        small: dict[str, Any] = {"tracks": (60,), "begins": (0.3,)} if self.quick else {}
        frame = KnownStudy(**small).measure(folder=folder, **self._how)
        return {"known": known_table(frame)}

    def speed(self, _: Path) -> Views:
        seeds, laps = (GENERATED[:1], 1) if self.quick else (GENERATED, 5)
        runs = [{m.key: m.value for m in metrics(measure_drive(seed, laps))} for seed in seeds]
        values = pd.DataFrame(runs).reindex(columns=[*SPEED])
        rows = tuple(
            (label, (Figure.of(values[key], 2 if key.endswith(("isam2", "landmark")) else 1),))
            for key, label in SPEED.items()
        )
        header = ("figure", "measured")
        return {"readme-speed": (header, rows[:6]), "results-speed": (header, rows)}

    def real_logs(self, folder: Path) -> Views:
        if not self.real:
            raise SettingsError("--only real: expected logs in --real, found none")
        drives = [real.map_real_log(log, folder) for log in self.real]
        return {
            "readme-real": real.ends_table(drives),
            "real-runs": real.runs_table(drives),
            "real-maps": real.maps_table(drives),
            "real-joint": real.joint_table(drives),
            "real-measured": real.measured_table(drives),
        }

    def scale(self, folder: Path) -> Views:
        settings = QUICK if self.quick else ScalingSettings(cones_max=800.0, laps=10)
        scaling = measure_scaling((ONLINE, LANDMARKS), make_drives(settings), settings, folder=folder)
        header, found = scaling_figures(scaling)
        rows = ((f"`{name}`", Figure.row((value for value, _ in row), 2)) for name, row in found.items())
        return {"results-scaling": (header, tuple(rows))}

    def _shipped(self, name: str, folder: Path, **small: Any) -> tuple[Study, pd.DataFrame]:
        """Drive a shipped study, made smaller: with `quick` the first variant for one lap."""
        study = replace(read_study_file(find_study(Path(name))), **small)
        if self.quick:
            grids = tuple({key: values[:1] for key, values in grid.items()} for grid in study.grids[:1])
            variants = dict([*study.variants.items()][:1])
            study = replace(study, tracks=(0,), seeds=(0,), laps=1, variants=variants, grids=grids)
        return study, self._run(study, folder)

    def _run(self, study: Study, folder: Path) -> pd.DataFrame:
        return run_study(study, folder, **self._how)

    @property
    def _how(self) -> dict[str, Any]:
        return {"jobs": self.jobs, "on_cell": self.on_cell}


EXPERIMENTS: Final[Mapping[str, Callable[[Plan, Path], Views]]] = {
    "accuracy": Plan.accuracy,
    "skidpad": Plan.skidpad,
    "camera": Plan.camera,
    "faults": Plan.faults,
    "hard": Plan.hard,
    "lines": Plan.lines,
    "endurance": Plan.endurance,
    "centerline": Plan.centerline,
    **dict.fromkeys(ABLATIONS, Plan.ablation),
    "hints": Plan.hints,
    "known": Plan.known,
    "joint": Plan.joint,
    "speed": Plan.speed,
    "scale": Plan.scale,
    "real": Plan.real_logs,
}
QUICKEST: Final = ("accuracy", "skidpad", "camera", "faults", "robust", "hints", "speed", "scale")
"""Experiments of a quick report: the others have no view of their own."""


def measure_figures(
    plan: Plan, folder: Path, only: Sequence[str], about: Mapping[str, str], known: Tables
) -> Tables:
    """Run experiments, each in a folder of its own, and return the known tables with theirs in place.

    `about` holds command, commit and date of the run. `pages` is no experiment: only pages are written anew.
    """
    tables, sources = dict(known), sources_digest()
    for name in only:
        check_name(name, (*EXPERIMENTS, "pages"), "--only: expected an experiment")
    every = [name for name in QUICKEST if plan.quick] or [*EXPERIMENTS]
    chosen = only or [name for name in every if name != "real" or plan.real]
    for name in (name for name in chosen if name != "pages"):
        for table, (header, rows) in EXPERIMENTS[name](plan, folder / name).items():
            tables[table] = MeasuredTable(**about, sources=sources, header=header, rows=rows)
    return tables


def to_json(tables: Tables) -> dict[str, Any]:
    return {"format": FORMAT, "tables": {name: asdict(table) for name, table in sorted(tables.items())}}


def read_figures(file: Path) -> Tables:
    """Return the tables of a file; InputError where it is none of `to_json`."""
    content = read_json(file, "the figures of a report")
    try:
        if content["format"] != FORMAT:
            raise ValueError(f"found {content['format']}")
        return {name: MeasuredTable.from_json(table) for name, table in content["tables"].items()}
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(file, f"expected {FORMAT}: {error}") from error


def render_pages(root: Path, tables: Tables) -> dict[Path, str]:
    """Return the text of each page below a root, with its tables; InputError where one is not known."""
    sources = sources_digest()
    files = [root / page for page in PAGES]
    return {file: render(file, read_text(file, "a page"), tables, sources) for file in files}


def render(page: Path, text: str, tables: Tables, sources: str) -> str:
    """Return the text of a page with each marked table made anew."""

    def rendered(found: re.Match[str]) -> str:
        begin, name, _, end = found.groups()
        if name not in {*tables, *chain.from_iterable(PAGES.values())}:
            raise InputError(page, f"expected a table of the report, found {name}")
        shown = tables[name].markdown(sources) if name in tables else "\n*Not measured yet.*\n\n"
        return f"{begin}{shown}{end}"

    return _MARKED.sub(rendered, text)
