"""Trajectories in the TUM format, a row `t tx ty tz qx qy qz qw` for each pose (FORMATS)."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array

from .csv_table import is_plain
from .limits import MAX_COORDINATE, MAX_STAMP, shown
from .manifest import verified
from .parsing import read_text

TRAJECTORY_FILE: Final = "trajectory.tum"
_COLUMNS: Final = 8


def write_trajectory(file: Path, t: ArrayLike, poses: ArrayLike) -> None:
    """Write stamps (n,) in s and poses [x, y, theta] (n, 3), map frame; every number to full precision."""
    rows = np.column_stack([np.asarray(t, dtype=float), np.asarray(poses, dtype=float).reshape(-1, 3)])
    with file.open("w", encoding="utf-8", newline="\n") as out:
        for stamp, x, y, theta in rows.tolist():
            qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
            out.write(f"{stamp!r} {x!r} {y!r} 0.0 0.0 0.0 {qz!r} {qw!r}\n")


def read_trajectory(file: Path) -> tuple[Array, Array]:
    """Return stamps (n,) in s and poses [x, y, theta] (n, 3), map frame, theta in [-2 pi, 2 pi].

    Empty lines and lines that begin with # are left out. An InputError names the row that is wrong.
    """
    with verified(file.parent, file.name):
        lines = read_text(file, "a trajectory").split("\n")
        rows = [
            _values(file, line, number)
            for number, line in enumerate(lines, start=1)
            if line.strip() and not line.startswith("#")
        ]
    values = np.array(rows).reshape(-1, _COLUMNS)
    theta = 2 * np.arctan2(values[:, 6], values[:, 7])
    return values[:, 0], np.column_stack([values[:, 1:3], theta])


def _values(file: Path, line: str, number: int) -> list[float]:
    try:
        values = [float(word) for word in line.split()] if is_plain(line) else []
    except ValueError:
        values = []
    if len(values) != _COLUMNS or not np.isfinite(values).all():
        raise InputError(file, f"expected {_COLUMNS} finite numbers (t tx ty tz qx qy qz qw)", number)
    if abs(values[0]) > MAX_STAMP or max(map(abs, values[1:])) > MAX_COORDINATE:
        limits = f"a stamp of at most {MAX_STAMP:g} s and coordinates of at most {MAX_COORDINATE:g} m"
        raise InputError(file, f"expected {limits}, found {shown(line.strip())}", number)
    return values
