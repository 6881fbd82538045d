"""Settings of fits, of the batch over a whole log, and of the estimators to compare with."""

from dataclasses import dataclass, field
from typing import Literal

from pathspace_graph.settings.checked import Positive

Knots = Literal["cones", "curvature"]  # what the knots of a closed boundary follow
Start = Literal["auto", "online", "odometry"]


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
    """Least correlation of the curvature with itself a lap later: 0.92 and more in true laps, 0.89 at most
    in two loops side by side."""
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
    """Most cycles by which a batch may be late, after which it is given up, as with more than `max_poses`."""
    ends: tuple[int, ...] = ()
    """Cycles in which the batches replace the prior in a replay: `batches.ends` of `summary.json`."""
    retry: float = 20.0
    """Length of path to the next attempt at a loop that the detections were against (m)."""
    max_cycles: float = 6000.0
    """Most cycles of an open lap that is solved as a batch; a longer one is left to the window."""
    max_cones: float = 1500.0
    """Most cones of a lap that is solved as a batch, since with more it would not be in time."""


@dataclass(frozen=True)
class BatchSettings(Positive):
    """The batch optimization over a whole log."""

    start: Start = "auto"
    """Start of the optimization: odometry alone, or the map of an online run over the log. With `auto` it is
    odometry where laps recur and the detections are for the closed loop, else an online run."""
    size_share: float = 0.43
    """Most control points as a share of the distinct cones that were detected (the paper has 0.44)."""
    dense_share: float = 1.0
    """Control points for each cone of the curves that are solved for, which the map's are fitted to."""
    sigma_model: float = 0.05
    """Standard deviation (m) of a cone's distance from the curves that are solved for; `spline.sigma_model`
    online, where they have fewer control points."""
    sigma_smoothness: float = 0.4
    """Standard deviation of the second difference of control points, as a share of their spacing: smaller
    than online, so that a curve between cones that were never detected has one best shape."""
    sigma_slide: float = 0.2
    """Standard deviation of a control point's slide along its curve from beside its first pose (m)."""
    gate: float = 4.0
    """Width of Tukey's loss: distance beyond which a detection has no weight, in standard deviations."""
    association: AssociationSettings = field(default_factory=AssociationSettings)
    closure: ClosureSettings = field(default_factory=ClosureSettings)


@dataclass(frozen=True)
class CkfSettings(Positive):
    """The paper's filters."""

    ridge: float = 0.05
    """Lambda of the ridge regression, which holds control points at their places (paper: Update)."""
    sigma_model: float = 0.25
    """Standard deviation of a cone's distance from a smooth curve (m), added in each detection."""
    sigma_along: float = 1.0
    """Standard deviation of a cone's distance along the curve from its foot point (m), added likewise."""
    threshold: float = 4.0
    """Growth threshold (m): a detection nearer to the end updates the curve instead of extending it."""
    separation: float = 4.0
    """Least distance of an extension from the second-to-last control point (m)."""
    sigma_bend: float = 0.5
    """Standard deviation of the second difference of the control points that an extension moves or adds, as a
    share of their spacing. A large value gives the filter as it is published, whose uncertainty multiplies
    with each extension."""
    knots: Knots = "curvature"
    """What the knots of a closed boundary follow; curvature in the paper."""
    sightings: int = 3
    """Detections that make a landmark of the baseline filter; 1, as it is described, takes every one."""


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """The Hungarian landmark graph."""

    match: float = 0.95
    """Probability of the gate inside which a detection may be of a landmark."""
    create: float = 0.99
    """Probability of the gates of all landmarks of its colour outside of which a detection may be new."""


@dataclass(frozen=True)
class CenterlineSettings(Positive):
    """The estimators that map a track as one centre line with a width."""

    spacing: float = 3.0
    """Distance of the knots of the centre line (m)."""
    sigma_width: float = 0.3
    """Standard deviation (m) of the second difference of the half widths at neighbouring control points."""
