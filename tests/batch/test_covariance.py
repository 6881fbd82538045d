"""The covariances of the batch against Monte Carlo: many draws of the noise on one small drive."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.simplification import map_block
from pathspace_graph.graph.elimination import Elimination
from pathspace_graph.mapping.state import State

from ..scenes.batch import drawn, settled, straight

Array = NDArray[np.float64]

DRAWS = 200
SITES = np.arange(5.0, 33.0, 9.0)
"""The errors of each curve are taken at these parameters (m)."""


@cache
def errors() -> tuple[Array, Array, Array, Array]:
    """Returns errors of the curves across themselves (d, 2 k), of the last pose (d, 3), and covariances."""
    system, truth = straight()
    claimed = system.eliminated(system.evaluate(truth))
    rng = np.random.default_rng(7)
    curves, poses = [], []
    for _ in range(DRAWS):
        noisy, _ = drawn(system, rng)
        noisy.begin(truth)
        noisy.evaluate(truth, hold=True)
        state = settled(noisy, truth, 2)
        curves.append(across(state, truth))
        poses.append(state.poses[-1] - truth.poses[-1])
    return (
        np.array(curves),
        np.array(poses),
        curve_covariance(truth, claimed),
        claimed.pose_marginals[-1],
    )


def across(state: State, truth: State) -> Array:
    """Returns (2 k,) how far both curves are to the left of the true ones."""
    offsets = [
        boundary.evaluate(state.control_points(b), SITES) - boundary.evaluate(truth.control_points(b), SITES)
        for b, boundary in truth.boundaries.items()
    ]
    return np.concatenate([offset[:, 1] for offset in offsets])


def curve_covariance(truth: State, claimed: Elimination) -> Array:
    """Returns the covariance (2 k, 2 k) of the curves across themselves."""
    joint = claimed.joint(truth.map_keys)
    rows = []
    for b, boundary in truth.boundaries.items():
        design = np.zeros((len(SITES), len(joint)))
        design[:, map_block(truth, b)][:, 1::2] = boundary.spline(truth.control_points(b)).basis_matrix(SITES)
        rows.append(design)
    B = np.concatenate(rows)
    return np.asarray(B @ joint @ B.T)


def mean_nees(samples: Array, covariance: Array) -> float:
    """Returns the mean of `e' P^-1 e` per degree of freedom."""
    return float(np.mean(np.einsum("di,ij,dj->d", samples, np.linalg.inv(covariance), samples))) / len(
        covariance
    )


@pytest.mark.slow
def test_both_curves_together_err_as_much_as_claimed() -> None:
    curves, _, claimed, _ = errors()
    np.testing.assert_allclose(curves.std(axis=0), np.sqrt(np.diag(claimed)), rtol=0.2)
    assert 0.85 < mean_nees(curves, claimed) < 1.15


def test_the_two_curves_err_together() -> None:
    """Both contain the heading of the whole map. Without the cross terms the difference would seem larger."""
    curves, _, claimed, _ = errors()
    k = len(SITES)
    difference = curves[:, k - 1] - curves[:, 2 * k - 1]
    variance = claimed[k - 1, k - 1] + claimed[2 * k - 1, 2 * k - 1] - 2.0 * claimed[k - 1, 2 * k - 1]
    np.testing.assert_allclose(difference.std(), np.sqrt(variance), rtol=0.2)
    assert variance < 0.7 * (claimed[k - 1, k - 1] + claimed[2 * k - 1, 2 * k - 1])


def test_the_last_pose_errs_as_much_as_claimed() -> None:
    _, poses, _, claimed = errors()
    assert 0.75 < mean_nees(poses, claimed) < 1.25
