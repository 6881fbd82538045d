"""The map's curves side by side: foot points of readings on both boundaries in one pass."""

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
    """The active part of every curve, all control points of the map in one array: curve 0, 1 by label."""

    boundaries: tuple[Boundary, ...]
    """By label."""
    labels: IntArray
    """(k,) theirs."""
    active: tuple[IntArray, ...]
    """Control points of each that are active."""
    tables: tuple[SpanPolynomials, ...]
    """Of the whole of each."""
    spans: Spans
    """Of closed curves all; open ones begin with the first active control point."""
    cut: Array
    """(k,) parameter before which an open curve is inactive; minus infinity where nothing of it is."""
    keys: IntArray
    """(m,) keys of all control points of the map."""
    offsets: IntArray
    """(k,) where each curve's begin among them."""

    def are(self, boundaries: Mapping[int, Boundary], active: Callable[[int], IntArray]) -> bool:
        """Whether these are the boundaries, as they are now, and their active control points."""
        return len(boundaries) == len(self.tables) and all(
            boundary.tables is tables and active(label) is indices
            for (label, boundary), tables, indices in zip(
                boundaries.items(), self.tables, self.active, strict=True
            )
        )

    def number(self, labels: IntArray) -> IntArray:
        """(m,) which curve has each of these labels."""
        return self.labels.searchsorted(labels)

    def believed(self, curve: IntArray, high: Array) -> Array:
        """Upper limits of stretches (m,), kept off what open curves only extrapolate."""
        trusted = np.array([boundary.trusted for boundary in self.boundaries])
        return np.asarray(np.minimum(high, trusted[curve]))

    def find(
        self, control_points: Array, points: Array, curve: IntArray, low: Array, high: Array
    ) -> FootPoints:
        """Foot points of points (m, 2), each on its own curve (m,) and stretch, searched for globally."""
        s, high = self.boundaries[0].settings, self.believed(curve, high)
        search = (s.search_step, s.search_iterations)
        return joint_foot_points(self.spans, control_points, points, curve, low, high, *search)

    def refine(self, control_points: Array, points: Array, curve: IntArray, u: Array) -> FootPoints:
        """Foot points of points (m, 2), each on its own curve (m,), near the parameters (m,) they had."""
        s = self.boundaries[0].settings
        low, high = u - s.refine_room, self.believed(curve, u + s.refine_room)
        return refine_joint_foot_points(
            self.spans, control_points, points, curve, u, low, high, s.refine_iterations
        )

    def cut_off(self, curve: IntArray, foot: FootPoints) -> bool:
        """Whether the foot point of any row, on curve (m,), is where an open curve is inactive."""
        return not self.spans.periodic and bool((foot.u <= self.cut[curve]).any())


def side_by_side(boundaries: Mapping[int, Boundary], active: Mapping[int, IntArray]) -> Curves:
    """Some boundaries, at least one, with the control points (k,) of each that are active."""
    all_of, active_of = tuple(boundaries.values()), tuple(active[label] for label in boundaries)
    sizes = [boundary.size for boundary in all_of]
    offsets = np.cumsum([0, *sizes[:-1]])
    first = [0 if b.periodic else int(indices[0]) for b, indices in zip(all_of, active_of, strict=True)]
    tables = [b.tables.tail(start) if start else b.tables for b, start in zip(all_of, first, strict=True)]
    return Curves(
        boundaries=all_of,
        labels=np.array(list(boundaries), np.intp),
        active=active_of,
        tables=tuple(boundary.tables for boundary in all_of),
        spans=lay_out(tables, [int(o) + f for o, f in zip(offsets, first, strict=True)], sizes),
        cut=np.array([t.low if start else -np.inf for t, start in zip(tables, first, strict=True)]),
        keys=np.concatenate([control_keys(label, b.numbers) for label, b in boundaries.items()]),
        offsets=offsets,
    )
