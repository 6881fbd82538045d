"""Events of Formula Student by the rules' geometry: skidpad and acceleration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import BIG_ORANGE, ORANGE

from .centre_line import STEP
from .track import Track

FloatArray = NDArray[np.float64]

LANE: Final = 3.0
"""Width of the road in both events (m)."""
CIRCLES: Final = 18.25
"""Distance of the centres of the skidpad's circles (m)."""
INNER: Final = 15.25 / 2
"""Radius of the circle of inner cones (m)."""
INNER_CONES: Final = 16
OUTER_CONES: Final = 13
APPROACH: Final = 15.0
"""Length of the lanes into and out of the circles (m)."""
ROUNDS: Final = 2
"""Each circle is driven for this number of rounds: the right one first."""

STRETCH: Final = 75.0
"""Length of the acceleration event (m)."""
BRAKING: Final = 75.0
"""Length of the road after its finish line, on which vehicles brake (m)."""
SPACING: Final = 5.0
"""Distance of the cones along it (m)."""


def skidpad() -> Track:
    """Returns the two circles, entered and left along x between them: two rounds right, two rounds left.

    Inner and outer cones have the colour of their side as each circle is driven. The cones of the lanes into
    and out of the circles are orange.
    """
    middle, outer = CIRCLES / 2, INNER + LANE
    # the outer rows leave the lanes free
    gap = np.arccos((middle - LANE / 2) / outer)
    inner = _circle(INNER, np.arange(INNER_CONES) * 2 * np.pi / INNER_CONES)
    outer_row = _circle(outer, np.linspace(gap, 2 * np.pi - gap, OUTER_CONES))
    below, above = np.array([0.0, -middle]), np.array([0.0, middle])
    mirrored = np.array([1.0, -1.0])
    x = np.arange(-APPROACH, -LANE - 2.0, LANE)
    lanes = [(side * at, y) for at in x for side in (1, -1) for y in (-LANE / 2, LANE / 2)]
    rounds = np.arange(0.0, ROUNDS * 2 * np.pi, STEP / middle)
    path = [
        _line(-APPROACH, 0.0),
        _circle(middle, rounds) + below,
        _circle(middle, rounds) * mirrored + above,
        _line(0.0, APPROACH),
    ]
    return Track(
        left=np.concatenate([outer_row + below, inner * mirrored + above]),
        right=np.concatenate([inner + below, outer_row * mirrored + above]),
        other=np.array(lanes),
        other_labels=np.full(len(lanes), ORANGE),
        closed=False,
        start=np.array([-APPROACH, 0.0, 0.0]),
        name="skidpad",
        path=np.concatenate(path),
    )


def _circle(radius: float, angles: FloatArray) -> FloatArray:
    """Returns points (n, 2) of a circle about the origin, from its top on clockwise."""
    return radius * np.column_stack([np.sin(angles), np.cos(angles)])


def _line(begin: float, end: float) -> FloatArray:
    """Returns points (n, 2) along the x axis, the end left out."""
    x = np.arange(begin, end, STEP)
    return np.column_stack([x, np.zeros(len(x))])


def acceleration() -> Track:
    """Returns the straight along x with its gates, and the road on which vehicles brake."""
    x = np.arange(0.0, STRETCH + BRAKING + SPACING / 2, SPACING)
    left = np.column_stack([x, np.full(len(x), LANE / 2)])
    gates = [(at, y) for at in (0.3, STRETCH + 0.3) for y in (-LANE / 2 - 0.3, LANE / 2 + 0.3)]
    right = left * [1.0, -1.0]
    labels = np.full(len(gates), BIG_ORANGE)
    return Track(left, right, np.array(gates), False, np.array([0.3, 0.0, 0.0]), "acceleration", labels)


EVENTS: Final[dict[str, Callable[[], Track]]] = {"skidpad": skidpad, "acceleration": acceleration}
"""Each event has its track."""
