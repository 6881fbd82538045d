"""Places where the path driven crosses a boundary of the map: the map is wrong there.

All limits are relative to the median distance of the boundaries from the drive, so they fit scenes of any
size.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.labels import LEFT, NAMES

from .boundary import crossing_segments
from .bspline import BSpline, cross, dot

COARSE: Final = 8  # number of samples for each control point, for the median distance
CROSSING_STEP: Final = 0.15  # distance of the samples of curves and drive
DRIVE_GAP: Final = 5.0  # longest step of a drive between two poses; beyond, the path between is unknown
CROSSED_DEPTH: Final = 0.35  # least depth beyond a boundary that counts as across: drivers cut corners
ROADSIDE: Final = 2.5  # largest distance of a road's boundary from the drive along it
PASSES_APART: Final = 15.0  # least length driven between two passes of one place
ALONG_COSINE: Final = 0.9  # least cosine of the angle between a boundary and the drive along it
PARTED_COSINE: Final = 0.87  # largest cosine of the angle between two parts of the drive that cross
MEETING_REACH: Final = 7.0  # distance from such a crossing within which boundaries may be crossed
MEETING_DISTANCE: Final = 0.5  # largest distance of two parts of the drive that cross
MEETING_SAMPLES: Final = 500  # largest number of samples of the drive tested there
ON_ROAD_SHARE: Final = 0.5  # least share of a stretch on the road that has another boundary beside it


class Crossing(NamedTuple):
    """A place where the vehicle crossed a boundary of the map."""

    label: int
    place: Array  # (2,) in m, map frame
    driven: float  # length of the drive up to this place (m)


def crossings_told(found: list[Crossing]) -> str:
    """Describe where the vehicle crossed boundaries; empty without a crossing."""
    if not found:
        return ""
    first, more = found[0], f", and at {len(found) - 1} more" if len(found) > 1 else ""
    x, y = first.place.tolist()
    return (
        f"the {NAMES[first.label]} boundary lies across the driven path at x = {x:.3g} m, y = {y:.3g} m, "
        f"after {first.driven:.3g} m{more}"
    )


def crossed_boundaries(
    curves: Mapping[int, BSpline], path: Array, known: BoolArray | None = None
) -> list[Crossing]:
    """Find where a path driven (n, 2) crosses the boundaries of the map, in driving order.

    Poses that are not `known` (n,), as of a lost vehicle, are a gap. Not counted: a corner that is
    cut; the place where the vehicle enters or finally leaves the road; a place where the path crosses itself,
    since roads that cross have boundaries there; and the boundary of another lap of an open map, whose laps
    may lie beside each other.
    """
    known = np.ones(len(path), bool) if known is None else known
    before = np.cumsum(~known)[known]  # number of unknown poses before each known one
    path = path[known]
    moves = (np.diff(path, axis=0) != 0.0).any(axis=1)
    kept = np.append(moves[:1], moves)
    path, before = path[kept], before[kept]
    if len(path) < 2 or not curves:
        return []
    coarse = [curve.evaluate(np.linspace(*curve.domain, COARSE * curve.size)) for curve in curves.values()]
    aside = float(np.median([KDTree(points).query(path)[0] for points in coarse]))
    drive = _drive(path, np.diff(before) > 0, aside)
    lines = {label: _line(curve, CROSSING_STEP * aside) for label, curve in curves.items()}
    found = [one for label in lines for one in _crossings(label, lines, drive, aside)]
    return sorted(found, key=lambda one: one.driven)


@dataclass(frozen=True, eq=False)
class _Way:
    """Samples of a curve or of a drive, in driving order."""

    points: Array  # (n, 2) in m, map frame
    heading: Array  # (n, 2) unit vectors
    length: Array  # (n,) length up to each sample (m)
    pieces: list[slice]  # stretches without a gap
    closed: bool = False


def _line(curve: BSpline, step: float) -> _Way:
    u = np.linspace(*curve.domain, max(int(curve.length() / step), 2) + 1)
    points = curve.evaluate(u)
    return _Way(points, curve.tangent_unit(u), path_lengths(points), [slice(0, len(u))], curve.periodic)


def _drive(path: Array, unknown: BoolArray, aside: float) -> _Way:
    """Sample a path (n, 2); the way to the next pose may be `unknown` (n - 1,)."""
    length = path_lengths(path)
    missing = np.flatnonzero(unknown | (np.diff(length) > DRIVE_GAP * aside)) + 1
    known = [rows for rows in np.split(length, missing) if len(rows) > 1]
    at = [np.linspace(rows[0], rows[-1], int(np.ptp(rows) / (CROSSING_STEP * aside)) + 2) for rows in known]
    ends = np.cumsum([0, *map(len, at)]).tolist()
    where = np.concatenate([np.zeros(0), *at])
    points = np.column_stack([np.interp(where, length, column) for column in path.T])
    pieces = [slice(*of) for of in pairwise(ends)]
    step = np.concatenate([np.zeros((0, 2)), *(np.gradient(points[piece], axis=0) for piece in pieces)])
    return _Way(points, step / np.maximum(np.hypot(*step.T), np.finfo(float).tiny)[:, None], where, pieces)


def _crossings(label: int, lines: Mapping[int, _Way], drive: _Way, aside: float) -> list[Crossing]:
    """Find the crossings of one boundary."""
    line, found = lines[label], []
    distance, foot = map(np.asarray, KDTree(line.points).query(drive.points))
    inside = (foot > 0) & (foot < len(line.points) - 1)
    depth = CROSSED_DEPTH * aside
    deep = (line.closed | inside) & (distance > depth)  # no sample is beside a curve beyond its end
    reaches = np.asarray(KDTree(drive.points).query(line.points)[0]) > depth
    for piece in drive.pieces:
        rows, at, share = crossing_segments(drive.points[piece], line.points)
        order = np.argsort(rows + share)
        rows, at, share = rows[order] + piece.start, at[order], share[order]
        between = rows.searchsorted(np.arange(piece.start, piece.stop))[deep[piece]]
        loops = [k for k, ends in enumerate(pairwise(at), 1) if reaches[_between(*ends, line)].any()]
        changes = _changes({*between.tolist(), *loops})
        ends = [piece.start, *rows[changes].tolist(), piece.stop]
        for k, change in enumerate(changes):
            row, on_line = int(rows[change]), int(at[change])
            step = drive.points[row + 1] - drive.points[row]
            one = Crossing(label, drive.points[row] + share[change] * step, float(drive.length[row]))
            leaves = (cross(line.heading[on_line], step) > 0.0) == (label == LEFT)
            beyond = slice(row + 1, ends[k + 2]) if leaves else slice(ends[k], row + 1)
            is_last = k == (len(changes) - 1 if leaves else 0)
            allowed = is_last and _is_off_road(label, lines, drive, beyond, aside)
            allowed |= _meets_itself(one.place, drive, aside)
            allowed |= not line.closed and _is_of_another_lap(one, line.heading[on_line], drive, aside)
            if not allowed:
                found.append(one)
    return found


def _between(first: int, second: int, line: _Way) -> IntArray:
    """Samples of a curve between two of its samples, the shorter way around a closed one."""
    low, high = sorted((first, second))
    rows = np.arange(low + 1, high + 1)
    around = np.append(np.arange(high + 1, len(line.points)), np.arange(low + 1))
    return around if line.closed and len(around) < len(rows) else rows


def _changes(deep: set[int]) -> list[int]:
    """Return the crossings after which the vehicle is on the other side of a curve.

    `deep` are the parts of the drive, by the number of crossings before each, in which drive and curve move
    apart. From one to the next, an odd number of crossings changes the side.
    """
    return [a for a, b in pairwise(sorted(deep)) if (b - a) % 2]


def _is_off_road(label: int, lines: Mapping[int, _Way], drive: _Way, beyond: slice, aside: float) -> bool:
    """Whether the drive beyond a boundary is along no other boundary, as before it enters the road."""
    others = [_beside(other, line, drive, beyond, aside) for other, line in lines.items() if other != label]
    return bool(others) and max(float(one.mean()) for one in others) < ON_ROAD_SHARE


def _beside(label: int, line: _Way, drive: _Way, rows: slice, aside: float) -> BoolArray:
    """Whether a boundary lies beside each sample (m,) of a stretch of the drive, on its own side."""
    distance, foot = map(np.asarray, KDTree(line.points).query(drive.points[rows]))
    heading, off = drive.heading[rows], line.points[foot] - drive.points[rows]
    on_side = (cross(heading, off) > 0.0) == (label == LEFT)
    along = np.abs(dot(heading, line.heading[foot])) > ALONG_COSINE
    return np.asarray(on_side & along & (distance < ROADSIDE * aside))


def _meets_itself(place: Array, drive: _Way, aside: float) -> bool:
    """Whether the drive crosses itself near a place (2,)."""
    near = np.flatnonzero(np.hypot(*(drive.points - place).T) < MEETING_REACH * aside)
    near = near[:: 1 + len(near) // MEETING_SAMPLES]
    points, heading, length = drive.points[near], drive.heading[near], drive.length[near]
    parted = np.abs(heading @ heading.T) < PARTED_COSINE
    parted &= np.abs(length[:, None] - length) > PASSES_APART * aside
    offset = points[:, None] - points
    return bool((parted & (np.hypot(offset[..., 0], offset[..., 1]) < MEETING_DISTANCE * aside)).any())


def _is_of_another_lap(one: Crossing, heading: Array, drive: _Way, aside: float) -> bool:
    """Whether a boundary with a heading (2,) lies beside another part of the drive, on its own side."""
    off = one.place - drive.points
    across = cross(drive.heading, off) * (1.0 if one.label == LEFT else -1.0)
    beside = (across > CROSSED_DEPTH * aside) & (across < ROADSIDE * aside)
    beside &= np.abs(dot(drive.heading, off)) < CROSSING_STEP * aside
    beside &= np.abs(drive.heading @ heading) > ALONG_COSINE
    return bool((beside & (np.abs(drive.length - one.driven) > PASSES_APART * aside)).any())
