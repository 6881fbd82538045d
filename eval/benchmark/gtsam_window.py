"""GTSAM's own elimination of the mapper's window, which the mapper's speed is compared with.

GTSAM is timed on the mapper's graph after a cycle, with the whole map in it and already linearized: neither
linearization nor the building of a graph counts. It does `optimize()` and `marginal(map, calibration, next
pose)`, once each, under the best conditions for it. Prior, weak priors and damping come as one Hessian
factor. The window is solved in each of several orderings, and the time to find an ordering is not counted.
Each call is made once untimed before it is timed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from pathspace_graph.graph.gaussian import as_hessian_factor, factors_of, graph_of, jacobian_factor, keys_of
from pathspace_graph.graph.variables import Layout, are_poses
from pathspace_graph.online.fixed_lag import FixedLagMapper


@dataclass(frozen=True, eq=False)
class LinearWindow:
    """A window with the whole map, linearized at its estimate."""

    graph: gtsam.GaussianFactorGraph
    """A factor for each cycle, and one for prior, weak priors and damping together."""
    layout: Layout


def linear_window(mapper: FixedLagMapper) -> LinearWindow:
    """Return the window of a mapper between two cycles; the mapper stays as it is."""
    smoother = mapper.smoother
    smoother.refresh()
    factors = factors_of(smoother.linear_graph(whole=True))
    cycles = [factor for factor in factors if _is_of_cycle(factor)]
    priors = [factor for factor in factors if not _is_of_cycle(factor)]
    combined_priors = as_hessian_factor(graph_of(_damping(mapper), *priors))
    graph = graph_of(combined_priors, *cycles)
    return LinearWindow(graph, Layout(keys_of(graph)))  # an open map hangs on poses of its own


def _is_of_cycle(factor: gtsam.GaussianFactor) -> bool:
    """Return whether a factor holds the rows of a cycle; else it is the prior or holds weak priors."""
    has_rows = isinstance(factor, gtsam.JacobianFactor)
    return has_rows and bool(are_poses(np.array(list(factor.keys()), np.intp)).any())


def _damping(mapper: FixedLagMapper) -> gtsam.GaussianFactor:
    keys, variables = mapper.smoother.map.state.map_keys, mapper.smoother.variables
    now, sigma = variables.change(variables.layout.entries(keys)), mapper.settings.sigma_step
    return jacobian_factor(keys, np.eye(len(now)) / sigma, now / sigma)


def orderings(window: LinearWindow) -> dict[str, gtsam.Ordering | None]:
    """Return the orderings that `optimize` may be given: none, COLAMD's, or poses before the rest."""
    keys = window.layout.keys
    shared = ~are_poses(keys)
    return {
        "no ordering given": None,
        "COLAMD given": gtsam.Ordering.ColamdGaussianFactorGraph(window.graph),
        "poses first": gtsam.Ordering(keys[np.argsort(shared, kind="stable")].tolist()),
    }


def marginal_keys(window: LinearWindow) -> list[int]:
    """Return what the marginal prior is on when the oldest pose leaves: map, calibration, next pose."""
    keys = window.layout.keys
    poses = are_poses(keys)
    staying: list[int] = np.append(keys[~poses], keys[poses][1:2]).tolist()
    return staying


def time_gtsam(window: LinearWindow) -> dict[str, tuple[float, float]]:
    """Return the processor times (s) of (`optimize`, `marginal`) by ordering, once each."""
    graph, staying = window.graph, gtsam.KeyVector(marginal_keys(window))
    marginal = _seconds(partial(graph.marginal, staying))
    return {
        name: (_seconds(partial(graph.optimize, *(() if ordering is None else (ordering,)))), marginal)
        for name, ordering in orderings(window).items()
    }


def _seconds(call: Callable[[], object]) -> float:
    """Return the processor time (s) of the second of two calls."""
    call()
    begin = time.thread_time()
    call()
    return time.thread_time() - begin
