"""How far the mapped boundaries are from the true ones as curves, both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES

from .table1 import boundary_distances
from .true_curve import MAPPED_STEP, mapped_points, true_curve

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CurveDistance:
    """Mean distances (m) of both boundaries together."""

    mapped_to_truth: float
    """From what is mapped to the true curve: large where something is mapped that isn't there."""
    truth_to_mapped: float
    """From the true curve to what is mapped: large where something is there that isn't mapped."""

    @property
    def two_way(self) -> float:
        """Their mean."""
        return 0.5 * (self.mapped_to_truth + self.truth_to_mapped)


def curve_distance(track: Map, truth: Truth) -> CurveDistance:
    """mean over mapped points p of min_q |p - q|, and over true ones q of min_p |q - p|, q on the true curve.

    A mapped spline is all of its points, by length; landmarks are points with nothing in between, so that the
    way back charges them for the gaps from one to the next, which the error at the cones doesn't. Infinite
    back where a boundary isn't mapped; NaN where there is nothing to measure from, or no true curve.
    """
    forth, back = [np.zeros(0)], [np.zeros(0)]
    for label in BOUNDARIES:
        true = true_curve(truth, label)
        if len(true) == 0:
            continue
        if label not in track.boundaries:
            back.append(np.full(1, np.inf))
            continue
        boundary = track.boundaries[label]
        forth.append(np.asarray(KDTree(true).query(mapped_points(boundary))[0]))
        back.append(boundary_distances(boundary, true_curve(truth, label, MAPPED_STEP)))
    return CurveDistance(_mean(np.concatenate(forth)), _mean(np.concatenate(back)))


def _mean(distances: Array) -> float:
    return float(np.mean(distances)) if len(distances) else float("nan")
