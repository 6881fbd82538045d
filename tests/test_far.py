"""The far part of the map: what leaves and comes back is the same Gaussian, and a step the same step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.far import Far, Parting
from pathspace_graph.fixed_lag import FixedLagMapper
from pathspace_graph.linearizer import normal_equations
from pathspace_graph.settings import FarSettings, MapperSettings
from pathspace_graph.smoother import Smoother
from pathspace_graph.window import POSE, Prior, cholesky, solve

from .scenes import bean_track, lap_log, map_log

Array = NDArray[np.float64]
LEAD = 6 + CALIBRATION_SIZE
"""Entries of x before its poses: three control points and the calibration."""


def random_prior(rng: np.random.Generator, size: int) -> Prior:
    root = rng.normal(size=(2 * size, size))
    return Prior(root.T @ root, rng.normal(size=size), rng.normal(size=size))


def two_partings(rng: np.random.Generator, weak: float) -> tuple[Prior, Prior, Far]:
    """A prior on x and the pose of cycle 5; after control point 0 has left with it, and 1 with that of 9.

    Between the two the pose of cycle 9 was tied to that of cycle 5.
    """
    whole, far = random_prior(rng, LEAD + POSE), Far()
    first = parting([0, 1], [*range(2, LEAD)], [], None, 5, weak * np.eye(LEAD + POSE))
    left = far.push(whole, first)
    tie = random_prior(rng, 2 * POSE)
    left, whole = tied(left, tie, LEAD - 2), tied(whole, tie, LEAD)
    second = parting([2, 3], [*range(4, LEAD)], [*range(LEAD - 2, LEAD + 1)], 5, 9, weak * np.eye(LEAD + 4))
    return whole, far.push(left, second), far


def parting(
    leave: list[int], stay: list[int], old: list[int], left: int | None, anchor: int, weak: Array
) -> Parting:
    """Columns of x leave; the prior begins with the first of them, and ends with the new anchor."""
    base, size = leave[0], len(weak)
    order = [*(c - base for c in leave), *old], [*(c - base for c in stay), *range(size - POSE, size)]
    return Parting(
        frontal=np.array(order[0]),
        stays=np.array(order[1]),
        columns=np.array([*leave, *stay]),
        frontals=len(leave),
        left=left,
        anchor=anchor,
        hessian=weak,
        descent=np.full(size, weak[0, 0]),
    )


def tied(prior: Prior, tie: Prior, at: int) -> Prior:
    """Another pose, tied to the one at an index, which is the prior's last."""
    size = len(prior.point) + POSE
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[:-POSE, :-POSE] = prior.information
    gradient[:-POSE] = prior.gradient
    information[at:, at:] += tie.information
    gradient[at:] += tie.gradient
    return Prior(information, gradient, np.append(prior.point, tie.point[POSE:]))


@pytest.mark.parametrize("weak", [0.0, 0.7])
def test_what_left_comes_back_as_it_was(weak: float) -> None:
    """With the weak priors that left with it taken off again, and at another point."""
    rng = np.random.default_rng(0)
    whole, left, far = two_partings(rng, weak)
    x = np.concatenate([rng.normal(size=LEAD), rng.normal(size=POSE)])
    anchors = {9: x[LEAD:], 5: rng.normal(size=POSE)}
    joined = far.joined(left, np.arange(4, LEAD), x, LEAD, anchors)
    np.testing.assert_allclose(joined.information, whole.information, atol=1e-9)
    np.testing.assert_allclose(joined.point, [*x[:LEAD], *anchors[5], *x[LEAD:]])
    np.testing.assert_allclose(joined.gradient, whole.descent_at(joined.point), atol=1e-9)


