"""A revisit as a measurement: its residual, its rows, and the same as a factor of the engine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, relative, wrap_angle
from pathspace_graph.graph.rows import Revisit, revisit_rows
from pathspace_graph.graph.variables import pose_keys

from ..scenes.jacobians import numeric_jacobian

EARLIER, LATER = 1, 4


def residual(revisit: Revisit, poses: Array) -> Array:
    return revisit_rows([revisit], poses)[0].residual


def scene(seed: int) -> tuple[Revisit, Array]:
    """Return a revisit and poses (6, 3) at which it is off by some sigmas."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(6, 3)) * (5.0, 5.0, 1.0)
    local = relative(poses[EARLIER], poses[LATER]) + rng.normal(size=3) * 0.1
    return Revisit(EARLIER, LATER, local, np.triu(rng.normal(size=(3, 3)) + 4.0 * np.eye(3))), poses


def test_nothing_is_left_where_the_pose_is_as_measured_and_whole_turns_do_not_count() -> None:
    revisit, poses = scene(0)
    poses[LATER] = compose(poses[EARLIER], revisit.local)
    np.testing.assert_allclose(residual(revisit, poses), 0.0, atol=1e-12)
    poses[LATER, 2] += 2.0 * np.pi
    np.testing.assert_allclose(residual(revisit, poses), 0.0, atol=1e-12)


def test_the_covariance_is_in_the_frame_of_the_earlier_pose() -> None:
    """A drive that is turned as a whole has the same residual."""
    revisit, poses = scene(1)
    turned = np.array([compose(np.array([3.0, -2.0, 1.1]), pose) for pose in poses])
    np.testing.assert_allclose(residual(revisit, turned), residual(revisit, poses), atol=1e-10)


def test_rows_of_several_revisits_have_right_jacobians() -> None:
    revisits, poses = [scene(seed)[0] for seed in range(3)], scene(0)[1]
    revisits[1] = replace(revisits[1], earlier=0, later=5)
    (rows,) = revisit_rows(revisits, poses)
    for k, revisit in enumerate(revisits):
        ends, own = [revisit.earlier, revisit.later], slice(3 * k, 3 * k + 3)
        np.testing.assert_array_equal(rows.keys[own], [pose_keys(np.array(ends))] * 3)

        def moved(x: Array, revisit: Revisit = revisit, ends: list[int] = ends) -> Array:
            others = poses.copy()
            others[ends] = x.reshape(2, 3)
            off = relative(*others[ends]) - revisit.local
            return np.asarray(revisit.root @ [*off[:2], wrap_angle(off[2])])

        np.testing.assert_allclose(rows.residual[own], moved(poses[ends].ravel()), atol=1e-12)
        expected = numeric_jacobian(moved, poses[ends].ravel())
        np.testing.assert_allclose(rows.jacobian[own], expected, atol=1e-6)
    assert len(set(rows.owner.tolist())) == 2, "of one factor where the later pose is the same"
    assert revisit_rows([], poses) == []
