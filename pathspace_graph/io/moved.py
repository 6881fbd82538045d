"""Maps and runs after a rigid motion of their frame."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, move_points, rotation

from .map import Map, MapBoundary, PointBoundary
from .results import RunResult

Run = TypeVar("Run", bound=RunResult)


def moved(track: Map, motion: Array) -> Map:
    """Move a map and its covariances by a motion (3,); parameters along its curves stay."""
    boundaries = {label: _moved(boundary, motion) for label, boundary in track.boundaries.items()}
    points = {label: _moved_points(cones, motion) for label, cones in track.points.items()}
    joint = track.joint_covariance
    return Map(track.closed, boundaries, None if joint is None else _turned(joint, motion), points)


def moved_run(run: Run, motion: Array) -> Run:
    """Move the last map and the trajectory of a run by a motion (3,)."""
    return replace(run, map=moved(run.map, motion), trajectory=compose(motion, run.trajectory))


def _moved(boundary: MapBoundary, motion: Array) -> MapBoundary:
    if isinstance(boundary, PointBoundary):
        return _moved_points(boundary, motion)
    spline = replace(boundary.spline, control_points=move_points(motion, boundary.spline.control_points))
    return replace(boundary, spline=spline, covariance=_turned(boundary.covariance, motion))


def _moved_points(cones: PointBoundary, motion: Array) -> PointBoundary:
    return PointBoundary(move_points(motion, cones.points), _turned(cones.covariance, motion))


def _turned(covariance: Array, motion: Array) -> Array:
    """Rotate a covariance (2m, 2m) of points."""
    turn = rotation(float(motion[2]))
    count = len(covariance) // 2
    blocks = covariance.reshape(count, 2, count, 2)
    turned = np.einsum("ij,ajbk,lk->aibl", turn, blocks, turn)
    return np.asarray(turned.reshape(covariance.shape), np.float64)
