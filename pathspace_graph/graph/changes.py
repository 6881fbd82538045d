"""What happens to a smoother once: its loop is solved, its points become others, its prior another one."""

from typing import Final

import gtsam
import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray

from .gaussian import (
    HeldMap,
    absolute_factor,
    graph_of,
    marginalize,
    merge_variables,
)
from .inactive import InactiveMap
from .relative import RelativeFactor
from .smoother import FixedLagSmoother
from .variables import pose_keys
from .window import MapRows

Smoother = FixedLagSmoother[MapRows]

STIFFNESS: Final = 1e4  # information about a gauge that is held, by that from measurements


# --- the loop --------------------------------------------------------------------------------------------


def solve_loop(smoother: Smoother, iterations: int, sigma_step: float | None) -> dict[int, Array]:
    """Optimize the whole drive on its submaps, each relinearized in its own frame.

    Return the poses (3,) of the keyframes by cycle. Without submaps, since a user's factors are absolute, the
    prior keeps its linearization point, and there are no keyframes.
    """
    smoother.reactivate(with_prior=smoother.submaps is None)
    submaps, smoother.submaps = smoother.submaps, None
    if submaps is not None:
        submaps.finish(smoother.variables)
        submaps.insert_keyframes(smoother.variables)
    for _ in range(iterations):
        if submaps is not None:
            smoother.prior = submaps.graph(smoother.variables)
        smoother.step(sigma_step)
    keyframes = submaps.place(smoother.variables) if submaps is not None else {}
    smoother.marginalize_keyframes()
    return keyframes


def solve_revisit(
    smoother: Smoother, measured: RelativeFactor, iterations: int, sigma_step: float | None
) -> dict[int, Array]:
    """Optimize an open map with the window's oldest pose measured in the frame of a keyframe.

    The measurement is one of the submaps from now on. Return the poses (3,) of the keyframes by cycle.
    """
    submaps = smoother.submaps
    assert submaps is not None
    submaps.finish(smoother.variables)
    submaps.finished.append(measured)
    keyframes = solve_loop(smoother, iterations, sigma_step)
    smoother.submaps = submaps
    return keyframes


# --- other map points ------------------------------------------------------------------------------------


def merge_points(smoother: Smoother, removed: IntArray, kept: IntArray) -> None:
    """Merge map points `removed` (k,) into points `kept` (k,), which keep their values.

    Submaps do not follow, so the loop must be closed. The map's rows must be on the kept keys afterwards.
    """
    variables, user = smoother.variables, smoother.user_factors.remove(removed, smoother.variables)
    reference, layout = variables.reference, variables.layout
    offset = reference[layout.entries(kept)] - reference[layout.entries(removed)]
    smoother.prior = merge_variables(graph_of(smoother.prior, *user), removed, kept, offset)
    variables.remove(removed)
    smoother.window.clear()


def place_again(smoother: Smoother, keys: IntArray, points: Array, sigma: float) -> None:
    """Move map points (k,) of a closed map to `points` (k, 2), and forget what was known of them.

    They have a prior with a standard deviation sigma (m) about their new places.
    """
    smoother.remove_information(keys)
    variables = smoother.variables
    variables.values[variables.layout.entries(keys)] = points.ravel()
    root = np.eye(points.size) / sigma
    smoother.prior = graph_of(smoother.prior, absolute_factor(keys, root, variables))
    smoother.window.clear()


# --- another prior ---------------------------------------------------------------------------------------


def hold_motion(smoother: Smoother, keys: IntArray, across: Array) -> None:
    """Hold where a closed map as a whole is, and go on to estimate its shape.

    The rows C `across` (3, 2k) give the rigid motion (x, y, theta) by `C dx`, for moves dx of the points
    (k,), ascending.
    """
    smoother.reactivate()
    known = smoother.covariance(keys)
    information = STIFFNESS * np.linalg.inv(across @ known @ across.T)
    root = np.linalg.cholesky(information).T @ across
    smoother.prior = graph_of(smoother.prior, absolute_factor(keys, root, smoother.variables))
    smoother.held = HeldMap(keys, known)


def forget_poses(smoother: Smoother, first_cycle: int) -> None:
    """Remove the poses before `first_cycle`, and all prior information about where the poses are.

    The later poses keep their odometry, and one of them must be given a prior by `add_pose_prior`.
    """
    smoother.reactivate()
    smoother.submaps = None
    leaving = pose_keys(np.arange(smoother.first_cycle, first_cycle))
    user = smoother.user_factors.remove(leaving, smoother.variables)
    smoother.prior = marginalize(graph_of(smoother.prior, *user), pose_keys(smoother.cycles))
    _drop_before(smoother, first_cycle)


def restart(smoother: Smoother, first_cycle: int, removed: IntArray, added: IntArray, points: Array) -> None:
    """Replace map points `removed` (n,) by `added` (k,) at `points` (k, 2), and drop the prior.

    Poses before `first_cycle` leave the window. A new prior must be set, on all that remains.
    """
    smoother.submaps, smoother.inactive = None, InactiveMap()
    smoother.held, smoother.prior = None, gtsam.GaussianFactorGraph()
    smoother.variables.remove(np.append(smoother.variables.keyframes, removed))
    _drop_before(smoother, first_cycle)
    smoother.variables.insert(added, points.ravel())


def _drop_before(smoother: Smoother, first_cycle: int) -> None:
    """Remove the poses before a cycle, and all factors of the window."""
    leaving = np.arange(smoother.first_cycle, first_cycle)
    smoother.user_factors.remove(pose_keys(leaving), smoother.variables)
    for cycle in leaving.tolist():
        smoother.drop_oldest(cycle)
    smoother.variables.first_cycle = first_cycle
    smoother.variables.remove(pose_keys(leaving))
    smoother.window.clear()


def set_prior(smoother: Smoother, keys: IntArray, mean: Array, information: Array) -> None:
    """Set the prior to a Gaussian of ascending keys (k,), with mean (n,) and information (n, n)."""
    root = np.asarray(np.linalg.cholesky(information).T, np.float64)
    prior = absolute_factor(keys, root, smoother.variables, mean)
    smoother.prior = graph_of(gtsam.HessianFactor(graph_of(prior)))
