"""The same mapper on GTSAM's `IncrementalFixedLagSmoother`: what a frozen linearization costs.

Classification, growth, closing and simplification are the mapper's own; factors are the same, as GTSAM has
them. When a pose leaves, GTSAM keeps its marginal at the linearization point of every variable that it
touches, which are control points, and these are never relinearized again. Where the loop closes, the smoother
starts anew from the prior, since neither moved poses nor other variables can be handed to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .fixed_lag import FixedLagMapper
from .incremental_smoother import IncrementalSmoother
from .settings import MapperSettings

Array = NDArray[np.float64]


class IncrementalFixedLag(FixedLagMapper):
    """`FixedLagMapper`, its window solved by GTSAM's smoother. It takes no factors of the user's."""

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        super().__init__(settings, odometry_sigma)
        self.smoother = IncrementalSmoother(self.settings)
