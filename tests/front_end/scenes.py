"""Synthetic drives past random cones, whose noise and whose sensor's constant errors are known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.factors.sensor import by_sensor
from pathspace_graph.front_end.measurement import SeenCycle
from pathspace_graph.front_end.noise import measure_noise
from pathspace_graph.io.log import Odometry
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.vehicle import integrate

from ..scenes.drives import detections

Array = NDArray[np.float64]

ODOMETRY_RATE = 50
"""Twists for each second."""
CYCLE = 5
"""Twists for each perception cycle."""
WHITE = np.array([0.02, 0.02, 0.002])
"""Noise of the twists, which the poses do not have."""


@dataclass(eq=False)
class Camera:
    """Says what a sensor does to the cones that it sees, and makes drives past them."""

    along: RayNoise
    across: RayNoise
    errors: Array = field(default_factory=lambda: np.zeros(5))
    """(5,) The sensor has these constant errors (`factors.sensor:SENSOR`)."""
    bend: float = 0.0
    """A range r beyond 9 m reads this (1/m) times `(r - 9)^2` longer."""
    seconds: float = 60.0

    def drive(self, seed: int) -> tuple[list[SeenCycle], Odometry]:
        """Returns the cycles of a winding drive at about 10 m/s, where they truly were, and its twists."""
        rng = np.random.default_rng(seed)
        t = np.arange(round(self.seconds * ODOMETRY_RATE)) / ODOMETRY_RATE
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        twists = np.column_stack(
            [10.0 + 3.0 * np.sin(t / 2.3 + phase[0]), np.zeros_like(t), 0.6 * np.sin(t / 1.7 + phase[1])]
        )
        poses = integrate(twists[:-1], 1.0 / ODOMETRY_RATE)
        odometry = Odometry(t, twists + WHITE * rng.normal(size=twists.shape))
        cones, labels = _cones(poses, rng)
        slow = rng.normal(size=(2, len(cones)))
        rho = np.exp(-CYCLE / ODOMETRY_RATE / np.array([self.along.time, self.across.time]))[:, None]
        cycles = []
        for k in range(0, len(t), CYCLE):
            slow = rho * slow + np.sqrt(1.0 - rho**2) * rng.normal(size=slow.shape)
            white = rng.normal(size=slow.shape)
            true = to_vehicle(cones, np.tile(poses[k], (len(cones), 1)))
            ranges = np.hypot(*true.T)
            seen = (ranges > 2.0) & (ranges < 22.0) & (np.abs(np.arctan2(true[:, 1], true[:, 0])) < 1.0)
            points = self._measured(true[seen], twists[k], slow[:, seen], white[:, seen])
            cycles.append(SeenCycle(detections(t[k], points, labels[seen]), poses[k], twists[k]))
        return cycles, odometry

    def _measured(self, true: Array, twist: Array, slow: Array, white: Array) -> Array:
        """Returns the detections of cones, of which the corrected ones are where they are plus noise."""
        ranges = np.hypot(*true.T)
        ray = true / ranges[:, None]
        noisy = true + self.bend * np.maximum(ranges - 9.0, 0.0)[:, None] ** 2 * ray
        directions = (ray, np.column_stack([-ray[:, 1], ray[:, 0]]))
        for k, noise in enumerate((self.along, self.across)):
            unit = np.sqrt(noise.share) * slow[k] + np.sqrt(1.0 - noise.share) * white[k]
            noisy += (noise.sigmas(ranges) * unit)[:, None] * directions[k]
        measured = noisy
        for _ in range(20):
            measured = noisy - by_sensor(measured, np.tile(twist, (len(true), 1))) @ self.errors
        return measured

    def found(self, seed: int) -> MeasuredNoise:
        """Returns what is measured on a drive."""
        found = measure_noise(*self.drive(seed))
        assert found is not None and found.along is not None and found.across is not None
        return found


def _cones(poses: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.intp]]:
    """Returns cones (M, 2) about 5 m apart on both sides of a drive, 2 to 4 m away, and their labels (M,)."""
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    rows, labels = [], []
    for label, side in ((LEFT, 1.0), (RIGHT, -1.0)):
        at = np.arange(0.0, driven[-1], 5.0)
        at += rng.uniform(-1.0, 1.0, len(at))
        x, y, theta = (np.interp(at, driven, poses[:, k]) for k in range(3))
        lateral = side * rng.uniform(2.0, 4.0, len(at))
        rows.append(np.column_stack([x - lateral * np.sin(theta), y + lateral * np.cos(theta)]))
        labels += [label] * len(at)
    return np.concatenate(rows), np.array(labels, np.intp)
