"""`demo`: the main job with no argument, on a simulated Formula Student track."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from joblib import Parallel, delayed
from tyro.conf import arg

from pathspace_graph.console import output, progress, say
from pathspace_graph.estimators import DEFAULT, make_online
from pathspace_graph.eval.experiment.cells import run_estimator
from pathspace_graph.eval.experiment.compare import side_by_side
from pathspace_graph.eval.experiment.run import workers
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.eval.figures.style import save_plot
from pathspace_graph.eval.metrics.summary import laps_of, not_mapped, summarize
from pathspace_graph.io.files import atomic_folder, check_target
from pathspace_graph.io.log import Log, write_log
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .online import map_online, outline
from .simulate import describe, generated_track

RIVAL: Final = "landmark-fixed-lag"
"""Estimator whose table stands beside the spline graph's."""
PICTURE: Final = "track.png"
PICTURE_DPI: Final = 150.0
"""Resolution of the picture, dots per inch, which suits a web page."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Simulate a track and map it online: the paper's table beside the landmark graph's, and a picture."""

    out: Path = field(default_factory=lambda: Path("pathspace-demo"))
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
    with workers(2, None):  # with one job it would be run here, and first
        rival = Parallel(return_as="generator")([delayed(run_estimator)(RIVAL, settings, log)])
        result = map_online(log, make_online(DEFAULT, settings, log))
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
