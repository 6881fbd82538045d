"""Detections of a line: which they are, and dense ones merged, since a line has no points of its own."""

from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.io.log import Detections
from pathspace_graph.settings.mapper import MapperSettings

MOST_CELLS: Final = 1 << 20  # in a row of cells, which is more than any sensor sees
MERGE_CELL: Final = 1.0  # side of the cells (m) in which points are merged: 5 mm beside an arc of 9 m


def of_line(labels: IntArray, settings: MapperSettings) -> BoolArray:
    """Return which detections (m,) are points of a line: all where both sides are, whatever the label."""
    if settings.kind == "line":
        return np.ones(len(labels), bool)
    return np.isin(labels, settings.lines) if settings.lines else np.zeros(len(labels), bool)


def merged(detections: Detections, is_line: BoolArray) -> Detections:
    """Return detections with the points of a line that share label and cell replaced by their mean."""
    if not is_line.any():
        return detections
    line = detections.where(is_line)
    column, row = np.floor(line.points_vehicle / MERGE_CELL).astype(np.intp).T
    keys = (line.labels * MOST_CELLS + column) * MOST_CELLS + row
    _, first, cell, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    points = _means(line.points_vehicle, cell, counts)
    covariances = _means(line.covariances.reshape(-1, 4), cell, counts) / counts[:, None]
    mean = Detections(line.t, points, covariances.reshape(-1, 2, 2), line.labels[first])
    return detections.where(~is_line).with_others(mean)


def _means(values: Array, cell: IntArray, counts: IntArray) -> Array:
    return np.column_stack([np.bincount(cell.ravel(), column) for column in values.T]) / counts[:, None]
