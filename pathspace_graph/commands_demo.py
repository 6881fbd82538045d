"""`demo`: the main job with no argument, on a simulated Formula Student track."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console

from pathspace_graph.eval.plot import PlotStyle, plot_map, save_plot
from pathspace_graph.eval.summary import summarize
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .commands_online import map_online, report
from .commands_simulate import describe, generated_track
from .files import atomic_folder, check_target
from .log import Log, write_log
from .map import write_result
from .progress import progress
from .run import RunResult
from .settings import MapperSettings

PICTURE: Final = "track.png"
PICTURE_STYLE: Final = PlotStyle(dpi=150.0)
"""Of a size that suits a web page."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Simulate a Formula Student track, map it online; show the paper's table and a picture of the map."""

    out: Path = field(default_factory=lambda: Path("pathspace-demo"))
    """Folder for the log, the map and the picture; an earlier demo there is kept as a numbered backup."""
    seed: int = 0
    """Seed of the track and of all noise."""
    laps: int = 5
    """Laps driven."""

    def run(self) -> None:
        """Simulate, map, draw, and say where it is."""
        check_target(self.out, PICTURE)
        with progress("driving"):
            log = simulate(generated_track(self.seed), SimulationSettings(laps=self.laps), self.seed)
        say = partial(Console().print, highlight=False, soft_wrap=True, markup=False)
        say(f"a generated track, {self.laps} times around: {describe(log)}")
        result = map_online(log, MapperSettings())
        write_demo(self.out, log, result)
        report(result, log)
        say(f"log, map and {PICTURE} are in {self.out}")


def write_demo(out: Path, log: Log, result: RunResult) -> None:
    """The log, the map and its picture, all of them or none."""
    with progress("writing"), atomic_folder(out, PICTURE) as folder:
        write_log(log, folder / "log")
        write_result(folder / "map", result, summarize(result, log))
        picture = plot_map(result.map, log=log, trajectory=result.trajectory, style=PICTURE_STYLE)
        save_plot(picture, folder / PICTURE, style=PICTURE_STYLE)
