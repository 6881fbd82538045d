"""What window and batch share as GTSAM's nonlinear factors: detections, and the weak priors of curves."""

from typing import Any

import gtsam

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.gtsam_factors import smoothness_factors
from pathspace_graph.graph.variables import POINT, pose_keys

from .detections import DetectionTable
from .state import State


def seen_on(
    state: State, detections: DetectionTable, label: int, rows: IntArray, covariances: Array, huber: float
) -> dict[str, Any]:
    """Return arguments of the factors of detections (m,) with covariances (m, 2, 2) on a boundary.

    They are those of `gtsam_factors:spline_projection_factors` and `station_factors`, but for the places.
    """
    return {
        "pose_keys": pose_keys(detections.cycle[rows]),
        "control_keys": state.control_keys(label).tolist(),
        "tables": state.boundaries[label].tables,
        "points_vehicle": detections.measured[rows],
        "covariances": covariances,
        "twists": detections.twist[rows],
        "huber": huber,
        "sensor_key": state.variables.sensor_key,
    }


def weak_priors(
    state: State, label: int, points: IntArray, smooth: bool = True
) -> list[gtsam.NonlinearFactor]:
    """Return the priors of smoothness and the anchors of control points (k,) of a boundary."""
    boundary, keys = state.boundaries[label], state.control_keys(label)
    gauge, factors = boundary.gauge_on(points), list[gtsam.NonlinearFactor]()
    for triple, bending in zip(gauge.triples if smooth else (), gauge.bending, strict=False):
        factors += smoothness_factors(keys[triple].tolist(), bending[None], 1.0)
    anchor = gtsam.noiseModel.Isotropic.Sigma(POINT, boundary.gauge.sigma_anchor)
    pairs = zip(keys[points].tolist(), state.control_points(label)[points], strict=True)
    return factors + [gtsam.PriorFactorPoint2(*pair, anchor) for pair in pairs]
