"""Settings of the batch optimization over a whole log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .checked import Positive

Start = Literal["online", "odometry"]


@dataclass(frozen=True)
class BatchSettings(Positive):
    """The batch optimization over a whole log."""

    start: Start = "online"
    """The optimization begins at the map of an online run over the log, or at odometry alone."""
    size: int | None = None
    """Control points of both boundaries together; where not given, the readings decide."""
    size_share: float = 0.43
    """Most control points as a share of the distinct cones sighted (the paper has 0.44)."""
    sigma_model: float = 0.05
    """How far cones stand off the curve that is solved for (m, one sigma), added to each reading across it.
    Online it is larger (`spline.sigma_model`), as the curve has fewer control points there."""
    sigma_smoothness: float = 0.4
    """Second difference of control points, as a share of their spacing: stronger than online's, as a curve
    between cones that were never seen has many shapes that fit as well, and each start ends in its own."""
    sigma_slide: float = 0.2
    """How far (m) a control point slides along its curve from beside the pose that it began beside."""
    gate: float = 4.0
    """Width of Tukey's loss: a reading farther than so many sigmas from its curve says nothing."""
    pose_steps: int = 3
    """Gauss-Newton steps of the poses alone, beside the map that the start has found."""
    rough_rounds: int = 24
    """Most rounds of a first optimization, on knots that the start decides."""
    rough_tolerance: float = 8.0
    """Multiplies the tolerances below in the first optimization."""
    dense_share: float = 1.0
    """Control points by cones of the curves that are solved for: they meet the cones. The map's own, fewer,
    are fitted to them in the end."""
    knot_passes: int = 2
    """Most times that they are solved for: once, unless the cones' number has changed then."""
    max_rounds: int = 80
    """Steps, each with new foot points, gates and weights; the last of them is told as not converged."""
    loose_gate: float = 8.0
    """The first round uses readings within so many sigmas of a curve."""
    gate_factor: float = 0.7
    """Multiplies the gate from each round to the next, down to `gate`."""
    damping: float = 1e-2
    """First hold on control points (1/m^2)."""
    damping_up: float = 5.0
    """Multiplies the damping after a step that made the cost larger."""
    damping_down: float = 0.1
    """Multiplies the damping after a step that made the cost smaller."""
    damping_least: float = 1e-6
    """Least damping (1/m^2)."""
    damping_most: float = 1e6
    """Damping (1/m^2) at which no step is left that makes it better."""
    share_least: float = 0.3
    """Least share of the step before at which a step is tried as far as those that would follow lead."""
    share_most: float = 0.97
    """Largest such share."""
    tolerance_cost: float = 1e-5
    """Converged where |cost_before - cost_after| <= tolerance * cost_before, and both below hold."""
    tolerance_curve: float = 2e-3
    """No point of a curve moved farther than this across it (m)."""
    tolerance_pose: float = 2e-3
    """No pose moved farther than this (m, and rad)."""
