"""Tracks on which no loop may be closed: closed ones that are cut open before the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError

from .centre_line import CentreLine
from .track import Track

FloatArray = NDArray[np.float64]


def opened(track: Track, gap: float) -> Track:
    """Returns an open track that ends `gap` metres before the start of a closed one, and begins at its start.

    A SettingsError is raised where the track is open already, or shorter than the gap.
    """
    line = track.centre_line
    if not track.closed or not 0.0 < gap < line.length:
        raise SettingsError(f"gap: expected a closed track longer than the gap, found {track.name} and {gap}")
    start, kept = line.nearest(track.start), line.length - gap
    rows = (_stretch(row, line, start, kept) for row in (track.left, track.right, track.other))
    left, right, other = rows
    return replace(track, left=left, right=right, other=other, closed=False)


def _stretch(row: FloatArray, line: CentreLine, start: float, kept: float) -> FloatArray:
    """Returns the cones (k, 2) of a row within `kept` metres after the start, in driving order."""
    if len(row) == 0:
        return row
    s = np.arange(0.0, line.length, 0.25)
    middle = line.points(s)
    square = ((row[:, None] - middle) ** 2).sum(axis=2)
    station = np.mod(s[square.argmin(axis=1)] - start, line.length)
    order = np.argsort(station, kind="stable")
    return np.asarray(row[order[station[order] < kept]])
