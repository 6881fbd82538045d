"""Track files of other simulators and of surveys: PacSim and fssim YAML, EUFS and TUM CSV."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import scipy  # which imports its modules when they are used
from msgspec import Meta, Struct, field

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.io.parsing import MAX_COORDINATE, Table, is_number, parse_yaml, read_text, shown, typed
from pathspace_graph.io.tables import read_table
from pathspace_graph.labels import BIG_ORANGE, ORANGE, UNKNOWN, label_from_name

from .track import Track, arc_lengths, direction, resample, ring, unit

MAX_TRACK_BYTES: Final = 2**23
MAX_TRACK_LENGTH: Final = 3e4  # m; rows are matched in a time that grows with its square
MAX_TRACK_WIDTH: Final = 100.0  # m, from the middle of a track to a boundary
MAX_CONES: Final = 6_000  # of each boundary of a track
MIN_CONES: Final = 3  # least number of cones of a boundary
REPEAT_DISTANCE: Final = 0.01  # distance below which a cone of an ordered row is the one before again (m)
WIDTH_STEP: Final = 0.5  # distance of samples of a circuit (m)
TUM_COLUMNS: Final = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")  # centre line and widths
EUFS_OTHER: Final = ("orange", "big_orange", "unknown", "unknown_color")
"""EUFS tags of cones of no boundary; further tags, such as midpoint, are no cones."""
EUFS_COLUMNS: Final = ("tag", "x", "y", "direction", "x_variance", "y_variance", "xy_covariance")
"""Columns of an EUFS file in their order, which FSDS writes without a header."""
KNOWN: Final = (
    "expected a track file of a known kind: PacSim YAML (track: left, right, start), "
    "fssim YAML (cones_left, cones_right, starting_pose_front_wing), "
    "EUFS and FSDS CSV (tag,x,y,direction), TUM CSV (# x_m,y_m,w_tr_right_m,w_tr_left_m)"
)


def read_track(path: Path | str) -> Track:
    """Read the track in a file, its cones in driving order; an InputError names the row or key."""
    path, track = Path(path), None
    if not path.is_file():
        raise InputError(path, f"expected a track file, found {'a folder' if path.is_dir() else 'none'}")
    if path.suffix.lower() in (".yaml", ".yml"):
        content = parse_yaml(read_text(path, "YAML", MAX_TRACK_BYTES), path)
        if isinstance(content, dict) and isinstance(content.get("track"), dict):
            track = _pacsim(path, content["track"])
        elif isinstance(content, dict) and not {"cones_left", "cones_right"}.isdisjoint(content):
            track = _fssim(path, content)
    elif path.suffix.lower() == ".csv":
        text = read_text(path, most=MAX_TRACK_BYTES)
        first = next(filter(str.strip, text.split("\n")), "").strip()
        tag, *numbers = (part.strip(' "') for part in first.split(","))
        is_cone = (
            tag.lower() in {"blue", "yellow", *EUFS_OTHER, "car_start", "midpoint"}
            and len(numbers) >= 2
            and all(map(is_number, numbers[:2]))
        )
        header = EUFS_COLUMNS[: 1 + len(numbers)] if is_cone else ()  # where the file has none
        table = read_table(path, comment="#", header=header)
        if not {"x_m", "y_m"}.isdisjoint(table.columns):
            track = _tum(table)
        elif "tag" in table.columns:
            track = _eufs(table)
        else:
            raise InputError(path, f"{KNOWN}, found {shown(first)}", 1)
    if track is None:
        raise InputError(path, KNOWN)
    _check(path, track)
    return track


def _check(path: Path, track: Track) -> None:
    for name, row in (("left", track.left), ("right", track.right)):
        _check_size(path, row, f"the {name} boundary")
        if len(row) < MIN_CONES:
            expected = f"expected at least {MIN_CONES} cones of the {name} boundary"
            raise InputError(path, f"{expected}, found {len(row)}")
    line = track.centre_line
    least, usual = line.clearance.min(), np.median(line.clearance)
    if least < 0.2 * usual:
        found = f"found their middle {least:.2f} m from a cone where the road is {2.0 * usual:.1f} m wide"
        raise InputError(path, f"expected two rows with a road between them, {found}")
    s = np.arange(0.0, line.length, WIDTH_STEP)
    distances = np.linalg.norm(line.points(s) - track.start[:2], axis=1)
    nearest = int(np.argmin(distances))
    if distances[nearest] > 10.0:
        found = f"found it {distances[nearest]:.1f} m from its middle"
        raise InputError(path, f"expected the start on the track, {found}")
    if line.tangents(s[nearest : nearest + 1])[0] @ direction(track.start[2]) <= 0:
        expected = "expected the boundaries in driving order"
        raise InputError(path, f"{expected}, found them against the start's heading")


def _check_size(path: Path, row: Array, name: str) -> None:
    length = float(arc_lengths(row)[-1]) if len(row) else 0.0
    if len(row) > MAX_CONES or length > MAX_TRACK_LENGTH:
        expected = f"expected at most {MAX_CONES} cones over {MAX_TRACK_LENGTH:g} m as {name}"
        raise InputError(path, f"{expected}, found {len(row)} over {length:g} m")


# --- YAML: PacSim and fssim --------------------------------------------------------------------------------

Number = Annotated[float, Meta(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Point = Annotated[list[Number], Meta(min_length=2)]
Angles = Annotated[list[Number], Meta(min_length=3)]  # also a place with a heading


class _Cone(Struct):
    position: Point
    kind: str | float | bool | None = field(name="class", default="")


Cones = Annotated[list[_Cone], Meta(max_length=MAX_CONES)] | None
Points = Annotated[list[Point], Meta(max_length=MAX_CONES)] | None


class _Start(Struct):
    position: Point
    orientation: Angles


class _Pacsim(Struct):
    closed: bool = field(name="lanesFirstWithLastConnected")
    start: _Start
    left: Cones
    right: Cones
    unknown: Cones = None


class _Fssim(Struct):
    cones_left: Points
    cones_right: Points
    starting_pose_front_wing: Angles
    cones_orange: Points = None
    cones_orange_big: Points = None


def _pacsim(path: Path, content: Any) -> Track:
    data = typed(content, _Pacsim, path, "track", strict=False)
    lists = [cones or [] for cones in (data.unknown, data.left, data.right)]
    points = _points([cone.position for cones in lists for cone in cones])
    kinds = np.array([str(cone.kind) for cones in lists for cone in cones], str)
    row = np.repeat(np.arange(3), [*map(len, lists)])  # of which list: of no boundary, left or right
    orange = np.char.find(kinds, "orange") >= 0  # cones of no boundary
    labels = np.where(np.char.find(kinds, "big") >= 0, BIG_ORANGE, ORANGE)
    labels = np.where(orange, labels, UNKNOWN)
    left, right = (_without_repeats(points[(row == k) & ~orange], data.closed) for k in (1, 2))
    start = np.array([*data.start.position[:2], data.start.orientation[2]])
    no_boundary = orange | (row == 0)
    return Track(left, right, points[no_boundary], data.closed, start, path.stem, labels[no_boundary])


def _fssim(path: Path, content: Any) -> Track:
    data = typed(content, _Fssim, path, strict=False)
    left, right = (_without_repeats(_points(row), closed=True) for row in (data.cones_left, data.cones_right))
    small, big = _points(data.cones_orange), _points(data.cones_orange_big)
    start = np.array(data.starting_pose_front_wing[:3])
    kinds = np.repeat([ORANGE, BIG_ORANGE], [len(small), len(big)])
    return Track(left, right, np.concatenate([small, big]), True, start, path.stem, kinds)


def _points(rows: Points) -> Array:
    return np.array([row[:2] for row in rows or ()], float).reshape(-1, 2)


def _without_repeats(row: Array, closed: bool) -> Array:
    """Drop each cone of a row (n, 2) at the place of the one before, also around a closed track."""
    if not len(row):
        return row
    row = row[np.append(True, np.linalg.norm(np.diff(row, axis=0), axis=1) > REPEAT_DISTANCE)]
    if closed and len(row) > 1 and np.linalg.norm(row[-1] - row[0]) <= REPEAT_DISTANCE:
        row = row[:-1]
    return row


# --- CSV: EUFS and TUM -------------------------------------------------------------------------------------


def _eufs(table: Table) -> Track:
    path, points = table.file, table.stack(("x", "y"))
    tags = np.array([tag.strip().lower() for tag in table.columns["tag"]])
    if len(points) > 2 * MAX_CONES:
        raise InputError(path, f"expected at most {2 * MAX_CONES} cones, found {len(points)}")
    left, right, *others = (
        _without_duplicates(points[tags == tag]) for tag in ("blue", "yellow", *EUFS_OTHER)
    )
    for tag, cones in (("blue", left), ("yellow", right)):
        if len(cones) < MIN_CONES:
            raise InputError(path, f"expected at least {MIN_CONES} {tag} cones, found {len(cones)}")
    rows = np.flatnonzero(tags == "car_start")[:1]
    if len(rows):
        text = table.columns["direction"][rows[0]].strip() if "direction" in table.columns else ""
        if text and not (is_number(text) and math.isfinite(float(text))):
            expected = "expected the heading of car_start in column 'direction'"
            raise InputError(path, f"{expected}, found '{text}'", int(table.rows[rows[0]]))
        start = np.append(points[rows[0]], float(text or 0.0))
    else:  # between the first blue cone and its opposite
        opposite = right[np.argmin(np.linalg.norm(right - left[0], axis=1))]
        across = left[0] - opposite
        start = np.append((left[0] + opposite) / 2, math.atan2(-across[0], across[1]))
    order = driving_order(left, right, points[tags == "big_orange"], start)
    count, placed = len(left) + len(right), 0 if order is None else len(order.left) + len(order.right)
    if order is None or placed < 0.8 * count:  # the others are strays
        found = f"found {count - placed} of {count} cones off it"
        raise InputError(path, f"expected one lane from the start on, {found}")
    others += [np.delete(left, order.left, axis=0), np.delete(right, order.right, axis=0)]
    kinds = [*map(label_from_name, EUFS_OTHER), UNKNOWN, UNKNOWN]
    labels = np.repeat(kinds, [len(cones) for cones in others])
    left, right = left[order.left], right[order.right]
    return Track(left, right, np.concatenate(others), order.closed, start, path.stem, labels)


def _without_duplicates(cones: Array) -> Array:
    """Drop cones (n, 2) within 0.3 m of one kept before, which is the same cone surveyed twice."""
    kept, count = np.empty_like(cones), 0
    for cone in cones:
        if (np.linalg.norm(kept[:count] - cone, axis=1) >= 0.3).all():
            kept[count] = cone
            count += 1
    return kept[:count]


def _tum(table: Table) -> Track:
    circuit = table.stack(TUM_COLUMNS)
    widths = circuit[:, 2:]
    table.require(np.asarray(widths.min(axis=1) > 0), "expected widths above 0")
    widest = f"expected widths of at most {MAX_TRACK_WIDTH:g} m"
    table.require(np.asarray(widths.max(axis=1) <= MAX_TRACK_WIDTH), widest)
    _check_size(table.file, circuit[:, :2], "the middle of the track")
    moved = np.asarray(np.diff(arc_lengths(circuit[:, :2])) > REPEAT_DISTANCE)
    table.require(np.append(True, moved)[: len(circuit)], "expected a point other than the one before")
    circuit = circuit[: len(_without_repeats(circuit[:, :2], closed=True))]
    if len(circuit) < MIN_CONES:
        raise InputError(table.file, f"expected at least {MIN_CONES} points, found {len(circuit)}")
    circuit = ring(circuit)
    knots = arc_lengths(circuit[:, :2])
    spline = scipy.interpolate.CubicSpline(knots, circuit[:, :2], bc_type="periodic")
    s = np.linspace(0.0, knots[-1], math.ceil(knots[-1] / WIDTH_STEP), endpoint=False)
    points, tangents = np.asarray(spline(s)), unit(np.asarray(spline(s, 1)))
    edges = (
        points + side * left_of(tangents) * np.interp(s, knots, circuit[:, k])[:, None]
        for side, k in ((-1.0, 2), (1.0, 3))
    )
    right, left = (resample(edge, 5.0, closed=True)[0] for edge in edges)
    start = np.append(circuit[0, :2], math.atan2(tangents[0, 1], tangents[0, 0]))
    return Track(left, right, np.zeros((0, 2)), True, start, table.file.stem)


# --- driving order of cones: a walk along the lane, triangle by triangle ----------------------------------

RUNG_MAX: Final = 12.0  # largest distance of a left and a right cone of one lane (m)

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
    # gate cones stand in for missing ones near the start
    near, side = np.linalg.norm(step, axis=1) < 12.0, step @ left_of(direction(start[2]))
    gate_left, gate_right = gate[near & (side > 0)], gate[near & (side <= 0)]
    points = np.vstack([left, gate_left, right, gate_right])
    split, right_end = len(left) + len(gate_left), len(left) + len(gate_left) + len(right)
    apexes: dict[Rung, list[int]] = defaultdict(list)
    with suppress(scipy.spatial.QhullError):
        for i, j, k in map(sorted, scipy.spatial.Delaunay(points).simplices.tolist()):
            apexes[i, j].append(k)
            apexes[i, k].append(j)
            apexes[j, k].append(i)
    first = _first_rung(points, split, apexes, start)
    if first is None:
        return None
    rungs, closed = _walk(points, split, apexes, first, forward=True)
    if not closed:
        rungs = _walk(points, split, apexes, first, forward=False)[0][:0:-1] + rungs
    lefts = _row(left, [i for i, _ in rungs if i < len(left)], closed)
    rights = _row(right, [j - split for _, j in rungs if j < right_end], closed)
    return DrivingOrder(lefts, rights, closed)


def _first_rung(points: Array, split: int, apexes: Apexes, start: Array) -> Rung | None:
    """Nearest rung across the start's heading, its left cone on the left."""
    rungs = np.array([edge for edge in apexes if edge[0] < split <= edge[1]], dtype=int).reshape(-1, 2)
    step, heading = points[rungs] - start[:2], direction(start[2])
    along, across = step @ heading, step @ left_of(heading)
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
    while True:
        across, steps = points[i] - points[j], points[apexes[i, j]] - points[j]
        is_ahead = (across[0] * steps[:, 1] - across[1] * steps[:, 0] < 0) == forward
        if not is_ahead.any():
            return list(rungs), False
        apex = apexes[i, j][int(is_ahead.argmax())]
        i, j = rung = (apex, j) if apex < split else (i, apex)
        if rung in rungs or np.linalg.norm(points[i] - points[j]) > RUNG_MAX:
            return list(rungs), rung == first
        rungs[rung] = None


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
        if detour[place] < 5.0:  # m that the row grows
            row.insert(place + 1, missed)
    return np.array(row, dtype=int)
