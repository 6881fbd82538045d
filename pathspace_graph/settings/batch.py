"""Settings of the batch optimization over a whole log."""

from dataclasses import dataclass, field
from typing import Literal

from .checked import Positive

Start = Literal["online", "odometry"]


@dataclass(frozen=True)
class AssociationSettings(Positive, group="batch.association"):
    """Places of poses and detections along the curves."""

    step: float = 1.0
    """Step at which nearest points of a curve are first searched for (m along the curve)."""
    direction_penalty: float = 100.0
    """Distance added in quadrature to a stretch of curve that runs against a pose's heading (m)."""
    room: float = 2.0
    """Most by which two poses may be farther apart along an open curve than was driven between them (m)."""


@dataclass(frozen=True)
class ClosureSettings(Positive, group="batch.closure"):
    """When a loop is tried that no registration has closed, and when its result is believed."""

    laps: float = 1.3
    """Least length of the path driven, in laps."""
    min_correlation: float = 0.9
    """Least correlation of the curvature with itself a lap later, 1 where it is the same. Of two loops side
    by side the second agrees with the first to 0.89 at most; a true lap agrees to 0.92 and more."""
    used: float = 0.75
    """Least share of the first lap's coloured detections on the curves of a closed result."""


@dataclass(frozen=True)
class OpenLapSettings(Positive, group="open_lap"):
    """Batch over the open lap when the loop closes online."""

    UNLIMITED = ("max_cycles", "max_cones")

    prior: Literal["batch", "window"] = "batch"
    """Prior after closing: a batch over the open lap, or with `window` what the window has marginalized."""
    cycles: int = 20
    """Cycles after closing at which the batch replaces the prior, or as many as the window holds."""
    cycles_share: float = 0.03
    """Share of a long lap's cycles that replaces `cycles` where it is more; the window grows until then."""
    late: int = 100
    """Most cycles by which a batch may be late: it replaces the prior once it is solved, and is given up
    after that, or where the window would hold more than `max_poses` poses."""
    ends: tuple[int, ...] = ()
    """Cycles in which the batches replace the prior in a replay, one after the other: those that
    `summary.json` has as `batches.ends`. Later ones do so when they are due."""
    retry: float = 20.0
    """Length of path to the next attempt at a loop that the detections were against (m)."""
    max_cycles: float = 6000.0
    """Most cycles of the open lap whose measurements are kept. After a longer lap the map goes on from what
    the window has marginalized."""
    max_cones: float = 1500.0
    """Most cones of a lap that is solved as a batch. With more the map goes on from what the window has
    marginalized, since the batch would not be in time."""


@dataclass(frozen=True)
class BatchSettings(Positive):
    """The batch optimization over a whole log."""

    start: Start = "online"
    """Start of the optimization: the map of an online run over the log, or odometry alone."""
    size: int | None = None
    """Number of control points of both boundaries together; by default the number of cones decides."""
    size_share: float = 0.43
    """Most control points as a share of the distinct cones that were detected (the paper has 0.44)."""
    dense_share: float = 1.0
    """Control points for each cone of the curves that are solved for, so that they meet the cones. The map's
    own curves have fewer, and are fitted to them in the end."""
    sigma_model: float = 0.05
    """Standard deviation (m) of a cone's distance from the curves that are solved for; its square is added to
    the variance of each detection across them. Online it is larger (`spline.sigma_model`), since the curves
    have fewer control points there."""
    sigma_smoothness: float = 0.4
    """Standard deviation of the second difference of control points, as a share of their spacing. It is
    smaller than online, since a curve between cones that were never detected has many shapes that fit equally
    well, and each start would end in its own."""
    sigma_slide: float = 0.2
    """Standard deviation of a control point's slide along its curve from beside its first pose (m)."""
    gate: float = 4.0
    """Width of Tukey's loss: distance beyond which a detection has no weight, in standard deviations."""
    association: AssociationSettings = field(default_factory=AssociationSettings)
    """Places of poses and detections along the curves."""
    closure: ClosureSettings = field(default_factory=ClosureSettings)
    """Loops that no registration has closed."""
