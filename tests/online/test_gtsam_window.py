"""GTSAM solves the mapper's own system, in every ordering."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, keys_of
from pathspace_graph.graph.variables import are_poses
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings

from ..scenes.drives import bean_track, lap_log, map_log


@pytest.fixture
def mapper() -> FixedLagMapper:
    """In a bend, with a full window, all of the map in it, every factor linearized anew in each step."""
    log = lap_log(bean_track())
    settings = MapperSettings(relinearize=RelinearizeSettings(1e-12, 1e-12))
    own = FixedLagMapper(settings, log.odometry_sigma)
    mapper = map_log(replace(log, cycles=log.cycles[:60]), own)[0]
    mapper.road.smoother.reactivate()
    return mapper


def linear_window(mapper: FixedLagMapper) -> gtsam.GaussianFactorGraph:
    """The window with the whole map, linearized at its estimate, and the damping of a step."""
    smoother, keys = mapper.road.smoother, mapper.road.smoother.map.state.map_keys
    smoother.refresh()
    now, sigma = (
        smoother.variables.change(smoother.variables.layout.entries(keys)),
        mapper.settings.sigma_step,
    )
    damping = jacobian_factor(keys, np.eye(len(now)) / sigma, now / sigma)
    return graph_of(damping, smoother.linear_graph(whole=True))


@pytest.mark.parametrize("ordering", ["none", "COLAMD", "poses first"])
def test_gtsam_solves_the_system_that_the_mapper_solves(mapper: FixedLagMapper, ordering: str) -> None:
    """In every ordering; the window is left as it is."""
    variables = mapper.road.smoother.variables
    before = variables.values.copy()
    window = linear_window(mapper)
    np.testing.assert_array_equal(variables.values, before)
    keys = keys_of(window)
    orderings = {
        "COLAMD": gtsam.Ordering.ColamdGaussianFactorGraph(window),
        "poses first": gtsam.Ordering(keys[np.argsort(~are_poses(keys), kind="stable")].tolist()),
    }
    solution = window.optimize(*[orderings[ordering]] if ordering in orderings else ())
    mapper.road.smoother.step(mapper.settings.sigma_step)
    now = variables.change(np.arange(variables.layout.size))
    np.testing.assert_allclose(solution.vector(variables.keys.tolist()), now, atol=1e-7)
