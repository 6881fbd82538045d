"""The inactive part of an open map: exact where it was linearized, and rigid when everything swings."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors._kernels import odometry_residuals
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, inverse, move_points, rotation
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, keys_of, marginalize, normal_equations
from pathspace_graph.graph.inactive import InactiveChain, from_frame, pose_and_reference, relative_factor
from pathspace_graph.graph.rows import Rows, at_reference, jacobian_factors
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    ORIGIN_KEY,
    POSE,
    Layout,
    Variables,
    are_poses,
    control_keys,
    pose_key,
    pose_keys,
)

from ..scenes.graph import schur

SMALL = 1e-5
"""Residuals are of this size, so that the squares of the changes that they ask for do not matter."""
POINTS = control_keys(0, np.arange(8))
CYCLES = 9


def relative_pose(start: Array, end: Array) -> Array:
    return compose(inverse(start), end)


def relative_rows(variables: Variables, k: int, rng: np.random.Generator) -> list[Rows]:
    """Measurements of pose k: three points in its frame, and calibrated odometry to the next pose."""
    pose, following = variables.of(pose_keys(np.array([k, k + 1]))).reshape(2, POSE)
    turn, keys, jacobian, residual = rotation(pose[2]).T, [], [], []
    by_heading = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ turn
    for key in POINTS[max(k - 1, 0) : k + 2][:3]:
        offset = variables.of(np.array([key])) - pose[:2]
        keys += [[pose_key(k), key]] * 2
        jacobian += list(np.column_stack([-turn, by_heading @ offset, turn]) / 0.1)
        residual += list(SMALL * rng.normal(size=2))
    seen = Rows(np.array(keys), np.array(jacobian), np.array(residual), np.full(len(keys), k))
    _, start, end = odometry_residuals(pose[None], following[None], relative_pose(pose, following)[None])
    tied = np.tile([CALIBRATION_KEY, pose_key(k), pose_key(k + 1)], (POSE, 1))
    by_all = np.concatenate([rng.normal(size=(POSE, 2)), start[0], end[0]], axis=1) / 0.05
    return [seen, Rows(tied, by_all, SMALL * rng.normal(size=POSE), np.full(POSE, k))]


@dataclass
class Drive:
    """A drive of relative measurements and an absolute first pose; points are left behind."""

    seed: int
    variables: Variables = field(default_factory=Variables)
    chain: InactiveChain = field(default_factory=InactiveChain)
    prior: gtsam.GaussianFactorGraph = field(default_factory=gtsam.GaussianFactorGraph)
    whole: gtsam.GaussianFactorGraph = field(default_factory=gtsam.GaussianFactorGraph)
    anchors: dict[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        poses = np.column_stack([np.arange(CYCLES + 1.0), rng.normal(size=(CYCLES + 1, 2)) * 0.3])
        points = np.column_stack([np.arange(8.0), 1.5 + rng.normal(size=8)])
        keys = np.concatenate([[CALIBRATION_KEY], POINTS, pose_keys(np.arange(CYCLES + 1))])
        values = np.concatenate([rng.normal(size=2) * 0.1, points.ravel(), poses.ravel()])
        self.variables.insert(keys, values, values + rng.normal(size=len(values)) * 0.1)
        known = np.array([CALIBRATION_KEY, pose_key(0)])
        A, now = (
            np.diag([3.0, 4.0, 10.0, 10.0, 20.0]),
            self.variables.change(self.variables.layout.entries(known)),
        )
        first = jacobian_factor(known, A, A @ now)
        self.prior, self.whole = graph_of(first), graph_of(first)
        for k in range(CYCLES):
            self._leave(k, rng)

    def _leave(self, k: int, rng: np.random.Generator) -> None:
        """Marginalizes pose k; from pose 4 on, a point is left behind at every second pose."""
        factor = jacobian_factors(
            at_reference(relative_rows(self.variables, k, rng), self.variables), self.variables.layout
        )[k]
        self.prior, self.whole = graph_of(self.prior, factor), graph_of(self.whole, factor)
        self.variables.first_cycle = k + 1
        if pose_key(k) not in self.chain.anchors:
            self.prior = marginalize(self.prior, pose_keys(np.array([k])))
            self.variables.remove(pose_keys(np.array([k])))
        if k >= 4 and k % 2 == 0:
            keyframes, point = self.variables.keyframes, POINTS[(k - 4) // 2 : (k - 2) // 2]
            self.prior = self.chain.attach(self.prior, point, self.variables)
            self.anchors |= {int(key): self.variables.of(np.array([key])) for key in keyframes}
            self.variables.remove(keyframes)

    def mean(self, keys: IntArray) -> Array:
        """The mean of variables by the dense inverse of all measurements."""
        layout = Layout(keys_of(self.whole))
        hessian, vector = normal_equations(self.whole, layout)
        found = np.linalg.solve(hessian, vector)[layout.entries(keys)]
        return np.asarray(found + self.variables.reference[self.variables.layout.entries(keys)])

    def system(self, graph: gtsam.GaussianFactorGraph) -> tuple[Array, Array]:
        """Hessian and negative gradient by all variables but poses that are none any more, at the values."""
        layout, kept = Layout(keys_of(graph)), self.variables.keys
        gone = layout.entries(np.setdiff1d(layout.keys, kept))
        hessian, vector = schur(*normal_equations(graph, layout), gone)
        return hessian, vector - hessian @ (self.variables.values - self.variables.reference)

    def active(self) -> IntArray:
        """The keys of all variables that are not in the chain."""
        return np.setdiff1d(self.variables.keys, self.chain.keys)


def assert_same_system(found: tuple[Array, Array], expected: tuple[Array, Array]) -> None:
    scale = np.abs(expected[0]).max()
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5 * scale)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-8 * scale)


@pytest.mark.parametrize("seed", range(3))
def test_the_chain_and_the_prior_are_the_whole_gaussian(seed: int) -> None:
    """Everything is where it was linearized, so they are the dense marginal."""
    drive = Drive(seed)
    assert len(drive.chain) == 3 and drive.chain.keys.tolist() == POINTS[:3].tolist()
    drive.chain.poses = drive.anchors
    assert_same_system(
        drive.system(drive.chain.joint(drive.prior, drive.variables)), drive.system(drive.whole)
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_marginal_is_that_of_the_whole_gaussian(seed: int) -> None:
    """The links are linear in all but the frames, so at the mean the derivatives are exact."""
    drive = Drive(seed)
    variables, active = drive.variables, drive.active()
    variables.values[variables.layout.entries(active)] = drive.mean(active)
    drive.chain.refresh(variables)
    layout, kept = Layout(keys_of(drive.whole)), Layout(active)
    gone = layout.entries(np.setdiff1d(layout.keys, active))
    expected = schur(*normal_equations(drive.whole, layout), gone)
    found = normal_equations(drive.chain.marginal(drive.prior, variables), kept)
    scale = np.abs(expected[0]).max()
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5 * scale)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5 * scale)


@pytest.mark.parametrize("seed", range(3))
def test_the_inactive_variables_follow_the_active_ones_to_the_mean(seed: int) -> None:
    """The origin is one of them, and its mean is where it is by definition."""
    drive = Drive(seed)
    variables, active = drive.variables, drive.active()
    variables.values[variables.layout.entries(active)] = drive.mean(active)
    variables.values[variables.layout.entries(drive.chain.keys)] = np.nan
    drive.chain.refresh(variables)
    np.testing.assert_allclose(variables.of(drive.chain.keys), drive.mean(drive.chain.keys), atol=1e-7)
    np.testing.assert_allclose(drive.chain.origin, 0.0, atol=1e-7)
    assert sorted(drive.chain.poses) == sorted([*drive.anchors, ORIGIN_KEY])


@pytest.mark.parametrize("seed", range(3))
def test_links_that_come_back_are_what_they_were(seed: int) -> None:
    """Without links the prior is absolute again."""
    drive = Drive(seed)
    variables, chain = drive.variables, drive.chain
    for key, pose in drive.anchors.items():
        chain.poses[key] = pose
    chain.poses[ORIGIN_KEY] = np.zeros(POSE)
    assert chain.newest.tolist() == POINTS[2:3].tolist()
    back = chain.detach(variables)
    assert chain.keys.tolist() == POINTS[:2].tolist()
    assert not are_poses(chain.keys).any()
    rest = [chain.detach(variables) for _ in range(2)]
    assert len(chain) == 0 and len(chain.anchors) == 0 and chain.poses == {}
    assert (variables.layout.positions(np.array(list(drive.anchors))) >= 0).all()
    variables.remove(np.array(sorted(drive.anchors)))
    whole = graph_of(drive.prior, back, *rest)
    assert_same_system(drive.system(whole), drive.system(drive.whole))


def test_a_copy_of_a_chain_keeps_what_the_chain_gives_back() -> None:
    drive = Drive(0)
    variables, chain = drive.variables.copy(), drive.chain
    chain.refresh(variables)
    other, again, poses = chain.copy(), variables.copy(), dict(chain.poses)
    first = [chain.detach(variables) for _ in range(3)]
    assert chain.poses == {} and other.poses == poses
    second = [other.detach(again) for _ in range(3)]
    np.testing.assert_array_equal(again.values, variables.values)
    for one, two in zip(first, second, strict=True):
        assert one.equals(two, 1e-12)


class Flag:
    """A point that goes where the map goes."""

    def __init__(self, point: Array) -> None:
        self.points = point[None]

    def move(self, motion: Array) -> None:
        self.points = move_points(motion, self.points)


@pytest.mark.parametrize("motion", [np.array([3.0, -40.0, 0.3]), np.array([-200.0, 70.0, 2.8])])
def test_a_swing_bends_nothing_and_is_undone(motion: Array) -> None:
    """All active variables are moved rigidly, as by a bias with a long lever; the inactive ones follow."""
    drive = Drive(0)
    variables, chain = drive.variables, drive.chain
    chain.refresh(variables)
    drive.prior = chain.transform_to_origin(drive.prior, variables, [])
    before, system = variables.copy(), normal_equations(drive.prior, Layout(keys_of(drive.prior)))
    anchor = int(chain.anchors[0])
    near = relative_factor(drive.prior, anchor, *pose_and_reference(anchor, variables), variables)
    variables.values = from_frame(variables.values, motion, variables.layout)
    variables.values[variables.layout.entries(chain.keys)] = np.nan
    flag = Flag(variables.of(POINTS[-1:]))
    prior = chain.transform_to_origin(graph_of(near.factor(variables)), variables, [flag])
    np.testing.assert_allclose(variables.values, before.values, atol=1e-8)
    np.testing.assert_allclose(flag.points[0], before.of(POINTS[-1:]), atol=1e-8)
    found = normal_equations(prior, Layout(keys_of(prior)))
    for one, other in zip(found, system, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(system[0]).max())
