"""GTSAM solves the mapper's own system, in every ordering; never how fast."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pathspace_graph.eval.benchmark.rivals import linear_window, marginal_keys, orderings, time_gtsam
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings

from ...scenes.drives import bean_track, lap_log, map_log


@pytest.fixture
def mapper() -> FixedLagMapper:
    """In a bend, with a full window, all of the map in it, every factor linearized anew in each step."""
    log = lap_log(bean_track())
    settings = MapperSettings(relinearize=RelinearizeSettings(1e-12, 1e-12))
    own = FixedLagMapper(settings, log.odometry_sigma)
    mapper = map_log(replace(log, cycles=log.cycles[:60]), own)[0]
    mapper.smoother.reactivate()
    return mapper


@pytest.mark.parametrize("number", range(3))
def test_gtsam_solves_the_system_that_the_mapper_solves(mapper: FixedLagMapper, number: int) -> None:
    """In every ordering; the window is left as it is."""
    variables = mapper.smoother.variables
    before = variables.values.copy()
    window = linear_window(mapper)
    np.testing.assert_array_equal(variables.values, before)
    ordering = list(orderings(window).values())[number]
    solution = window.graph.optimize() if ordering is None else window.graph.optimize(ordering)
    mapper.smoother.step(mapper.settings.sigma_step)
    now = variables.change(np.arange(variables.layout.size))
    np.testing.assert_allclose(solution.vector(variables.keys.tolist()), now, atol=1e-7)


def test_the_marginal_is_on_the_map_and_the_next_pose(mapper: FixedLagMapper) -> None:
    window = linear_window(mapper)
    keys, everything = marginal_keys(window), window.layout
    assert len(keys) == len(mapper.smoother.map.state.map_keys) + 3  # calibrations of odometry and sensor
    assert keys[-1] == gtsam.symbol("x", mapper.smoother.first_cycle + 1)
    hessian, _ = window.graph.hessian(everything.ordering)
    covariance = np.linalg.inv(hessian)
    own = everything.entries(np.array(keys))
    marginal, _ = window.graph.marginal(gtsam.KeyVector(keys)).hessian(gtsam.Ordering(keys))
    expected = np.linalg.inv(covariance[np.ix_(own, own)])
    np.testing.assert_allclose(marginal, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_every_candidate_is_timed(mapper: FixedLagMapper) -> None:
    timings = time_gtsam(linear_window(mapper))
    assert len(timings) == 3
    assert all(optimize > 0.0 and marginal > 0.0 for optimize, marginal in timings.values())
