"""Graphs for other programs: what GTSAM can serialize, and the pose graph that g2o can hold."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.linear import keys_of_factor, linear_factor

from .rows import OdometryChain, calibrated_delta
from .variables import pose_key, sizes

GRAPH_FORMAT: Final = "pathspace-gtsam/1"
GRAPH_FILE: Final = "graph.json"  # in the folder of a result


def portable(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Return a graph that GTSAM can serialize: factors in Python are linearized at the values.

    A `gtsam.LinearContainerFactor` has the gradient of the factor at the values. So an optimum stays one, and
    away from it the factor is its quadratic approximation: the error of a detection beyond Huber's threshold
    is its weighted square. It holds only the variables that the factor depends on there.
    """
    found = gtsam.NonlinearFactorGraph()
    for factor in (graph.at(k) for k in range(graph.size())):
        found.add(_linearized(factor, values) if isinstance(factor, gtsam.CustomFactor) else factor)
    return found


def _linearized(factor: gtsam.CustomFactor, values: gtsam.Values) -> gtsam.LinearContainerFactor:
    linear = factor.linearize(values)
    keys, (A, b) = keys_of_factor(linear), linear.jacobian()
    widths = sizes(keys)
    starts = np.cumsum(widths) - widths
    held = np.add.reduceat(np.abs(A).sum(axis=0), starts) > 0.0
    held[0] |= not held.any()
    columns = np.repeat(held, widths)
    small = linear_factor(keys[held], widths[held], np.array(A)[:, columns], np.ravel(b))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(small), values)


def write_graph(
    file: Path,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    poses: gtsam.NonlinearFactorGraph | None = None,
) -> None:
    """Write a graph, its values and its pose graph as JSON of the texts that `deserialize` reads."""
    content = {"graph": portable(graph, values).serialize(), "values": values.serialize()}
    content |= {} if poses is None else {"pose_graph": poses.serialize()}
    file.write_text(json.dumps({"format": GRAPH_FORMAT, **content}), encoding="utf-8")


def read_graph(file: Path, name: str = "graph") -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Read the `graph` or the `pose_graph` that `write_graph` has written, and the values."""
    content = json.loads(file.read_text(encoding="utf-8"))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.deserialize(content[name])
    values.deserialize(content["values"])
    return graph, values


def pose_graph(
    factors: Iterable[gtsam.NonlinearFactor], odometry: OdometryChain, calibration: Array
) -> gtsam.NonlinearFactorGraph:
    """Return what relates one pose to another, for g2o: odometry from x0 on, and of the factors the revisits.

    The odometry is corrected by a calibration (2,). Left out is all else: priors, calibrations, and what is
    measured of curves. So its optimum is another one.
    """
    found = gtsam.NonlinearFactorGraph()
    for k, interval in enumerate(odometry.intervals):
        delta = gtsam.Pose2(*calibrated_delta(interval, calibration))
        noise = gtsam.noiseModel.Gaussian.Covariance(interval.covariance)
        found.add(gtsam.BetweenFactorPose2(pose_key(k), pose_key(k + 1), delta, noise))
    for factor in factors:
        if isinstance(factor, gtsam.BetweenFactorPose2):
            found.add(factor)
    return found


def write_g2o(file: Path, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
    """Write a pose graph with the values of its poses as g2o text (`VERTEX_SE2`, `EDGE_SE2`)."""
    poses = gtsam.Values()
    for key in sorted(graph.keyVector()):
        poses.insert(key, values.atPose2(key))
    gtsam.writeG2o(graph, poses, str(file))
