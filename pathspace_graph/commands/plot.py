"""`plot` and `verify`: a picture of a map, and a check of files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from tyro.conf import Positional

from pathspace_graph.console import say
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.eval.figures.style import check_plot_file, save_plot
from pathspace_graph.frames import read_cycles
from pathspace_graph.io.files import check_file_target
from pathspace_graph.io.log import read_log
from pathspace_graph.io.manifest import verify_all
from pathspace_graph.io.map import read_map
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE, read_trajectory

SUMMARY_FILE: Final = "summary.json"


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Draw a map: both boundaries with their 2-sigma band, control points, trajectory and any truth."""

    map: Positional[Path]
    """Folder of the map."""
    out: Path
    """File for the picture (.png, .pdf or .svg); an earlier one is kept as a numbered backup."""
    log: Path | None = None
    """Folder of the log whose truth is drawn as well."""
    band_scale: float = 1.0
    """Factor by which the band is drawn wider than it is, which the legend says."""
    title: str | None = None
    """Title of the picture."""

    def run(self) -> None:
        check_plot_file(self.out)
        check_file_target(self.out)
        if not 0.0 < self.band_scale < np.inf:
            raise SettingsError(f"--band-scale: expected a positive number, found {self.band_scale}")
        track = read_map(self.map)
        log = None if self.log is None else read_log(self.log)
        files = (self.map / name for name in (TRAJECTORY_FILE, SMOOTHED_FILE))
        trajectory, smoothed = (read_trajectory(file)[1] if file.exists() else None for file in files)
        cycles = read_cycles(self.map) if (self.map / CYCLES_FILE).exists() else {}
        look: dict[str, Any] = {"band_scale": self.band_scale, "title": self.title}
        look |= {"trajectory": trajectory, "smoothed": smoothed, "health": [*cycles.get("health", [])]}
        look["differences"] = _differences(self.map / SUMMARY_FILE)
        save_plot(plot_map(track, log=log, **look), self.out)


def _differences(file: Path) -> list[tuple[float, float]]:
    """Return the places (m) at which a map differs from the one that was known, by its summary."""
    summary = read_json(file, "a summary") if file.exists() else {}
    return [(one["x"], one["y"]) for one in summary.get("differences", [])]


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Check every file of a folder against its manifest, which each command writes beside its files."""

    folder: Positional[Path]
    """Folder of a log, a map, or the result of another command, with its subfolders."""

    def run(self) -> None:
        say(f"{self.folder}: {verify_all(self.folder)} files are as they were written")
