"""A revisit as a measurement: its residual, its rows, and the same as a factor of the engine."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, relative
from pathspace_graph.graph.gaussian import graph_of, normal_equations
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.variables import Layout, Variables, pose_keys

from ..scenes.jacobians import numeric_jacobian

EARLIER, LATER = 1, 4


def scene(seed: int) -> tuple[Revisit, Array]:
    """Return a revisit and poses (6, 3) at which it is off by some sigmas."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(6, 3)) * (5.0, 5.0, 1.0)
    local = relative(poses[EARLIER], poses[LATER]) + rng.normal(size=3) * 0.1
    return Revisit(EARLIER, LATER, local, np.triu(rng.normal(size=(3, 3)) + 4.0 * np.eye(3))), poses


def test_nothing_is_left_where_the_pose_is_as_measured_and_whole_turns_do_not_count() -> None:
    revisit, poses = scene(0)
    poses[LATER] = compose(poses[EARLIER], revisit.local)
    np.testing.assert_allclose(revisit.residual(poses), 0.0, atol=1e-12)
    poses[LATER, 2] += 2.0 * np.pi
    np.testing.assert_allclose(revisit.residual(poses), 0.0, atol=1e-12)


def test_the_covariance_is_in_the_frame_of_the_earlier_pose() -> None:
    """A drive that is turned as a whole has the same residual."""
    revisit, poses = scene(1)
    turned = np.array([compose(np.array([3.0, -2.0, 1.1]), pose) for pose in poses])
    np.testing.assert_allclose(revisit.residual(turned), revisit.residual(poses), atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_its_rows_have_right_jacobians(seed: int) -> None:
    revisit, poses = scene(seed)
    rows = revisit.rows(poses)
    np.testing.assert_array_equal(rows.keys[0], pose_keys(np.array([EARLIER, LATER])))

    def residual(x: Array) -> Array:
        moved = poses.copy()
        moved[[EARLIER, LATER]] = x.reshape(2, 3)
        return revisit.residual(moved)

    expected = numeric_jacobian(residual, poses[[EARLIER, LATER]].ravel())
    np.testing.assert_allclose(rows.jacobian, expected, atol=1e-6)
    np.testing.assert_allclose(rows.residual, revisit.residual(poses))


def test_the_engine_s_factor_is_the_same() -> None:
    revisit, poses = scene(2)
    variables, keys = Variables(), pose_keys(np.array([EARLIER, LATER]))
    variables.insert(keys, poses[[EARLIER, LATER]].ravel())
    information, vector = normal_equations(graph_of(revisit.factor().factor(variables)), Layout(keys))
    rows = revisit.rows(poses)
    np.testing.assert_allclose(information, rows.jacobian.T @ rows.jacobian, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(vector, -rows.jacobian.T @ rows.residual, rtol=1e-9, atol=1e-9)
