"""Inspect the graph: factors and their errors, uncertainties by GTSAM's own classes, and a picture.

`mapper.graph()` is the window as a `gtsam.NonlinearFactorGraph`, `mapper.values()` is its estimate. All of
GTSAM works on them.

    python examples/look_at_graph.py
"""

from __future__ import annotations

from collections import defaultdict
from itertools import islice
from pathlib import Path

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from pathspace_graph import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

POSE, CALIBRATION, SENSOR = ord("x"), ord("b"), ord("c")


def build_mapper(cycles: int = 150, seed: int = 0) -> FixedLagMapper:
    """Map a number of cycles on a generated track."""
    log = simulate(generate_track(np.random.default_rng(seed)), SimulationSettings(laps=1), seed)
    mapper = FixedLagMapper(odometry_sigma=log.noise)
    for odometry, detections in islice(split_odometry(log), cycles):
        mapper.update(odometry, detections)
    return mapper


def kind(factor: gtsam.NonlinearFactor) -> str:
    """Name the kind of a factor of the mapper, by its class and its keys."""
    letters = {gtsam.symbolChr(key) for key in list(factor.keys())}
    if isinstance(factor, gtsam.CustomFactor):
        seen = "place of a control point" if factor.size() == 2 else "spline projection"
        return "odometry" if CALIBRATION in letters else seen
    return "prior of the window" if letters & {POSE, CALIBRATION, SENSOR} else "smoothness"


def errors_by_kind(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[str, tuple[int, float]]:
    """Count the factors of each kind, and sum their errors (half the squared sigmas)."""
    found: defaultdict[str, tuple[int, float]] = defaultdict(lambda: (0, 0.0))
    for index in range(graph.size()):
        factor = graph.at(index)
        count, error = found[kind(factor)]
        found[kind(factor)] = count + 1, error + factor.error(values)
    return dict(found)


def draw(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, axes: Axes) -> None:
    """Draw poses and control points, and lines from the pose of each projection factor to its points."""
    positions = {
        key: _position(values, key)
        for key in list(values.keys())
        if gtsam.symbolChr(key) not in (CALIBRATION, SENSOR)
    }
    for index in range(graph.size()):
        factor = graph.at(index)
        if kind(factor) == "spline projection":
            pose, _, *controls = factor.keys()  # the second key is the calibration of the sensor
            for point in controls:
                axes.plot(
                    *np.array([positions[pose], positions[point]]).T, color="0.85", linewidth=0.5, zorder=0
                )
    for letter, colour, name in (
        ("l", "tab:blue", "left"),
        ("r", "goldenrod", "right"),
        ("x", "0.2", "poses"),
    ):
        points = np.array([place for key, place in positions.items() if gtsam.symbolChr(key) == ord(letter)])
        axes.plot(*points.T, "o-", color=colour, markersize=4, linewidth=0.8, label=name)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.legend()


def _position(values: gtsam.Values, key: int) -> np.ndarray:
    if gtsam.symbolChr(key) == POSE:
        pose = values.atPose2(key)
        return np.array([pose.x(), pose.y()])
    return np.array(values.atPoint2(key))


def main(folder: Path = Path(), cycles: int = 150) -> dict[str, tuple[int, float]]:
    """Write `graph.dot` and `graph.png` to a folder; return the errors by kind of factor."""
    mapper = build_mapper(cycles)
    graph, values = mapper.graph(), mapper.values()
    graph.saveGraph(str(folder / "graph.dot"), values)
    figure, axes = plt.subplots(figsize=(8, 6))
    draw(graph, values, axes)
    figure.savefig(folder / "graph.png", dpi=120, bbox_inches="tight")
    plt.close(figure)
    return errors_by_kind(graph, values)


if __name__ == "__main__":
    for name, (count, error) in main().items():
        print(f"{count:4d} {name:20s} {error:9.3f}")
    mapper = build_mapper()
    marginals = gtsam.Marginals(mapper.graph(), mapper.values())
    newest = mapper.next_pose_key - 1
    covariances = marginals.marginalCovariance(newest), mapper.marginal_covariance([newest])
    own, in_map = (np.sqrt(np.diag(covariance)) for covariance in covariances)
    print("sigmas of the newest pose by GTSAM, in its own frame:", own)
    print("sigmas of the newest pose by the mapper, map frame:  ", in_map)
