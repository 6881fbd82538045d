"""Detections beside their curves in numpy: their places, their gate, and their rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.graph.rows import Parts, among

from .footpoint import refined, searched
from .measuring import detection_rows, shifted, to_map
from .spans import Spans


def placed(
    rows: IntArray,
    cycles: IntArray,
    measured: Array,
    twists: Array,
    poses: Array,
    first_cycle: int,
    sensor: Array,
) -> Array:
    """Return `DetectionColumns.points_map` of some rows, by the poses (P, 3) from `first_cycle` on."""
    points = _corrected(measured[rows], twists[rows], sensor)
    return to_map(points, poses[cycles[rows] - first_cycle])


def _corrected(measured: Array, twists: Array, sensor: Array) -> Array:
    return shifted(measured, twists, sensor) if len(sensor) else measured


def open_rows(
    labels: IntArray, since: IntArray, label: IntArray, boundary: IntArray, used: BoolArray, unknown: int
) -> tuple[IntArray, IntArray]:
    """Return `DetectionTable.open_to` for a table with these columns."""
    colourless, rows = label == unknown, []
    for own, first in zip(labels, since, strict=True):
        is_open = np.where(used, colourless & (boundary != own), colourless | (label == own))
        rows.append(first + np.flatnonzero(is_open[first:]))
    curve = np.repeat(np.arange(len(rows)), [len(of_label) for of_label in rows])
    return np.concatenate([np.zeros(0, np.intp), *rows]), curve


def in_view(
    spans: Spans,
    control_points: Array,
    trusted: Array,
    points: Array,
    curve: IntArray,
    slot: IntArray,
    pose_u: list[Array],
    pose: Array,
    rooms: tuple[float, float, float, float],
    step: float,
    iterations: int,
) -> tuple[tuple[Any, ...], list[tuple[float, float, float]]]:
    """Return the foot points of detections at points (m, 2), each on its curve (m,) beside its pose (m,)."""
    known = np.array(pose_u)
    known = np.concatenate([known, known[:, -1:]], axis=1)
    numbers = np.append(curve, np.arange(len(known)))
    seen_from = np.append(known[curve, slot], known[:, -1])
    behind, ahead = (np.repeat(room, [len(points), len(known)]) for room in (rooms[::2], rooms[1::2]))
    stretch = seen_from - behind, np.minimum(seen_from + ahead, trusted[numbers])
    both = np.concatenate([points, np.tile(pose[:2], (len(known), 1))])
    foot = FootPoints(*searched(spans, control_points, both, numbers, *stretch, step, iterations))
    beside = foot.where(slice(len(points), None))
    along = beside.tangent_unit @ np.array([np.cos(pose[2]), np.sin(pose[2])])
    newest = zip(beside.u.tolist(), along.tolist(), beside.distance.tolist(), strict=True)
    of_rows = foot.where(slice(len(points)))
    return tuple(vars(of_rows).values()), list(newest)


def gated(
    rows: IntArray,
    cycle: IntArray,
    label: IntArray,
    covariances: Array,
    poses: Array,
    first_cycle: int,
    foot: tuple[Array, Array, BoolArray],
    limits: tuple[float, float, float, float, float, int],
) -> tuple[Array, BoolArray, BoolArray]:
    """Return the variance (m,) of each detection by row, whether its curve accepts it, or else may do so."""
    (normals, distance, interior), own = foot, poses[cycle[rows] - first_cycle]
    sigma_model, floor, rough, chi, chi_unknown, unknown = limits
    variance = sigma_across(normals, covariances[rows], own, sigma_model) ** 2 + floor**2
    near, colourless = interior & (np.abs(distance) < rough), label[rows] == unknown
    accepted = near & (distance**2 < np.where(colourless, chi_unknown, chi) ** 2 * variance)
    return variance, accepted, near & ~accepted & ~colourless


def curve_rows(
    spans: Spans,
    curves: tuple[Array, IntArray, IntArray, Array, Array],
    table: tuple[Any, ...],
    cycles: IntArray,
    poses: Array,
    first_cycle: int,
    sensor: Array,
    limits: tuple[float, int, float, float],
    names: tuple[int, int],
) -> tuple[IntArray, Array, bool, Parts]:
    """Return detections by row, their refined parameters (m,), and the parts of `CurveMap.rows`."""
    control_points, labels, control_keys, trusted, active_from = curves
    room, iterations, sigma_model, huber = limits
    rows = np.flatnonzero(table[2] & among(table[0], cycles))
    cycle, boundary, _, u, measured, twist, covariance = (column[rows] for column in table)
    curve, own = labels.searchsorted(boundary), poses[cycle - first_cycle]
    points = to_map(_corrected(measured, twist, sensor), own)
    stretch = u, u - room, np.minimum(u + room, trusted[curve])
    foot = FootPoints(*refined(spans, control_points, points, curve, *stretch, iterations))
    known = points, covariance, own, foot.normal_unit, foot.distance, foot.basis
    residual, sigma, jacobian = detection_rows(*known, measured, twist, sensor, sigma_model)
    weight = np.sqrt(huber_weights(residual / sigma, huber)) * (foot.interior / sigma)
    measuring = np.array(names) + np.outer(cycle, [1, 0])
    keys = np.concatenate([measuring[:, : 2 if len(sensor) else 1], control_keys[foot.columns]], axis=1)
    reached = not spans.periodic and bool((foot.u <= active_from[curve]).any())
    return rows, foot.u, reached, (keys, jacobian * weight[:, None], residual * weight, cycle)


def along_and_across(points: Array, path: Array, stations: Array) -> tuple[Array, Array]:
    """Return the station (m,) and signed distance (m,), left positive, of points (m, 2) beside a polyline."""
    (x, y), (ex, ey) = path[:-1].T, np.diff(path, axis=0).T
    length2 = np.maximum(ex**2 + ey**2, np.finfo(float).tiny)
    dx, dy = points[:, :1] - x, points[:, 1:] - y
    share = np.clip((dx * ex + dy * ey) / length2, 0.0, 1.0)
    distance2 = (dx - share * ex) ** 2 + (dy - share * ey) ** 2
    best = distance2.argmin(axis=1)
    rows = np.arange(len(points))
    ex, ey, dx, dy = ex[best], ey[best], dx[rows, best], dy[rows, best]
    overshoot = np.where(best == len(length2) - 1, (dx * ex + dy * ey) / length2[best] - 1.0, 0.0)
    along = np.where(overshoot > 0.0, 1.0 + overshoot, share[rows, best])
    cross = ex * dy - ey * dx
    nearest = np.sign(cross) * np.sqrt(distance2[rows, best])
    lateral = np.where(overshoot > 0.0, cross / np.sqrt(length2[best]), nearest)
    return stations[best] + along * (stations[best + 1] - stations[best]), lateral
