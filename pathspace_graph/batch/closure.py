"""When a loop is worth trying without a registration, and what speaks for or against a closed result.

The drive's own recurrence says when a lap has been driven and more. A batch that begins at odometry then
solves the closed loop. Its result is believed by what the detections of the second lap say, never by
patience.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from .recurrence import Recurrence
from .system import Evaluation

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


def is_worth_trying(recurrence: Recurrence, settings: MapperSettings) -> bool:
    """Returns whether the path driven says that a lap and a good part of another one have been driven.

    It costs about a millisecond with `find_recurrence`, so it can be asked every few metres.
    """
    own = settings.batch.closure
    if not recurrence.recurs:
        return False
    laps = float(recurrence.driven[-1]) / recurrence.lap
    return laps >= own.laps and recurrence.correlation >= own.correlation


@dataclass(frozen=True)
class Evidence:
    """Holds what speaks for or against a closed result."""

    converged: bool
    """This is true where the optimization has found its optimum."""
    closed: bool
    """This is true where both boundaries are closed."""
    used: float
    """This share of all coloured detections lies on the curves."""
    used_again: float
    """This share of the coloured detections after the first lap lies on the curves."""
    misfit: float
    """This is the root mean square distance of those detections from their curves, in sigmas."""
    gap: float
    """This is the longest stretch of a boundary on which no detection lies (m)."""
    overlap: float
    """This length of the boundary that was driven less far has been seen again after the first lap (m)."""
    sigma: float
    """The detections after the first lap hold their drive in place, beside the curves of the first, by this
    standard deviation in the worst direction (m). It is infinite on a straight, whose stretches all agree."""


def evidence(
    at: Evaluation, detections: DetectionTable, settings: MapperSettings, converged: bool
) -> Evidence:
    """Returns the evidence for or against an optimum whose curves are closed."""
    state, both = at.state, len(at.state.boundaries) > 1
    coloured = np.isin(detections.label, list(state.boundaries))
    again = coloured & _after_first_lap(state)[detections.cycle] if both else np.zeros(len(coloured), bool)
    stretches, gaps, squares = [0.0], [0.0], [np.zeros(0)]
    normals, points = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for label, projected in at.projected.items():
        boundary, chosen = state.boundaries[label], again[projected.rows]
        gaps.append(_longest_gap(projected.foot.u, boundary.length))
        stretches.append(_span(state.pose_u[label], boundary.length))
        squares.append(projected.whitened[chosen] ** 2)
        normals.append(projected.foot.normal_unit[chosen])
        points.append(projected.foot.position[chosen])
    return Evidence(
        converged=converged,
        closed=both and all(boundary.periodic for boundary in state.boundaries.values()),
        used=_share(detections.used, coloured),
        used_again=_share(detections.used, again),
        misfit=float(np.sqrt(np.mean(np.concatenate(squares)))) if again.any() else np.inf,
        gap=max(gaps),
        overlap=min(stretches[1:], default=0.0),
        sigma=_sigma(np.concatenate(normals), np.concatenate(points), settings.closing.sigma_reading),
    )


def is_closed_truly(found: Evidence, settings: MapperSettings) -> bool:
    """Returns whether the evidence is for a closed result, in every respect."""
    own = settings.batch.closure
    return (
        found.converged
        and found.closed
        and min(found.used, found.used_again) >= own.used
        and found.misfit <= own.misfit
        and found.gap <= own.gap
        and found.overlap >= own.overlap
        and found.sigma <= own.sigma
    )


def _after_first_lap(state: State) -> BoolArray:
    """Returns which poses (P,) are on a stretch that was driven before, on every boundary."""
    again = np.ones(len(state.poses), bool)
    for label, boundary in state.boundaries.items():
        u = state.pose_u[label]
        again &= u - u[0] >= boundary.length
    return again


def _span(pose_u: Array, length: float) -> float:
    """Returns how much of a closed curve was driven again, at most all of it (m)."""
    return float(np.clip(pose_u[-1] - pose_u[0] - length, 0.0, length))


def _longest_gap(u: Array, length: float) -> float:
    """Returns the longest stretch (m) of a closed curve of a length without any of the parameters u (m,)."""
    if len(u) == 0:
        return length
    places = np.sort(np.mod(u, length))
    return float(np.diff(places, append=places[0] + length).max())


def _share(used: BoolArray, among: BoolArray) -> float:
    """Returns the share of detections that are used among some, 0 of none."""
    return float(used[among].mean()) if among.any() else 0.0


def _sigma(normals: Array, points: Array, sigma_reading: float) -> float:
    """Returns the largest standard deviation (m) of a rigid motion that detections hold across curves.

    normals (m, 2) are those of the curves at the detections' foot points (m, 2), and the motion turns about
    the mean of these points.
    """
    if len(points) == 0:
        return np.inf
    arm = points - points.mean(axis=0)
    by_motion = np.column_stack([normals, normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]])
    information = by_motion.T @ by_motion / sigma_reading**2
    if np.linalg.matrix_rank(information) < len(information):
        return np.inf
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[:2, :2])[-1]))
