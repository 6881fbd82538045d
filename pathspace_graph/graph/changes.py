"""What happens to a smoother once: its points become others, its prior another one."""

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
from .smoother import FixedLagSmoother
from .variables import pose_keys
from .window import MapRows

Smoother = FixedLagSmoother[MapRows]

STIFFNESS: Final = 1e4  # information about a gauge that is held, by that from measurements


# --- other map points ------------------------------------------------------------------------------------


def merge_points(smoother: Smoother, removed: IntArray, kept: IntArray) -> None:
    """Merge map points `removed` (k,) into points `kept` (k,), which keep their values.

    The map's rows must be on the kept keys afterwards.
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
    leaving = pose_keys(np.arange(smoother.first_cycle, first_cycle))
    user = smoother.user_factors.remove(leaving, smoother.variables)
    smoother.prior = marginalize(graph_of(smoother.prior, *user), pose_keys(smoother.cycles))
    _drop_before(smoother, first_cycle)


def restart(smoother: Smoother, first_cycle: int, removed: IntArray, added: IntArray, points: Array) -> None:
    """Replace map points `removed` (n,) by `added` (k,) at `points` (k, 2), and drop the prior.

    Poses before `first_cycle` leave the window. A new prior must be set, on all that remains.
    """
    smoother.inactive = InactiveMap()
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


def exchange_calibration_priors(smoother: Smoother, included: tuple[Array, Array]) -> None:
    """Exchange the calibrations' priors that a new prior includes for those that the smoother has now."""
    present, smoother.calibration_prior = smoother.calibration_prior, included
    smoother.set_calibration_priors(*present)
