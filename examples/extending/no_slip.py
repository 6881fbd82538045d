import numpy as np

from pathspace_graph.factors.se2 import left_of
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import pose_keys

SIGMA = 0.005
"""Distance (m) by which a car slips sideways from one cycle to the next."""


def no_slip_rows(variables, cycles):
    """Return `n . (t' - t) / sigma` from cycles (m,) to the next ones; n is normal to the mean heading."""
    cycles = cycles[cycles < variables.first_cycle + len(variables.poses) - 1]  # the newest has no next one
    poses, after = variables.poses_at(cycles), variables.poses_at(cycles + 1)
    step, heading = (after - poses)[:, :2], 0.5 * (poses + after)[:, 2]
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    left, turn = left_of(ahead), -0.5 * (ahead * step).sum(axis=1, keepdims=True)
    jacobian = np.hstack([-left, turn, left, turn]) / SIGMA
    keys = pose_keys(np.column_stack([cycles, cycles + 1]))
    return Rows(keys, jacobian, (left * step).sum(axis=1) / SIGMA, cycles)
