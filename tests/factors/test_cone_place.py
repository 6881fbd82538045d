"""The place kernel: Jacobians with detections metres away from their places, and an answer by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import periodic_knots
from pathspace_graph.factors.cone_place import along_from_place
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.factors.spans import SpanPolynomials

from ..scenes.jacobians import assert_jacobians

Array = NDArray[np.float64]

SPACING = 3.0
"""This is the knot interval of the test curves (m)."""


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", range(4))
def test_jacobians_far_from_the_place(degree: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tables = SpanPolynomials(periodic_knots(SPACING * np.arange(11.0), degree), degree, True)
    (basis, slope), _ = tables.evaluate(rng.uniform(0.0, 30.0, 1), 1)
    control = np.column_stack([SPACING * np.arange(degree + 1.0), np.zeros(degree + 1)])
    control += rng.normal(0.0, 0.5, control.shape)
    detection = rng.normal(0.0, 6.0, (1, 2))

    def one_detection(pose: Array, control_points: Array) -> Sequence[Array]:
        points = to_map(detection, pose[None])
        rows = along_from_place(points, pose[None], control_points.reshape(1, -1, 2), basis, slope)
        return rows.residual, rows.by_pose, rows.by_control.reshape(1, -1)

    assert_jacobians(one_detection, [rng.normal(0.0, 3.0, 3), control.ravel()])


def test_it_is_the_distance_past_the_place_along_a_straight_curve() -> None:
    """The curve runs along y; half way between its control points lies the place (2, 5)."""
    control, basis, slope = (
        np.array([[[2.0, 4.0], [2.0, 6.0]]]),
        np.array([[0.5, 0.5]]),
        np.array([[-0.5, 0.5]]),
    )
    pose = np.array([[1.0, 1.0, np.pi / 2.0]])
    rows = along_from_place(np.array([[1.4, 5.7]]), pose, control, basis, slope)
    np.testing.assert_allclose(rows.residual, [0.7])
    np.testing.assert_allclose(rows.tangent_unit, [[0.0, 1.0]])
    np.testing.assert_allclose(rows.by_pose, [[0.0, 1.0, 0.4]])
    np.testing.assert_allclose(rows.by_control, [[[0.3, -0.5], [-0.3, -0.5]]])
    np.testing.assert_allclose(rows.flat_by_control, [[0.3, -0.5, -0.3, -0.5]])
