"""`plot`: the picture of a map folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.eval.figures.style import check_plot_file, save_plot
from pathspace_graph.io.files import check_file_target
from pathspace_graph.io.log import read_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import CYCLES_FILE, read_health
from pathspace_graph.io.trajectory import TRAJECTORY_FILE, read_trajectory


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
        file = self.map / TRAJECTORY_FILE
        trajectory = read_trajectory(file)[1] if file.exists() else None
        cycles = self.map / CYCLES_FILE
        health = read_health(cycles) if cycles.exists() else []
        figure = plot_map(
            track,
            log=log,
            trajectory=trajectory,
            health=health,
            band_scale=self.band_scale,
            title=self.title,
        )
        save_plot(figure, self.out)
