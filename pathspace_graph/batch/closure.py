"""When a loop is worth trying without a registration, and what speaks for or against a closed result.

The drive's own recurrence says when a lap has been driven and more. A batch that begins at odometry then
solves the closed loop. Its result is believed by what the detections of the second lap say, never by
patience.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.registration import by_motion, sigma_of_information
from pathspace_graph.mapping.state import SAMPLE, State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.crossing import boundaries_cross, polylines_cross, sampled

from .recurrence import Recurrence
from .system import Evaluation

WIDER: Final = 2.5
"""No point of a boundary is farther from the road driven than this number of times its distance beside it."""
MOSTLY: Final = 95.0
"""Percentile of the poses' distances: the drive may begin or end off the track."""

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def is_worth_trying(recurrence: Recurrence, settings: MapperSettings) -> bool:
    """Returns whether the path driven says that a lap and a good part of another one have been driven.

    It costs about a millisecond with `find_recurrence`, so it can be asked every few metres.
    """
    own = settings.batch.closure
    long_enough = float(recurrence.driven[-1]) >= own.laps * recurrence.lap
    return recurrence.recurs and long_enough and recurrence.correlation >= own.min_correlation


@dataclass(frozen=True)
class Evidence:
    """Holds what speaks for or against a closed result."""

    closed: bool
    """This is true where both boundaries are closed."""
    used: float
    """This share of the coloured detections of the first lap lies on the curves."""
    used_again: float
    """This share of those after the first lap does."""
    misfit: float
    """This is the root mean square distance of those detections from their curves, in sigmas."""
    gap: float
    """This is the longest stretch of a boundary on which no detection lies (m)."""
    overlap: float
    """The boundary that was driven less far has been driven again over this length (m)."""
    sigma: float
    """The detections after the first lap hold their drive in place, beside the curves, by this standard
    deviation in the worst direction (m). It is infinite on a straight, whose stretches all agree."""


def evidence(at: Evaluation, detections: DetectionTable, settings: MapperSettings) -> Evidence:
    """Returns the evidence for or against an optimum whose curves are closed."""
    state = at.state
    coloured = np.isin(detections.label, list(state.boundaries))
    again = _is_after_first_lap(state)[detections.cycle] & coloured
    chosen = {label: again[projected.rows] for label, projected in at.projected.items()}
    feet = [p.foot.where(chosen[label]) for label, p in at.projected.items()]
    whitened = [p.whitened[chosen[label]] for label, p in at.projected.items()]
    lengths = {label: boundary.length for label, boundary in state.boundaries.items()}
    return Evidence(
        closed=set(lengths) == set(BOUNDARIES) and all(b.periodic for b in state.boundaries.values()),
        used=_share(detections.used, coloured & ~again),
        used_again=_share(detections.used, again),
        misfit=_rms(np.concatenate([np.zeros(0), *whitened])),
        gap=max(
            (_longest_gap(p.foot.u, lengths[label]) for label, p in at.projected.items()), default=np.inf
        ),
        overlap=min((_driven_again(state.pose_u[b], lengths[b]) for b in lengths), default=0.0),
        sigma=_sigma_of_motion(feet, settings.closing.sigma_reading),
    )


def objection(found: Evidence, splines: Mapping[int, BSpline], poses: Array, settings: MapperSettings) -> str:
    """Return what speaks against a map of closed curves around the poses (P, 3) of a lap; empty for nothing.

    The boundaries of a road don't cross, the vehicle crosses neither and has driven beside all of both, and
    the detections of the lap lie on them.
    """
    step, driven = SAMPLE, poses[:, :2]
    if boundaries_cross(splines, step):
        return "its boundaries cross"
    for curve in (sampled(spline, step) for spline in splines.values()):
        if polylines_cross(curve, driven):
            return "the vehicle would have crossed a boundary"
        aside = float(np.percentile(KDTree(curve).query(driven)[0], MOSTLY))
        wider = float(KDTree(driven).query(curve)[0].max()) / aside
        if wider > WIDER:
            return f"a boundary would be {wider:.1f} times as far from the drive as it is beside it"
    if found.used < settings.batch.closure.used:
        return f"only {found.used:.0%} of the detections lie on its boundaries".replace("%", " %")
    return ""


def is_true_closure(found: Evidence, settings: MapperSettings) -> bool:
    """Returns whether the evidence is for a closed result, in every respect.

    A caller that can wait for more of the drive also asks that the optimization has converged.
    """
    own = settings.batch.closure
    return (
        found.closed
        and found.used >= own.used
        and found.used_again >= own.used_again * found.used
        and found.misfit <= own.misfit
        and found.gap <= own.gap
        and found.overlap >= own.overlap
        and found.sigma <= own.sigma
    )


def _is_after_first_lap(state: State) -> BoolArray:
    """Returns which poses (P,) are beside a stretch of every boundary that was driven a lap before."""
    again = np.ones(len(state.poses), bool)
    for label, boundary in state.boundaries.items():
        u = state.pose_u[label]
        again &= u - u[0] >= boundary.length
    return again


def _driven_again(pose_u: Array, length: float) -> float:
    """Returns how much of a closed curve of a length was driven again, at most all of it (m)."""
    return float(np.clip(pose_u[-1] - pose_u[0] - length, 0.0, length))


def _longest_gap(u: Array, length: float) -> float:
    """Returns the longest stretch (m) of a closed curve of a length without any of the parameters u (m,)."""
    if len(u) == 0:
        return length
    places = np.sort(np.mod(u, length))
    return float(np.diff(places, append=places[0] + length).max())


def _share(used: BoolArray, among: BoolArray) -> float:
    """Returns the share of some detections that is used, 0 of none."""
    return float(used[among].mean()) if among.any() else 0.0


def _rms(values: Array) -> float:
    """Returns the root mean square, infinite of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.inf


def _sigma_of_motion(feet: Sequence[FootPoints], sigma_reading: float) -> float:
    """Returns the largest standard deviation (m) of a rigid motion that detections hold across curves.

    The motion turns about the mean of the foot points. Each detection has this sigma (m).
    """
    normal, point = (
        np.concatenate([np.zeros((0, 2)), *(getattr(foot, name) for foot in feet)])
        for name in ("normal_unit", "position")
    )
    if len(point) == 0:
        return np.inf
    jacobian = by_motion(normal, point - point.mean(axis=0)) / sigma_reading
    return sigma_of_information(jacobian.T @ jacobian)
