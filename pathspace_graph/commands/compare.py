"""`demo` and `compare`: two estimators on a simulated track, or every one on logs, and the paper's table."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from joblib import Parallel, delayed
from tyro.conf import Positional, arg

from pathspace_graph.console import LINES, note, output, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import DEFAULT_ONLINE, make_online
from pathspace_graph.eval.experiment import compare as experiment
from pathspace_graph.eval.experiment.cells import run_estimator
from pathspace_graph.eval.experiment.compare import Comparison, compare, side_by_side
from pathspace_graph.eval.experiment.runner import check_jobs, unfinished, workers
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.eval.figures.style import save_plot
from pathspace_graph.eval.metrics.accuracy import GhostSettings
from pathspace_graph.eval.metrics.summary import laps_of, not_mapped, summarize
from pathspace_graph.io.files import atomic_folder, check_target
from pathspace_graph.io.log import Log, write_log
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .estimate import map_online, outline, tell
from .maps import compare_maps
from .simulate import describe, generated_track

FAILED: Final = 3  # exit code of a comparison that is written, but in which an estimator failed
RIVAL: Final = "landmark-fixed-lag"  # estimator whose table stands beside the spline graph's in the demo
PICTURE: Final = "track.png"
PICTURE_DPI: Final = 150.0  # resolution of the picture, dots per inch, which suits a web page


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Run every estimator on a log, or on a folder of logs; or lay a map on another one.

    Of logs, tables, figures and all maps are written; of two maps, their distances and a picture.

    The paper's table is printed, or without truth what can be said without it; files have all metrics.
    For several logs the tables have means, and differences from the reference, paired over the logs, with
    their 95 % confidence interval. An estimator that fails is reported and does not stop the others; the exit
    code is 3 then. Finished runs are kept in `OUT.unfinished` until all are there, so that the same command
    goes on where it was killed.
    """

    log: Positional[tuple[Path, ...]]
    """Folder of the log, or of several logs; or the folders of two maps of one track."""
    out: Path
    """Folder for tables, figures and maps; an earlier comparison there is kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the estimators, online and batch ones; by default all."""
    reference: str | None = None
    """Estimator that the others are compared with: fixed-lag where it runs, otherwise the first."""
    jobs: int = 1
    """Number of runs at a time, -1 for one on each core; times of updates are comparable with 1 only."""
    ghosts: GhostSettings = field(default_factory=GhostSettings)
    """Definition of a ghost."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of every estimator."""

    def run(self) -> None:
        if len(self.log) == 2:
            compare_maps(*self.log, self.out)
            return
        if len(self.log) != 1:
            raise SettingsError(f"LOG: expected one log, or two maps, found {len(self.log)} folders")
        plan = experiment.plan_of(self.log[0], self.estimators, self.reference, self.settings, self.ghosts)
        check_jobs(self.jobs)
        check_target(self.out, experiment.MARKER)
        for drive in dict.fromkeys(cell.drive for cell in plan.cells):
            tell(drive.load()[1], of=drive.source if len(plan.study.logs) > 1 else "")
        with unfinished(self.out) as folder:
            with progress("comparing", lines=LINES) as advance:
                comparison = compare(plan, folder, jobs=self.jobs, on_cell=advance)
            with progress("writing"):
                experiment.write_comparison(self.out, comparison, self.jobs)
        self._report(comparison)

    def _report(self, comparison: Comparison) -> None:
        console = output(wide=True)
        tables = experiment.tables(comparison)
        for table in (table for name, table in tables.items() if name != "metrics"):
            console.print(table.title, highlight=False, markup=False)
            for part in table.parts(console.width):
                console.print(part.rich())
        say(f"written to {self.out}")
        note(*(f"{of['estimator']} on {of['log']}: not converged" for of in comparison.unsettled))
        failures = comparison.failures
        note(*(f"{of['estimator']} on {of['log']}: failed, {of['error']}" for of in failures))
        if failures:
            raise SystemExit(FAILED)


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Simulate a track and map it online: the paper's table beside the landmark graph's, and a picture."""

    out: Path = Path("pathspace-demo")
    """Folder for log, map and picture; an earlier demo there is kept as a numbered backup."""
    seed: int = 8
    """Seed of the track and of all noise; by default one whose first lap is typical."""
    laps: int = 5
    """Laps that the vehicle drives."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of both estimators."""

    def run(self) -> None:
        check_target(self.out, PICTURE)
        with progress("driving"):
            log = simulate(generated_track(self.seed), SimulationSettings(laps=self.laps), self.seed)
        say(f"a generated track, {self.laps} times around: {describe(log)}")
        result, rival = map_with_both(log, self.settings)
        write_demo(self.out, log, result)
        table = side_by_side({run.estimator: laps_of(run, log) for run in (result, rival)})
        if table.rows:
            output().print(table.rich())
        say(outline(result))
        say(*not_mapped(result.map, log), f"log, map and {PICTURE} are in {self.out}")


def map_with_both(log: Log, settings: MapperSettings) -> tuple[RunResult, RunResult]:
    """Return the spline graph's result and the landmark graph's, which runs in another process."""
    with workers(2):  # with one job it would be run here, and first
        rival = Parallel(return_as="generator")([delayed(run_estimator)(RIVAL, settings, log)])
        result = map_online(log, make_online(DEFAULT_ONLINE, settings, log))
        with progress(RIVAL):
            (landmarks,) = rival  # to the end, or joblib warns of tasks that were cancelled
        return result, landmarks


def write_demo(out: Path, log: Log, result: RunResult) -> None:
    """Write the log, the map and its picture: all of them, or on failure nothing."""
    with progress("writing"), atomic_folder(out, PICTURE) as folder:
        write_log(log, folder / "log")
        write_result(folder / "map", result, summarize(result, log))
        picture = plot_map(result.map, log=log, trajectory=result.trajectory, smoothed=result.smoothed)
        save_plot(picture, folder / PICTURE, PICTURE_DPI)
