"""Which part of the map is near: what the window can touch, and some room for what comes next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .smoother import Smoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


def narrow(smoother: Smoother) -> None:
    """Keep what is solved for to the near part of the map; exact, see `far`.

    An open curve's far part grows as the vehicle drives on; a closed one's is chosen anew when the near part
    no longer holds what the window needs.
    """
    state, room = smoother.state, smoother.settings.far.room
    needed = {label: _needed(smoother, label) for label in state.boundaries}
    if not all(
        _holds(state.near(label), indices, state.boundaries[label].size) for label, indices in needed.items()
    ):
        smoother.join()
    elif not _worthwhile(smoother, needed):
        return
    smoother.part({label: _needed(smoother, label, room) for label in state.boundaries})


def _holds(near: IntArray, needed: IntArray, size: int) -> bool:
    """Whether one stretch of control points holds another; on a closed curve of that size they wrap."""
    return int(needed[0] - near[0]) % size + len(needed) <= len(near)


def _worthwhile(smoother: Smoother, needed: dict[int, IntArray]) -> bool:
    """A closed curve that is near all around, or enough behind the vehicle on an open one."""
    state, settings = smoother.state, smoother.settings
    behind = [0]
    for label, indices in needed.items():
        if state.boundaries[label].periodic:
            return state.whole
        behind.append(int(indices[0] - state.near(label)[0]))
    return max(behind) * settings.spline.spacing >= settings.far.stretch


def _needed(smoother: Smoother, label: int, room: float = 0.0) -> IntArray:
    """Control points (k,) of what the window's poses see in this cycle and the next, and `room` (m) ahead."""
    boundary, stations = smoother.state.boundaries[label], smoother.state.stations[label]
    gate, slide = smoother.settings.gate, smoother.settings.spline.refine_room
    low = float(stations.min()) - gate.view_behind - slide
    high = float(stations.max()) + gate.view_ahead + gate.station_ahead + slide + room
    if boundary.periodic and high - low >= boundary.length:
        return boundary.everything
    first, last = boundary.tables.locate(np.array([low, high]))[0]
    if not boundary.periodic:
        return np.arange(first, boundary.size)
    last += boundary.degree + (boundary.size if last < first else 0)
    if last - first >= boundary.size - 1:
        return boundary.everything
    return np.arange(first, last + 1) % boundary.size
