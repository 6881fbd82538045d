"""Input of noise measurement: sightings of cones tracked by dead reckoning, and the twists of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import comb
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.se2 import compose, left_of, rotated, se2_exp, to_map
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.mapping.tracks import Tracks

MAD: Final = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
MOST_TWISTS: Final = 4000  # largest number of newest twists
MOST_PARTS: Final = 200  # number of stored cycles after which these are reduced to the newest twists
MIN_SPEED_SHARE: Final = 0.3  # least share of the median speed for the noise in motion
MIN_TWISTS: Final = 30  # least number of twists for white noise
FOLLOW_RANGE: Final = 30.0  # largest range of a tracked cone (m): few cones beyond are seen from near later
GATE_LEAST: Final = 0.4  # distance within which a sighting is of a cone (m)
GATE_MOST: Final = 3.0  # largest such distance (m); a narrow gate would cut off the noise
GATE_SIGMAS: Final = 3.5  # gate in between, in sigmas of both
FIRST_ALONG: Final = RayNoise(np.array([0.1, 0.04]))  # initial noise along the ray
FIRST_ACROSS: Final = RayNoise(np.array([0.05, 0.016]))  # and across it


@dataclass(frozen=True, eq=False)
class SeenCycle:
    """A perception cycle with its pose by dead reckoning."""

    detections: Detections  # detections as measured
    pose: Array  # (3,) pose by dead reckoning
    twist: Array  # (3,) twist of the vehicle (m/s, m/s, rad/s)


@dataclass(eq=False)
class Sightings:
    """Table of detections of static cones or points, in order of time."""

    cone: IntArray  # (n,) number of the cone, or the label while cones are unknown
    t: Array  # (n,) stamp (s)
    point: Array  # (n, 2) measured point in m, vehicle frame
    twist: Array  # (n, 3) twist of the vehicle (m/s, m/s, rad/s)
    pose: Array  # (n, 3) pose by dead reckoning
    by_bias: Array  # (n, 3) derivative of the pose by the bias of the yaw rate

    @classmethod
    def of(cls, cycles: Sequence[SeenCycle]) -> "Sightings":
        """Return the detections of cycles up to `FOLLOW_RANGE`, with labels for cones."""
        poses, twists = np.array([one.pose for one in cycles]), np.array([one.twist for one in cycles])
        seen = [one.detections for one in cycles]
        t, points = np.array([one.t for one in seen]), np.concatenate([one.points_vehicle for one in seen])
        labels, moved = np.concatenate([one.labels for one in seen]), np.diff(poses[:, :2], axis=0)
        turned, own = t[0] - t, np.repeat(np.arange(len(seen)), [len(one.labels) for one in seen])
        middle = turned[1:] + 0.5 * np.diff(t)
        shift = np.concatenate([np.zeros((1, 2)), np.cumsum(left_of(moved) * middle[:, None], axis=0)])
        table = cls(labels, t[own], points, twists[own], poses[own], np.column_stack([shift, turned])[own])
        return table.where(np.hypot(*points.T) < FOLLOW_RANGE)

    def where(self, rows: IntArray | BoolArray | slice) -> "Sightings":
        return Sightings(*(getattr(self, column.name)[rows] for column in fields(self)))

    def tracked(self, noise: MeasuredNoise) -> "Sightings":
        """Replace the labels by numbers of cones, which are tracked by dead reckoning."""
        rays = replace(noise, along=noise.along or FIRST_ALONG, across=noise.across or FIRST_ACROSS)
        covariances = rays.covariances(self.point, inflated=False)
        assert covariances is not None
        points = to_map(noise.corrected(self.point, self.twist), self.pose)
        cones = Tracks(GATE_LEAST, most=GATE_MOST / GATE_LEAST, sigmas=GATE_SIGMAS)
        return replace(self, cone=cones.add(points, rotated(covariances, self.pose[:, 2]), self.cone, self.t))


def dead_reckoned(odometry: Odometry, stamps: Array) -> Array:
    """Poses (n, 3) at stamps (n,) in s by odometry alone, from the origin at its first row."""
    row = np.maximum(odometry.t.searchsorted(stamps, side="right") - 1, 0)
    held = np.maximum(stamps - odometry.t[row], 0.0)
    return compose(odometry.poses()[row], se2_exp(odometry.twist[row] * held[:, None]))


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
