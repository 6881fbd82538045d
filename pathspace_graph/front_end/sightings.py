"""Input of noise measurement: sightings of cones tracked by dead reckoning, and the twists of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import comb
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import left_of, to_map
from pathspace_graph.io.log import Detections, Odometry

MAD: Final = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
MOST_TWISTS: Final = 4000  # largest number of newest twists
MOST_PARTS: Final = 200  # number of stored cycles after which these are reduced to the newest twists
MIN_SPEED_SHARE: Final = 0.3  # least share of the median speed for the noise in motion
MIN_TWISTS: Final = 30  # least number of twists for white noise
FOLLOW_RANGE: Final = 30.0  # largest range of a tracked cone (m): few cones beyond are seen from near later
MAX_AGE: Final = 3.0  # time without a sighting after which a track ends (s)
GATE_UNKNOWN: Final = (0.4, 0.06, 1.5)  # gate `min(a + b r, c)` (m) at range r while noise is unknown
FOLLOWING: Final = (0.5, 0.15)  # gains by which a track moves to a sighting: from nearer, and from farther
GATE_SIGMAS: Final = 3.5  # gate along and across the ray (sigmas) once noise is known
GATE_LEAST: Final = 0.4  # least gate (m)
GATE_MOST: Final = 3.5  # largest gate (m)

Cones = tuple[Array, IntArray, Array, Array, IntArray]
"""Position (k, 2) of each tracked cone, its label (k,), least range, newest stamp and number."""


@dataclass(eq=False)
class Sightings:
    """Table of sightings of cones, in order of time."""

    cone: IntArray  # (n,) number of the cone
    t: Array  # (n,) stamp (s)
    point: Array  # (n, 2) measured point in m, vehicle frame
    twist: Array  # (n, 3) twist of the vehicle (m/s, m/s, rad/s)
    pose: Array  # (n, 3) pose by dead reckoning
    by_bias: Array  # (n, 3) derivative of the pose by the bias of the yaw rate

    @classmethod
    def none(cls) -> "Sightings":
        return cls(np.zeros(0, np.intp), np.zeros(0), np.zeros((0, 2)), *np.zeros((3, 0, 3)))

    def where(self, rows: IntArray | BoolArray | slice) -> "Sightings":
        return Sightings(*(getattr(self, column.name)[rows] for column in fields(self)))

    @classmethod
    def stacked(cls, tables: "Sequence[Sightings]") -> "Sightings":
        return cls(*(np.concatenate([getattr(one, column.name) for one in tables]) for column in fields(cls)))


@dataclass(frozen=True, eq=False)
class SeenCycle:
    """A perception cycle with its pose by dead reckoning."""

    detections: Detections  # detections as measured
    pose: Array  # (3,) pose by dead reckoning
    twist: Array  # (3,) twist of the vehicle (m/s, m/s, rad/s)


def by_bias(t: Array, poses: Array, since: tuple[float, Array, Array] | None = None) -> Array:
    """Return the derivatives (c, 3) of poses (c, 3) at t (c,) by the bias of the yaw rate.

    `since` is the stamp, pose and derivative (3,) of an earlier cycle, by default the first one.
    """
    stamp, pose, begun = since or (t[0], poses[0], np.zeros(3))
    moved, dt = np.diff(poses[:, :2], axis=0, prepend=pose[None, :2]), np.diff(t, prepend=stamp)
    turned = begun[2] - (t - stamp)
    middle = turned + 0.5 * dt
    derivatives = np.column_stack([np.cumsum(left_of(moved) * middle[:, None], axis=0), turned])
    derivatives[:, :2] += begun[:2]
    return derivatives


class ConeTracker(Copyable):
    """Tracks of the cones seen in the last seconds, by dead reckoning."""

    def __init__(self, known: MeasuredNoise) -> None:
        self._known = known
        none = np.zeros(0, np.intp)
        self._cones: Cones = (np.zeros((0, 2)), none, np.zeros(0), np.zeros(0), none)
        self._count = 0
        self._from: tuple[float, Array, Array] | None = None  # stamp, pose and `by_bias` of the latest cycle

    def follow(self, cycles: Sequence[SeenCycle]) -> Sightings:
        """Track the cones through the next cycles; return the sightings by time and range."""
        if not cycles:
            return Sightings.none()
        poses, twists = np.array([one.pose for one in cycles]), np.array([one.twist for one in cycles])
        seen = [one.detections for one in cycles]
        t, labels = np.array([one.t for one in seen]), np.concatenate([one.labels for one in seen])
        cycle = np.repeat(np.arange(len(seen)), [len(one.labels) for one in seen])
        measured = np.concatenate([one.points_vehicle for one in seen])
        ranges = np.hypot(*measured.T)
        order = np.lexsort((ranges, cycle))
        order = order[ranges[order] < FOLLOW_RANGE]
        cycle, measured, ranges = cycle[order], measured[order], ranges[order]
        points = to_map(self._known.corrected(measured, twists[cycle]), poses[cycle])
        begins, gates = cycle.searchsorted(np.arange(len(cycles) + 1)), self._gates(ranges)
        cycles_seen = begins, t, poses[:, :2].copy(), points, labels[order], ranges, *gates
        cones, self._cones, self._count = kernels.followed(
            *cycles_seen, self._cones, self._count, (MAX_AGE, *FOLLOWING)
        )
        of_cone, derivatives = cones >= 0, by_bias(t, poses, self._from)
        self._from = t[-1], poses[-1], derivatives[-1]
        own = cycle[of_cone]
        return Sightings(cones[of_cone], t[own], measured[of_cone], twists[own], poses[own], derivatives[own])

    def _gates(self, ranges: Array) -> tuple[Array, Array]:
        """Return the gates (m,) along and across the ray of detections at ranges (m,), in m."""
        known = self._known
        if known.along is None or known.across is None:
            round_gate = np.minimum(GATE_UNKNOWN[0] + GATE_UNKNOWN[1] * ranges, GATE_UNKNOWN[2])
            return round_gate, round_gate
        along, across = (GATE_SIGMAS * ray.sigmas(ranges) for ray in (known.along, known.across))
        return np.clip(along, GATE_LEAST, GATE_MOST), np.clip(across, GATE_LEAST, GATE_MOST)


class TwistRecord(Copyable):
    """The newest measured twists of a drive."""

    def __init__(self) -> None:
        self._parts: tuple[Odometry, ...] = ()

    def add(self, odometry: Odometry) -> None:
        self._parts = (*self._parts, odometry)
        if len(self._parts) > MOST_PARTS:
            self._parts = (Odometry(*self._newest),)

    @property
    def _newest(self) -> tuple[Array, Array]:
        """Return the stamps (n,) and the twists (n, 3) without repeated ones, which are held."""
        t = np.concatenate([np.zeros(0), *(part.t for part in self._parts)])
        twists = np.concatenate([np.zeros((0, 3)), *(part.twist for part in self._parts)])
        new = np.ones(len(t), bool)
        new[1:] = (np.diff(t) > 0.0) & (np.diff(twists, axis=0) != 0.0).any(axis=1)
        return t[new][-MOST_TWISTS:], twists[new][-MOST_TWISTS:]

    def white(self) -> tuple[Array, float] | None:
        """Return the white noise (3,) of a twist, the least of `orders`, and the interval of twists (s)."""
        orders = self.orders()
        return None if orders is None else (orders.min(axis=0), float(np.median(np.diff(self._newest[0]))))

    def orders(self) -> Array | None:
        """Return the noise (k, 3) of a twist by differences of second to fourth order, or None for too few.

        The noise by order k is the scaled median absolute difference over `sqrt(binomial(2 k, k))`. The noise
        is not white if orders disagree.
        """
        _, twists = self._newest
        if len(twists) < MIN_TWISTS:
            return None
        speeds = np.hypot(twists[:, 0], twists[:, 1])
        drives = speeds > MIN_SPEED_SHARE * np.median(speeds)
        orders = []
        for k in (2, 3, 4):
            inside = np.lib.stride_tricks.sliding_window_view(drives, k + 1).all(axis=1)
            if inside.sum() >= MIN_TWISTS // 2:
                differences = np.abs(np.diff(twists, k, axis=0)[inside])
                orders.append(MAD * np.median(differences, axis=0) / np.sqrt(comb(2 * k, k)))
        return np.array(orders) if orders else None
