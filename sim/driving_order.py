"""The driving order of unordered cones: a walk along the lane, triangle by triangle."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # which imports its modules when they are used

from pathspace_graph.factors.arrays import Array, IntArray

from .curves import direction, left_normals, ring

RUNG_MAX: Final = 12.0  # largest distance of a left and a right cone of one lane (m)
GATE_REACH: Final = 12.0  # from the start, within which gate cones stand in for missing ones (m)
INSERTION_DETOUR: Final = 5.0  # growth of a row up to which a missed cone joins it (m)

Rung = tuple[int, int]
Apexes = Mapping[Rung, Sequence[int]]


@dataclass(frozen=True)
class DrivingOrder:
    """Indices of each boundary's cones in driving order, and whether the walk came back to its beginning."""

    left: IntArray
    right: IntArray
    closed: bool


def driving_order(left: Array, right: Array, gate: Array, start: Array) -> DrivingOrder | None:
    """Order cones (n, 2), (m, 2) of both boundaries along the lane that the start [x, y, theta] stands in.

    The lane is the Delaunay triangles that join both boundaries, each of which shares a rung with the next.
    Gate cones stand in for missing ones, unless the walk goes round only without them. None without a lane.
    """
    order = _order(left, right, gate, start)
    if order is not None and order.closed:
        return order
    without_gate = _order(left, right, gate[:0], start)
    return without_gate if order is None or (without_gate is not None and without_gate.closed) else order


def _order(left: Array, right: Array, gate: Array, start: Array) -> DrivingOrder | None:
    step = gate - start[:2]
    near, side = np.linalg.norm(step, axis=1) < GATE_REACH, step @ left_normals(direction(start[2]))
    gate_left, gate_right = gate[near & (side > 0)], gate[near & (side <= 0)]
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


def _apexes(points: Array) -> Apexes:
    apexes: dict[Rung, list[int]] = defaultdict(list)
    try:
        triangles = scipy.spatial.Delaunay(points).simplices.tolist()
    except scipy.spatial.QhullError:
        return apexes
    for i, j, k in map(sorted, triangles):
        apexes[i, j].append(k)
        apexes[i, k].append(j)
        apexes[j, k].append(i)
    return apexes


def _first_rung(points: Array, split: int, apexes: Apexes, start: Array) -> Rung | None:
    """Nearest rung across the start's heading, its left cone on the left."""
    rungs = np.array([edge for edge in apexes if edge[0] < split <= edge[1]], dtype=int).reshape(-1, 2)
    step, heading = points[rungs] - start[:2], direction(start[2])
    along, across = step @ heading, step @ left_normals(heading)
    crossing = (across[:, 0] > 0) & (across[:, 1] < 0)
    crossing &= np.linalg.norm(step[:, 0] - step[:, 1], axis=1) < RUNG_MAX
    if not crossing.any():
        return None
    rungs, along, across = rungs[crossing], along[crossing], across[crossing]
    at = along[:, 0] + (along[:, 1] - along[:, 0]) * across[:, 0] / (across[:, 0] - across[:, 1])
    i, j = rungs[np.argmin(np.abs(at))]
    return int(i), int(j)


def _walk(points: Array, split: int, apexes: Apexes, first: Rung, forward: bool) -> tuple[list[Rung], bool]:
    rungs = {first: None}  # in order, without repeats
    i, j = first
    while (apex := _next_apex(points, apexes[i, j], (i, j), forward)) is not None:
        i, j = rung = (apex, j) if apex < split else (i, apex)
        if rung in rungs or np.linalg.norm(points[i] - points[j]) > RUNG_MAX:
            return list(rungs), rung == first
        rungs[rung] = None
    return list(rungs), False


def _next_apex(points: Array, apexes: Sequence[int], rung: Rung, forward: bool) -> int | None:
    left, right = points[rung[0]], points[rung[1]]
    a = left - right
    for apex in apexes:
        b = points[apex] - right
        if (a[0] * b[1] - a[1] * b[0] < 0) == forward:
            return apex
    return None


def _row(cones: Array, walked: list[int], closed: bool) -> IntArray:
    """Order the walked cones, each once, and insert missed ones where they fit."""
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
