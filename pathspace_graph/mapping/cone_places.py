"""The places of the cones along closed curves, and which detections are of which place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import PlaceRows, along_from_place
from pathspace_graph.settings.mapper import PlaceSettings

from .curves import Curves
from .detections import NOWHERE, DetectionTable

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ConePlaces:
    """Holds one parameter for each cone of the curves, curve by curve."""

    u: Array
    """These are the parameters (k,) in m, inside each curve's domain."""
    starts: IntArray
    """The places of curve c are those from `starts[c]` to `starts[c + 1]`."""
    lengths: Array
    """These are the lengths (c,) of the curves in units of their parameters (m), infinite if open."""
    keys: IntArray
    """Each place (k, degree + 1) is on the span of these control points."""
    columns: IntArray
    """These are the same control points as rows of `State.map_points`."""
    basis: Array
    """These coefficients (k, degree + 1) of its control points give the position of each place."""
    basis_slope: Array
    """These coefficients (k, degree + 1) give the derivative of the curve at each place."""

    def nearest(self, curve: IntArray, u: Array, room: float, apart: float) -> IntArray:
        """Returns the place (m,) next to each parameter (m,) of a curve (m,), or NOWHERE.

        A place is chosen if it is nearer than `room` (m), and if the second nearest one is farther away than
        `apart` times its distance.
        """
        found = np.full(len(u), NOWHERE)
        for c, length in enumerate(self.lengths.tolist()):
            rows, (begin, end) = np.flatnonzero(curve == c), self.starts[c : c + 2].tolist()
            if end - begin < 2 or len(rows) == 0:
                continue
            offset = np.abs(u[rows, None] - self.u[begin:end])
            if np.isfinite(length):
                offset = np.mod(offset, length)
                offset = np.minimum(offset, length - offset)
            nearest, second = np.partition(offset, 1, axis=1)[:, :2].T
            chosen = (nearest < room) & (second > apart * nearest)
            found[rows] = np.where(chosen, begin + offset.argmin(axis=1), NOWHERE)
        return found

    def associate(
        self, detections: DetectionTable, curves: Curves, settings: PlaceSettings, since: int = 0
    ) -> None:
        """Associates the detections in use, from the row `since` on, with the places next to their feet."""
        rows = since + np.flatnonzero(detections.used[since:])
        curve = curves.number(detections.boundary[rows])
        place = self.nearest(curve, detections.u[rows], settings.room, settings.apart)
        detections.put(rows, place)

    def along(self, place: IntArray, map_points: Array, points: Array, poses: Array) -> PlaceRows:
        """Returns how far detections at points (m, 2), from poses (m, 3), lie past their places (m,)."""
        control_points = map_points[self.columns[place]]
        return along_from_place(points, poses, control_points, self.basis[place], self.basis_slope[place])


def lay_out_places(curves: Curves, u: Mapping[int, Array]) -> ConePlaces:
    """Returns the places at parameters (k,) of each curve, by label."""
    parameters, columns, bases, at = [], [], [], 0
    for label, boundary in zip(curves.labels.tolist(), curves.boundaries, strict=True):
        own = boundary.tables.inside(u[label])
        basis, span = boundary.tables.evaluate(own, 1)
        parameters.append(own)
        columns.append(at + boundary.columns(span))
        bases.append(basis)
        at += boundary.size
    (basis, slope), rows = np.concatenate(bases, axis=1), np.concatenate(columns)
    return ConePlaces(
        u=np.concatenate(parameters),
        starts=np.cumsum([0, *map(len, parameters)]),
        lengths=np.array([b.length if b.periodic else np.inf for b in curves.boundaries]),
        keys=curves.keys[rows],
        columns=rows,
        basis=basis,
        basis_slope=slope,
    )
