"""The user's own factors in a batch: they are part of the optimum, of its information and of its graph."""

from __future__ import annotations

from functools import cache

import gtsam
import numpy as np
import pytest

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.errors import SettingsError
from pathspace_graph.graph.variables import CALIBRATION_KEY, control_keys, pose_key
from pathspace_graph.io.log import Log

from ..scenes.drives import bean_track, lap_log, noisy, true_poses

HEADING = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e3, 1e3, 1e-3]))
"""Noise of a compass, in the tangent space of `Pose2`."""


@cache
def log() -> Log:
    return noisy(lap_log(bean_track(), overrun=25.0), seed=3)


def compass() -> list[gtsam.NonlinearFactor]:
    """Return the true heading of each pose; where it is does not count."""
    poses = enumerate(true_poses(log()))
    return [gtsam.PriorFactorPose2(pose_key(k), gtsam.Pose2(*pose), HEADING) for k, pose in poses]


@cache
def solved(*, with_compass: bool) -> BatchResult:
    factors = compass() if with_compass else []
    return BatchMapper(None, log().noise).solve(log(), "odometry", factors=factors)


def test_a_compass_holds_the_heading_of_every_pose() -> None:
    off = [solved(with_compass=w).trajectory[:, 2] - true_poses(log())[:, 2] for w in (False, True)]
    errors = [float(np.sqrt(np.mean(np.arctan2(np.sin(one), np.cos(one)) ** 2))) for one in off]
    assert errors[1] < 5e-4 < errors[0]
    for w in (False, True):
        assert solved(with_compass=w).converged
    sigmas = [np.sqrt(solved(with_compass=w).pose_covariances[:, 2, 2]) for w in (False, True)]
    assert sigmas[1].max() < 1e-3 < np.median(sigmas[0])


def test_the_graph_has_them_and_is_at_its_optimum() -> None:
    result = solved(with_compass=True)
    ordering = result.optimum.state.variables.layout.ordering
    hessian, gradient = result.graph().linearize(result.values()).hessian(ordering)
    step = np.linalg.solve(hessian, gradient)
    assert np.sqrt(step @ hessian @ step) < 1.0  # sigmas of all variables together
    assert result.graph().size() == solved(with_compass=False).graph().size() + len(log().cycles)


def test_a_factor_on_a_calibration_holds_it() -> None:
    known = np.array([0.05, 0.01])
    held = gtsam.PriorFactorPoint2(CALIBRATION_KEY, known, gtsam.noiseModel.Isotropic.Sigma(2, 1e-6))
    result = BatchMapper(None, log().noise).solve(log(), "odometry", factors=[held])
    np.testing.assert_allclose(result.calibration, known, atol=1e-4)


@pytest.mark.parametrize(
    ("key", "name"), [(int(control_keys(0, np.array([3]))[0]), "l3"), (pose_key(10**6), "x1000000")]
)
def test_another_key_is_named_before_anything_is_solved(key: int, name: str) -> None:
    other = gtsam.PriorFactorPoint2(key, np.zeros(2), gtsam.noiseModel.Unit.Create(2))
    with pytest.raises(SettingsError, match=rf"row 1: expected keys of poses, x0 to .*found {name}"):
        BatchMapper(None, log().noise).solve(log(), factors=[compass()[0], other])
