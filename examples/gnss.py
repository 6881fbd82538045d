"""Add factors of your own on poses: a GNSS receiver measures the position in addition to the cones.

The mapper accepts any GTSAM factors with a cycle. Here a receiver measures the vehicle's position in the map
frame once a second. Each fix is a `gtsam.PoseTranslationPrior2D` on the pose of its cycle.

    python examples/gnss.py
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph import FixedLagMapper, Log
from pathspace_graph.run import split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

Array = NDArray[np.float64]

SIGMA_GNSS = 0.3
"""Standard deviation of a fix in each direction (m)."""
EVERY = 10
"""Number of cycles from one fix to the next (1 s)."""


def build_log(laps: int = 1, seed: int = 0) -> Log:
    """Simulate a drive on a generated track."""
    track = generate_track(np.random.default_rng(seed))
    return simulate(track, SimulationSettings(laps=laps), seed)


def true_positions(log: Log) -> Array:
    """True positions (n, 2) of the vehicle at the perception cycles, in m, map frame."""
    assert log.truth is not None
    stamps = [cycle.t for cycle in log.cycles]
    truth = log.truth
    return np.column_stack([np.interp(stamps, truth.pose_t, truth.poses[:, axis]) for axis in (0, 1)])


def gnss_factor(key: int, fix: Array) -> gtsam.NonlinearFactor:
    """Build the factor of a fix (2,) in m, map frame; Huber's loss limits outliers."""
    gaussian = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_GNSS)
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), gaussian)
    return gtsam.PoseTranslationPrior2D(key, fix, robust)


def drive(log: Log, fixes: Array | None) -> Array:
    """Map a log with fixes (n, 2) or without; return the estimated position (n, 2) of each cycle."""
    mapper = FixedLagMapper(odometry_sigma=log.noise)
    positions = []
    for cycle, (odometry, detections) in enumerate(split_odometry(log)):
        factors = []
        if fixes is not None and cycle % EVERY == 0:
            factors.append(gnss_factor(mapper.next_pose_key, fixes[cycle]))
        positions.append(mapper.update(odometry, detections, factors).pose[:2])
    return np.array(positions)


def main(laps: int = 1, seed: int = 0) -> tuple[float, float]:
    """Return the rms error of the position (m) without and with the receiver."""
    log = build_log(laps, seed)
    truth = true_positions(log)
    fixes = truth + np.random.default_rng(seed).normal(0.0, SIGMA_GNSS, truth.shape)
    errors = [np.sqrt(((drive(log, chosen) - truth) ** 2).sum(axis=1).mean()) for chosen in (None, fixes)]
    return float(errors[0]), float(errors[1])


if __name__ == "__main__":
    alone, with_gnss = main()
    print(f"rms position error: {alone:.2f} m with cones alone, {with_gnss:.2f} m with GNSS")
