"""A track: two rows of cones in driving order, and the pose that the vehicle starts from; and the events."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN

from . import curves
from .curves import SmoothCurve, direction, left_normals


@dataclass(frozen=True, eq=False)
class Track:
    """Cones of a track, in a frame of its own."""

    left: Array  # cones of the left boundary in driving order (n, 2) in m
    right: Array  # cones of the right boundary in driving order (m, 2) in m
    other: Array  # cones of no boundary, such as those of a gate (k, 2) in m
    closed: bool  # whether the last cones are followed by the first
    start: Array  # pose [x, y, theta] (3,) from which the vehicle starts, in m, m, rad
    name: str
    other_labels: IntArray | None = None  # labels (k,) of the other cones, by default UNKNOWN
    path: Array | None = None  # (k, 2) along which the road is driven, if not its middle (m)

    @cached_property
    def centre_line(self) -> SmoothCurve:
        """The smooth curve halfway between the boundaries, or along the path, track frame."""
        if self.path is not None:
            return curves.along_path(self.path, np.vstack([self.left, self.right]), self.closed)
        return curves.fit_centre_line(self.left, self.right, self.closed, self.start[:2])

    @property
    def rows(self) -> tuple[Array, Array]:
        """Cones of the left and the right boundary in passing order, repeated in each round."""
        if self.closed or self.path is None:
            return self.left, self.right
        return _passed(self.left, self.path), _passed(self.right, self.path)

    @property
    def cones(self) -> Array:
        return np.vstack([self.left, self.right, self.other])

    @property
    def cone_labels(self) -> IntArray:
        other = np.full(len(self.other), UNKNOWN) if self.other_labels is None else self.other_labels
        return np.concatenate([np.repeat([LEFT, RIGHT], [len(self.left), len(self.right)]), other])


def _passed(cones: Array, path: Array) -> Array:
    """Order cones (n, 2) as a path (k, 2) passes them, some repeatedly."""
    apart = np.linalg.norm(cones[:, None] - path, axis=2)
    beside = apart < BESIDE * np.median(apart.min(axis=1))
    passes = list[tuple[int, int]]()
    for cone, near in enumerate(beside):
        begins = np.flatnonzero(near & ~np.append(False, near[:-1]))
        ends = np.flatnonzero(near & ~np.append(near[1:], False)) + 1
        passes += [
            (b + int(apart[cone, b:e].argmin()), cone)
            for b, e in zip(begins.tolist(), ends.tolist(), strict=True)
        ]
    return cones[[cone for _, cone in sorted(passes)]]


def to_map_frame(track: Track) -> Track:
    """Move the track so that its start pose is (0, 0, 0): the map frame of a log that starts there."""
    ahead = direction(track.start[2])
    rotation = np.column_stack([ahead, left_normals(ahead)])
    points = {name: getattr(track, name) for name in ("left", "right", "other", "path")}
    moved: dict[str, Any] = {
        name: at if at is None else (at - track.start[:2]) @ rotation for name, at in points.items()
    }
    return replace(track, **moved, start=np.zeros(3))


BESIDE: Final = 2.0  # distance of a cone from a path that passes it, at most, by the median of the nearest
LANE: Final = 3.0  # width of the road in both events (m)
CIRCLES: Final = 18.25  # distance of the centres of the skidpad's circles (m)
INNER: Final = 15.25 / 2  # radius of the circle of inner cones (m)
INNER_CONES: Final = 16
OUTER_CONES: Final = 13
APPROACH: Final = 15.0  # length of the lanes into and out of the circles (m)
ROUNDS: Final = 2  # rounds in each circle, the right one first

STRETCH: Final = 75.0  # length of the acceleration event (m)
BRAKING: Final = 75.0  # length of the road after its finish line, on which vehicles brake (m)
SPACING: Final = 5.0  # distance of the cones along it (m)


def skidpad() -> Track:
    """Skidpad: two circles, entered and left along x between them: two rounds right, two rounds left.

    Cones have the colour of their side as each circle is driven; those of the lanes are orange.
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
    rounds = np.arange(0.0, ROUNDS * 2 * np.pi, curves.STEP / middle)
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


def _circle(radius: float, angles: Array) -> Array:
    return radius * np.column_stack([np.sin(angles), np.cos(angles)])


def _line(begin: float, end: float) -> Array:
    return np.arange(begin, end, curves.STEP)[:, None] * [1.0, 0.0]


def acceleration() -> Track:
    """Acceleration: a straight along x with its gates, and the road on which vehicles brake."""
    x = np.arange(0.0, STRETCH + BRAKING + SPACING / 2, SPACING)
    left = np.column_stack([x, np.full(len(x), LANE / 2)])
    gates = [(at, y) for at in (0.3, STRETCH + 0.3) for y in (-LANE / 2 - 0.3, LANE / 2 + 0.3)]
    right = left * [1.0, -1.0]
    labels = np.full(len(gates), BIG_ORANGE)
    return Track(left, right, np.array(gates), False, np.array([0.3, 0.0, 0.0]), "acceleration", labels)


EVENTS: Final[dict[str, Callable[[], Track]]] = {"skidpad": skidpad, "acceleration": acceleration}
"""Tracks of the events by name."""
