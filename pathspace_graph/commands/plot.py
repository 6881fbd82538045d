"""`plot`: the picture of a map folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.figures.files import check_plot_file, save_plot
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.io.files import check_file_target
from pathspace_graph.io.log import read_log
from pathspace_graph.io.map import read_map

TRAJECTORY_FILE = "trajectory.tum"
TUM_COLUMNS = 8


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Draw a map: both boundaries with their 2-sigma band, control points, trajectory and any truth."""

    map: Positional[Path]
    """Map folder to read."""
    out: Path
    """Picture to write (.png, .pdf or .svg); an earlier one is kept as a numbered backup."""
    log: Path | None = None
    """Log folder whose truth is drawn as well."""
    band_scale: float = 1.0
    """How many times as wide as it is the band is drawn; the legend says so."""
    title: str | None = None
    """Title of the picture."""

    def run(self) -> None:
        """Read, draw, write."""
        check_plot_file(self.out)
        check_file_target(self.out)
        if not 0.0 < self.band_scale < np.inf:
            raise SettingsError(f"--band-scale: expected a positive number, found {self.band_scale}")
        track = read_map(self.map)
        log = None if self.log is None else read_log(self.log)
        trajectory = read_trajectory(self.map / TRAJECTORY_FILE)
        save_plot(
            plot_map(track, log=log, trajectory=trajectory, band_scale=self.band_scale, title=self.title),
            self.out,
        )


def read_trajectory(file: Path) -> NDArray[np.float64] | None:
    """Positions (n, 2) of a TUM trajectory, map frame; None where there is no such file."""
    if not file.exists():
        return None
    rows = []
    for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            rows.append(_position(file, line, number))
    return np.array(rows).reshape(-1, 2)


def _position(file: Path, line: str, number: int) -> list[float]:
    try:
        values = [float(word) for word in line.split()]
    except ValueError:
        values = []
    if len(values) != TUM_COLUMNS or not np.isfinite(values).all():
        raise InputError(file, f"expected {TUM_COLUMNS} finite numbers (t tx ty tz qx qy qz qw)", number)
    return values[1:3]