def test_the_far_part_follows_to_the_joint_mean() -> None:
    whole, left, far = two_partings(np.random.default_rng(1), 0.0)
    mean = whole.point + np.linalg.solve(whole.information, whole.gradient)
    near = left.point + np.linalg.solve(left.information, left.gradient)
    x = np.concatenate([np.full(4, np.nan), near])
    anchors = far.refresh(x, x[LEAD:])
    np.testing.assert_allclose(x[:LEAD], mean[:LEAD], atol=1e-9)
    np.testing.assert_allclose(anchors[5], mean[LEAD : LEAD + POSE], atol=1e-9)


def test_columns_move_where_x_grows() -> None:
    _, _, far = two_partings(np.random.default_rng(2), 0.0)
    far.shift(4, 2)
    assert far.columns(far.parts[0]).tolist() == [0, 1, 2, 3, 6, 7, 8, 9]
    assert far.columns(far.parts[1]).tolist() == [2, 3, 6, 7, 8, 9]


# --- in the mapper ---------------------------------------------------------------------------------------


def whole_step(smoother: Smoother, sigma_step: float) -> Array:
    """x after a step that solves for near and far at once, all conditionals as rows."""
    state, far = smoother.state, smoother.far
    x, lead = state.vector.copy(), state.map_size + CALIBRATION_SIZE
    anchors = far.refresh(x, x[lead : lead + POSE])
    near = state.system[: state.near_size + CALIBRATION_SIZE]
    prior = with_weak_priors(far, lambda: far.joined(smoother.prior, near, x, lead, anchors))
    window = len(state.vector) - lead
    left = len(prior.point) - lead - (len(smoother.prior.point) - len(near))
    size = lead + left + window
    nothing = Prior(np.zeros((0, 0)), np.zeros(0), np.zeros(0))
    rows, own = normal_equations(smoother.linearize(), nothing, state, state.vector[state.system])
    rows[np.arange(state.near_size), np.arange(state.near_size)] += sigma_step**-2
    columns = np.append(near, lead + left + np.arange(window))
    hessian, descent = np.zeros((size, size)), np.zeros(size)
    hessian[np.ix_(columns, columns)] = rows
    descent[columns] = own
    q = len(prior.point)
    hessian[:q, :q] += prior.information
    descent[:q] += prior.gradient
    step = solve(cholesky(hessian), descent)
    return x + np.append(step[:lead], step[lead + left :])


def with_weak_priors(far: Far, joined: Callable[[], Prior]) -> Prior:
    """Joined, but with the weak priors that the conditionals hold left in."""
    held = [(part.parting.hessian.copy(), part.parting.descent.copy()) for part in far.parts]
    for part in far.parts:
        part.parting.hessian[:] = 0.0
        part.parting.descent[:] = 0.0
    prior = joined()
    for part, (hessian, descent) in zip(far.parts, held, strict=True):
        part.parting.hessian[:] = hessian
        part.parting.descent[:] = descent
    return prior


class Checked(Smoother):
    """Every step with a far part is held against that of the whole system."""

    worst = 0.0
    checked = 0

    def step(self, sigma_step: float) -> None:
        if self.state.whole:
            return super().step(sigma_step)
        expected = whole_step(self, sigma_step)
        super().step(sigma_step)
        x = self.state.vector.copy()
        lead = self.state.map_size + CALIBRATION_SIZE
        self.far.refresh(x, x[lead : lead + POSE])
        self.worst = max(self.worst, float(np.abs(x - expected).max()))
        self.checked += 1
        return None


def test_near_steps_are_the_whole_systems_steps() -> None:
    """Along two laps: while the curves grow, and all around when they are closed."""
    log = lap_log(bean_track(), overrun=100.0)
    settings = MapperSettings(far=FarSettings(stretch=5.0, room=3.0))
    mapper = FixedLagMapper(settings, log.odometry_sigma)
    mapper.smoother = smoother = Checked(settings)
    map_log(log, mapper)
    assert mapper.closed
    assert smoother.checked > 0.5 * len(log.cycles)
    assert smoother.worst < 1e-8
