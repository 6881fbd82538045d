"""Settings of the batch optimization over a whole log."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class BatchSettings(Positive):
    """Describes the batch optimization over a whole log."""

    size: int | None = None
    """Both boundaries together have this number of control points; where it is not given, the number of cones
    decides."""
    size_share: float = 0.43
    """The number of control points is at most this share of the number of distinct cones that were detected
    (the paper has 0.44)."""
    sigma_model: float = 0.05
    """This is the standard deviation (m) of a cone's distance from the curves that are solved for; its square
    is added to the variance of each detection across them. Online it is larger (`spline.sigma_model`), since
    the curves have fewer control points there."""
    sigma_smoothness: float = 0.4
    """This is the standard deviation of the second difference of control points, as a share of their spacing.
    It is smaller than online, since a curve between cones that were never detected has many shapes that fit
    equally well, and each start would end in its own."""
    sigma_slide: float = 0.2
    """A control point slides along its curve by this standard deviation (m) from its place beside the pose
    that it began beside."""
    gate: float = 4.0
    """Tukey's loss has this width: a detection farther from its curve than this number of standard deviations
    has no weight."""
    pose_steps: int = 3
    """The poses alone take this number of Gauss-Newton steps at first, while the map of the start is held."""
    rough_rounds: int = 24
    """The first optimization, on knots that follow the start, has at most this number of rounds."""
    rough_tolerance: float = 8.0
    """The tolerances are multiplied by this in the first optimization."""
    dense_share: float = 1.0
    """The curves that are solved for have this number of control points for each cone, so that they meet the
    cones. The map's own curves have fewer, and are fitted to them in the end."""
    knot_passes: int = 2
    """The dense curves are solved for at most this number of times; more than once only if the number of
    cones has changed."""
    max_rounds: int = 80
    """The optimization has at most this number of rounds, each with new foot points, gates and weights; one
    that uses them all is reported as not converged."""
    loose_gate: float = 8.0
    """The first round uses detections within this number of standard deviations from a curve."""
    gate_factor: float = 0.7
    """The gate is multiplied by this from each round to the next, down to `gate`."""
    damping: float = 1e-2
    """This is the first damping of control points (1/m^2)."""
    damping_up: float = 5.0
    """The damping is multiplied by this after a step that increased the cost."""
    damping_down: float = 0.1
    """The damping is multiplied by this after a step that decreased the cost."""
    damping_least: float = 1e-6
    """The damping is at least this (1/m^2)."""
    damping_most: float = 1e6
    """A round ends without a step if the cost still increases at this damping (1/m^2)."""
    share_least: float = 0.3
    """A step is extended to the sum of those that would follow it if its ratio to the step before is larger
    than this."""
    share_most: float = 0.97
    """A step is not extended if its ratio to the step before is larger than this."""
    tolerance_cost: float = 1e-5
    """The optimization has converged when |cost_before - cost_after| <= tolerance_cost * cost_before, and the
    other two tolerances hold."""
    tolerance_curve: float = 2e-3
    """At convergence, no point of a curve moved farther than this across it in a round (m)."""
    tolerance_pose: float = 2e-3
    """At convergence, no pose moved farther than this in a round (m, and rad)."""
