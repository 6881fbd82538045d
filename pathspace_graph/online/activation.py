"""The active part of the map: what the window can touch, and some room for the next cycles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.curve_map import CurveSmoother

IntArray = NDArray[np.intp]


def deactivate_distant(smoother: CurveSmoother) -> None:
    """Restricts each step to the active part of the map, which changes no result: see `graph.inactive`.

    An open curve's inactive part grows as the vehicle drives on. A closed curve's active part is chosen again
    when it no longer holds what the window needs.
    """
    state, room = smoother.map.state, smoother.map.settings.far.room
    needed = {label: _needed(smoother, label) for label in state.boundaries}
    if not all(
        _holds(state.active(label), indices, state.boundaries[label].size)
        for label, indices in needed.items()
    ):
        smoother.activate(np.concatenate([state.keys(label)[own] for label, own in needed.items()]))
    elif not _worthwhile(smoother, needed):
        return
    active = {label: _needed(smoother, label, room) for label in state.boundaries}
    leaving = [np.setdiff1d(state.active(label), indices) for label, indices in active.items()]
    if not any(map(len, leaving)):
        return
    keys = [state.keys(label)[indices] for label, indices in zip(active, leaving, strict=True)]
    smoother.deactivate(np.concatenate(keys))
    state.active_stretch = active
    smoother.carry()


def _holds(active: IntArray, needed: IntArray, size: int) -> bool:
    """Returns whether one stretch of a boundary's `size` control points holds another; indices may wrap."""
    return int(needed[0] - active[0]) % size + len(needed) <= len(active)


def _worthwhile(smoother: CurveSmoother, needed: dict[int, IntArray]) -> bool:
    """Returns whether a closed curve is active all around, or an open one has enough behind the vehicle."""
    state, settings = smoother.map.state, smoother.map.settings
    behind = [0]
    for label, indices in needed.items():
        if state.boundaries[label].periodic:
            return state.whole
        behind.append(int(indices[0] - state.active(label)[0]))
    return max(behind) * settings.spline.spacing >= settings.far.stretch


def _needed(smoother: CurveSmoother, label: int, room: float = 0.0) -> IntArray:
    """Returns the control points (k,) that the window sees until the next cycle, and `room` (m) ahead."""
    boundary, pose_u = smoother.map.state.boundaries[label], smoother.map.state.pose_u[label]
    gate, slide = smoother.map.settings.gate, smoother.map.settings.spline.refine_room
    low = float(pose_u.min()) - gate.view_behind - slide
    high = float(pose_u.max()) + gate.view_ahead + gate.station_ahead + slide + room
    if boundary.periodic and high - low >= boundary.length:
        return boundary.everything
    first, last = boundary.tables.locate(np.array([low, high]))[0]
    if not boundary.periodic:
        return np.arange(first, boundary.size)
    last += boundary.degree + (boundary.size if last < first else 0)
    if last - first >= boundary.size - 1:
        return boundary.everything
    return np.arange(first, last + 1) % boundary.size
