import numpy as np
from compass import compass_factor

from pathspace_graph import BatchMapper, FixedLagMapper
from pathspace_graph.graph.variables import pose_key

SIGMA = 0.01  # standard deviation of a heading (rad)


class Compass:
    """A compass for every mapper that inherits from it; here its readings are drawn about the truth."""

    def factors(self, log):
        t = np.array([cycle.t for cycle in log.cycles])
        headings = np.interp(t, log.truth.pose_t, np.unwrap(log.truth.poses[:, 2]))
        headings += np.random.default_rng(len(t)).normal(0.0, SIGMA, len(t))
        return [compass_factor(pose_key(k), heading, SIGMA) for k, heading in enumerate(headings)]


class CompassFixedLag(Compass, FixedLagMapper):
    """The online mapper with a compass."""


class CompassBatch(Compass, BatchMapper):
    """The batch with a compass, which may begin in the online map."""

    def __init__(self, settings, noise):
        super().__init__(settings, noise, CompassFixedLag)
