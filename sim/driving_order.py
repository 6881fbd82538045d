"""The driving order of unordered cones: a walk along the lane, triangle by triangle."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from .curves import direction, left_normals, ring

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]

RUNG_MAX: Final = 12.0
"""A left and a right cone farther apart than this (m) are not the two sides of one lane."""
GATE_REACH: Final = 12.0
"""Gate cones within this distance of the start (m) stand in for the boundary cones missing there."""
INSERTION_DETOUR: Final = 5.0
"""A cone missed by the walk, as at an outer corner, joins its row if the row grows by less than this (m)."""

Rung = tuple[int, int]
Apexes = Mapping[Rung, Sequence[int]]


@dataclass(frozen=True)
class DrivingOrder:
    """Says which cones make each boundary, in driving order."""

    left: IntArray
    """Indices into the left cones (n,)."""
    right: IntArray
    """Indices into the right cones (m,)."""
    closed: bool
    """The walk came back to where it began where this is true."""


def driving_order(
    left: FloatArray, right: FloatArray, gate: FloatArray, start: FloatArray
) -> DrivingOrder | None:
    """Orders cones (n, 2), (m, 2) of both boundaries along the lane that the start [x, y, theta] stands in.

    The Delaunay triangles that join both boundaries are the lane. Each shares with the next a rung from a
    left to a right cone, so walking them gives both rows in order, whatever else is near. Gate cones stand in
    for missing boundary cones, unless the walk goes round only without them. It returns None where no lane is
    found.
    """
    order = _order(left, right, _gate_sides(gate, start), start)
    if order is None or not order.closed:
        none = np.zeros((0, 2))
        without_gate = _order(left, right, (none, none), start)
        if order is None or (without_gate is not None and without_gate.closed):
            return without_gate
    return order


def _order(
    left: FloatArray, right: FloatArray, gate: tuple[FloatArray, FloatArray], start: FloatArray
) -> DrivingOrder | None:
    gate_left, gate_right = gate
    points = np.vstack([left, gate_left, right, gate_right])
    split, right_end = len(left) + len(gate_left), len(left) + len(gate_left) + len(right)
    apexes = _apexes(points)
    first = _first_rung(points, split, apexes, start)
    if first is None:
        return None
    rungs, closed = _walk(points, split, apexes, first, forward=True)
    if not closed:
        rungs = _walk(points, split, apexes, first, forward=False)[0][:0:-1] + rungs
    lefts = _row(left, [i for i, _ in rungs if i < len(left)], closed)
    rights = _row(right, [j - split for _, j in rungs if j < right_end], closed)
    return DrivingOrder(lefts, rights, closed)


def _gate_sides(gate: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the gate cones near the start, left and right of its heading."""
    step = gate - start[:2]
    near = np.linalg.norm(step, axis=1) < GATE_REACH
    side = step @ left_normals(direction(start[2]))
    return gate[near & (side > 0)], gate[near & (side <= 0)]


def _apexes(points: FloatArray) -> Apexes:
    """Returns the third corners of the triangles on each edge (i < j)."""
    apexes: dict[Rung, list[int]] = defaultdict(list)
    try:
        triangles = Delaunay(points).simplices.tolist()
    except QhullError:
        return apexes
    for triangle in triangles:
        i, j, k = sorted(triangle)
        apexes[i, j].append(k)
        apexes[i, k].append(j)
        apexes[j, k].append(i)
    return apexes


def _first_rung(points: FloatArray, split: int, apexes: Apexes, start: FloatArray) -> Rung | None:
    """Returns the nearest rung across the start's heading, its left cone on the left."""
    rungs = np.array([edge for edge in apexes if edge[0] < split <= edge[1]], dtype=int).reshape(-1, 2)
    heading = direction(start[2])
    step = points[rungs] - start[:2]
    along = step @ heading
    across = step @ left_normals(heading)
    crossing = (across[:, 0] > 0) & (across[:, 1] < 0)
    crossing &= np.linalg.norm(step[:, 0] - step[:, 1], axis=1) < RUNG_MAX
    if not crossing.any():
        return None
    rungs, along, across = rungs[crossing], along[crossing], across[crossing]
    at = along[:, 0] + (along[:, 1] - along[:, 0]) * across[:, 0] / (across[:, 0] - across[:, 1])
    i, j = rungs[np.argmin(np.abs(at))]
    return int(i), int(j)


def _walk(
    points: FloatArray, split: int, apexes: Apexes, first: Rung, forward: bool
) -> tuple[list[Rung], bool]:
    """Returns the rungs from the first one on, and whether they come back to it."""
    rungs = [first]
    seen = {first}
    while True:
        apex = _next_apex(points, apexes[rungs[-1]], rungs[-1], forward)
        if apex is None:
            return rungs, False
        i, j = rungs[-1]
        rung = (apex, j) if apex < split else (i, apex)
        if rung == first:
            return rungs, True
        if rung in seen or np.linalg.norm(points[rung[0]] - points[rung[1]]) > RUNG_MAX:
            return rungs, False
        rungs.append(rung)
        seen.add(rung)


def _next_apex(points: FloatArray, apexes: Sequence[int], rung: Rung, forward: bool) -> int | None:
    left, right = points[rung[0]], points[rung[1]]
    for apex in apexes:
        a, b = left - right, points[apex] - right
        ahead = a[0] * b[1] - a[1] * b[0] < 0
        if ahead == forward:
            return apex
    return None


def _row(cones: FloatArray, walked: list[int], closed: bool) -> IntArray:
    """Returns the cones walked, in order and once each, with missed ones inserted where they fit."""
    row = list(dict.fromkeys(walked))
    for missed in sorted(set(range(len(cones))) - set(row)):
        if len(row) < 2:
            break
        polyline = ring(cones[row]) if closed else cones[row]
        to_cone = np.linalg.norm(polyline - cones[missed], axis=1)
        detour = to_cone[:-1] + to_cone[1:] - np.linalg.norm(np.diff(polyline, axis=0), axis=1)
        place = int(np.argmin(detour))
        if detour[place] < INSERTION_DETOUR:
            row.insert(place + 1, missed)
    return np.array(row, dtype=int)
