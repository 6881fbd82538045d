"""Two rows of cones that are followed ahead at the same time, each cone to the row that it fits better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import wrap_angle
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.front_end import SidesSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass
class Row:
    """Holds a row of cones, the nearest first."""

    cones: list[int]
    """These cones are in the row."""
    end: Array
    """(2,) The row ends at this point, in m."""
    heading: float
    """The row leads in this direction there (rad)."""

    def lead_to(self, cone: int, point: Array) -> None:
        """Leads the row on to a cone at a point (2,)."""
        dx, dy = point - self.end
        self.cones.append(cone)
        self.end, self.heading = point, float(np.arctan2(dy, dx))


def follow_rows(
    rows: Mapping[int, Row], points: Array, votes: IntArray, free: IntArray, settings: SidesSettings
) -> None:
    """Leads both rows on through free cones (k,), as long as it is clear which cone comes next.

    All cones (n,) have points (n, 2) in m, and votes (n, 2) for the left and the right boundary. The next
    cone is the one with the least `distance (1 + turn_cost turn^2)` from the end of its row. It must be far
    cheaper for that row than for the other one. Where it is not, both rows end: two rows could be confused
    there.
    """
    left = free.tolist()
    while left:
        candidates = np.array(left)
        found = [_costs(rows, label, points, votes, candidates, settings) for label in (LEFT, RIGHT)]
        costs = np.array([cost for cost, _ in found])
        within = np.where([distance < settings.gap for _, distance in found], costs, np.inf)
        label, best = divmod(int(within.argmin()), len(left))
        if np.isinf(within[label, best]) or costs[1 - label, best] < settings.clear * within[label, best]:
            return
        rows[label].lead_to(left[best], points[left[best]])
        del left[best]


def _costs(
    rows: Mapping[int, Row],
    label: int,
    points: Array,
    votes: IntArray,
    cones: IntArray,
    settings: SidesSettings,
) -> tuple[Array, Array]:
    """Returns what it costs a row to lead on to cones (k,), and how far they are from its end (m).

    The cost is infinite where the row may not lead on there.
    """
    row, other = rows[label], rows[LEFT + RIGHT - label]
    dx, dy = (points[cones] - row.end).T
    distance, turn = np.hypot(dx, dy), wrap_angle(np.arctan2(dy, dx) - row.heading)
    allowed = np.abs(turn) < settings.turn
    own, opposite = votes[cones, label], votes[cones, LEFT + RIGHT - label]
    allowed &= opposite <= own + 1
    if other.cones:
        off = points[cones][:, None] - points[other.cones][None]
        allowed &= np.hypot(off[..., 0], off[..., 1]).min(axis=1) > settings.min_width
    return np.where(allowed, distance * (1.0 + settings.turn_cost * turn**2), np.inf), distance
