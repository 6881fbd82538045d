"""The map's curves side by side, so that detections of both boundaries are projected in one pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.footpoint import FootPoints, joint_foot_points, refine_joint_foot_points
from pathspace_graph.factors.spans import SpanPolynomials, Spans, lay_out
from pathspace_graph.graph.keys import control_keys
from pathspace_graph.spline.boundary import Boundary

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Curves:
    """Holds the active part of every curve: curves 0 to k - 1 in the order of their labels.

    The control points of all curves are rows of one array, as `State.map_points` has them.
    """

    boundaries: tuple[Boundary, ...]
    """These are the curves."""
    labels: IntArray
    """(k,) These are the labels of the curves, ascending."""
    active: tuple[IntArray, ...]
    """These are the active control points of each curve, by index."""
    tables: tuple[SpanPolynomials, ...]
    """These are the tables of each whole curve."""
    spans: Spans
    """All spans of closed curves are included; an open curve begins at its first active control point."""
    active_from: Array
    """(k,) An open curve is inactive before this parameter, which is minus infinity if all is active."""
    keys: IntArray
    """(m,) These are the keys of all control points."""

    def is_current(self, boundaries: Mapping[int, Boundary], active: Callable[[int], IntArray]) -> bool:
        """Returns whether these are the boundaries and active control points as they are now."""
        return len(boundaries) == len(self.tables) and all(
            boundary.tables is tables and active(label) is indices
            for (label, boundary), tables, indices in zip(
                boundaries.items(), self.tables, self.active, strict=True
            )
        )

    def number(self, labels: IntArray) -> IntArray:
        """Returns the index (m,) of the curve that has each label (m,)."""
        return self.labels.searchsorted(labels)

    def believed(self, curve: IntArray, high: Array) -> Array:
        """Returns upper limits (m,) of stretches, clipped so that they exclude extrapolated ends."""
        trusted = np.array([boundary.trusted for boundary in self.boundaries])
        return np.asarray(np.minimum(high, trusted[curve]))

    def find(
        self, control_points: Array, points: Array, curve: IntArray, low: Array, high: Array
    ) -> FootPoints:
        """Searches the foot point of each point (m, 2) on its own curve (m,) and stretch [low, high]."""
        s, high = self.boundaries[0].settings, self.believed(curve, high)
        search = (s.search_step, s.search_iterations)
        return joint_foot_points(self.spans, control_points, points, curve, low, high, *search)

    def refine(self, control_points: Array, points: Array, curve: IntArray, u: Array) -> FootPoints:
        """Refines the foot point of each point (m, 2) on its own curve (m,), starting at u (m,)."""
        s = self.boundaries[0].settings
        low, high = u - s.refine_room, self.believed(curve, u + s.refine_room)
        return refine_joint_foot_points(
            self.spans, control_points, points, curve, u, low, high, s.refine_iterations
        )

    def reaches_inactive(self, curve: IntArray, foot: FootPoints) -> bool:
        """Returns whether any foot point, each on its own curve (m,), is on an inactive part."""
        return not self.spans.periodic and bool((foot.u <= self.active_from[curve]).any())


def lay_out_curves(boundaries: Mapping[int, Boundary], active: Mapping[int, IntArray]) -> Curves:
    """Lays out boundaries, at least one, with the active control points (k,) of each."""
    curves, active_of = tuple(boundaries.values()), tuple(active[label] for label in boundaries)
    sizes = [boundary.size for boundary in curves]
    offsets = np.cumsum([0, *sizes[:-1]])
    first = [0 if b.periodic else int(indices[0]) for b, indices in zip(curves, active_of, strict=True)]
    tables = [b.tables.tail(start) if start else b.tables for b, start in zip(curves, first, strict=True)]
    return Curves(
        boundaries=curves,
        labels=np.array(list(boundaries), np.intp),
        active=active_of,
        tables=tuple(boundary.tables for boundary in curves),
        spans=lay_out(tables, [int(o) + f for o, f in zip(offsets, first, strict=True)], sizes),
        active_from=np.array([t.low if start else -np.inf for t, start in zip(tables, first, strict=True)]),
        keys=np.concatenate([control_keys(label, b.numbers) for label, b in boundaries.items()]),
    )
