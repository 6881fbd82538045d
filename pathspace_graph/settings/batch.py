"""Settings of the batch optimization over a whole log."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .checked import Positive

Start = Literal["online", "odometry"]


@dataclass(frozen=True)
class RecurrenceSettings(Positive, group="batch.recurrence"):
    """Describes how a start from odometry finds the length of a lap."""

    profile_step: float = 0.5
    """The curvature of the path driven is sampled at this step (m)."""
    smoothing: float = 3.0
    """The curvature is averaged over this length (m)."""
    correlation_share: float = 0.8
    """The curvature is correlated with itself a lag later. A lap is about the shortest lag whose correlation
    is at least this share of the largest one."""
    min_correlation: float = 0.7
    """The curvature agrees with itself a lap later to this degree at least, 1 where it is the same. On a
    track of two loops of which one is wider, it agrees to 0.56 at most after one of them."""
    min_overlap: float = 20.0
    """The path must go on for this length (m) after a lap, or else the lap isn't found. Over less, straights
    agree with straights."""


@dataclass(frozen=True)
class LapCorrespondenceSettings(Positive, group="batch.laps"):
    """Describes how a start from odometry makes every lap pass the same places."""

    reference_step: float = 8.0
    """The reference poses that every lap passes are this distance (m) apart."""
    sigma_position: float = 1.5
    """The position of a lap differs from a reference pose that it passes by this (m, one sigma)."""
    sigma_heading: float = 0.15
    """The heading of a lap differs from that of a reference pose that it passes by this (rad, one sigma)."""
    max_steps: int = 8
    """The laps are brought together by this number of Gauss-Newton steps at most."""
    tolerance: float = 1e-6
    """The laps are brought together when a Gauss-Newton step moves nothing farther than this (m, rad)."""

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Returns the standard deviations (m, m, rad) of a pose about its reference pose."""
        return self.sigma_position, self.sigma_position, self.sigma_heading


@dataclass(frozen=True)
class ConeSettings(Positive, group="batch.cones"):
    """Describes how the detections along a curve are clustered to cones."""

    density_step: float = 0.1
    """Cones are peaks of the density of detections along a curve, which is sampled at this step (m)."""
    separation: float = 0.6
    """Two cones are at least this share of `growth.merge_radius` apart along a curve. It is less than 1, as
    the inner curve of a bend is shorter than the distances of its cones add up to."""
    bandwidth: float = 0.4
    """The density is smoothed with a Gaussian. Its standard deviation is this share of the least distance
    that `separation` sets."""
    sigma: float = 0.6
    """Largest standard deviation of detections that say where a cone stands, m."""
    sharp_share: float = 0.1
    """All detections say it where fewer than this share of them is that certain."""
    min_share: float = 0.1
    """A cluster with fewer detections than this share of the median cluster's is no cone."""
    min_share_beside: float = 0.3
    """A cluster beside a curve, whose detections aren't used, is no cone if it has fewer detections than this
    share of the median cluster's."""
    max_lateral: float = 15.0
    """In a start from odometry, a boundary has detections nearer to the driven path than this (m)."""
    min_count: int = 4
    """A curve is fitted to no fewer cones than this, and no cone is removed where there are fewer."""
    fold_cosine: float = 0.5
    """The row of cones folds back at a cone where the cosine of its turn is less than minus this value."""
    fold_distance: float = 1.5
    """A cone at which the row folds back is a duplicate if its nearer neighbour is closer than this (m)."""


@dataclass(frozen=True)
class AssociationSettings(Positive, group="batch.association"):
    """Describes how poses and detections are placed along the curves."""

    step: float = 1.0
    """Nearest points of a curve are first searched for at this step (m along the curve)."""
    direction_penalty: float = 100.0
    """A stretch of curve that runs against a pose's heading counts as this much farther away (m)."""
    room: float = 2.0
    """Along an open curve, the place of a pose is at most this farther from that of the pose before than was
    driven between them (m)."""


@dataclass(frozen=True)
class FootPointSettings(Positive, group="batch.foot_points"):
    """Describes how foot points are computed: more exactly than online, since an optimum needs it."""

    refine_room: float = 8.0
    """A foot point is followed this far (m along the curve) in an optimization step. The batch uses this
    instead of `spline.refine_room`."""
    refine_iterations: int = 2
    """A foot point is refined by this number of Newton steps in an optimization step. The batch uses this
    instead of `spline.refine_iterations`."""
    search_iterations: int = 4
    """A global search for a foot point ends with this number of Newton steps. The batch uses this instead of
    `spline.search_iterations`."""


@dataclass(frozen=True)
class ScatterSettings(Positive, group="batch.scatter"):
    """Describes how the distance of cones from the map's curves is measured."""

    folds: int = 4
    """The cross-validation deals the cones in turn into this number of groups, and leaves out one group at a
    time. So the neighbours of a cone that is left out are always there."""
    foot_room: float = 1.5
    """The foot point of a cone is searched within this distance (m along the curve) of its own place."""


@dataclass(frozen=True)
class ClosureSettings(Positive, group="batch.closure"):
    """Describes when a loop is tried that no registration has closed, and when its result is believed."""

    laps: float = 1.3
    """The loop is tried where the path driven is at least this number of laps long."""
    min_correlation: float = 0.9
    """The loop is tried where the curvature agrees with itself a lap later to this degree at least, 1 where
    it is the same. Of two loops side by side the second agrees with the first to 0.89 at most; a true lap
    agrees to 0.92 and more."""
    used: float = 0.75
    """A closed result has at least this share of the first lap's coloured detections on its curves."""
    used_again: float = 0.85
    """The share of those after the first lap is at least this part of it."""
    misfit: float = 1.5
    """A closed result has detections after the first lap that are this number of sigmas from their curves at
    most (root mean square)."""
    gap: float = 25.0
    """A closed result has no longer stretch of a boundary without detections on it than this (m)."""
    overlap: float = 15.0
    """A closed result has been driven again over this length at least (m)."""
    sigma: float = 0.3
    """The detections after the first lap hold their drive beside the curves by this standard deviation at
    most (m), in every direction."""


@dataclass(frozen=True)
class OpenLapSettings(Positive, group="open_lap"):
    """Describes how the open lap is solved as a batch when the loop closes online."""

    UNLIMITED = ("max_cycles", "max_cones")

    prior: Literal["batch", "window"] = "batch"
    """After closing, the map goes on from a batch over the open lap, or with `window` from what the window
    has marginalized."""
    cycles: int = 20
    """The batch replaces the prior this number of cycles after the loop has closed, or as many as the window
    holds."""
    cycles_share: float = 0.03
    """A long lap gives its batch more time: this share of its cycles, if that is more than `cycles`. The
    window holds more poses until then."""
    late: int = 100
    """A batch that is not solved by then replaces the prior once it is, and is given up where it is later
    than this number of cycles, or where the window would hold more than `max_poses` poses."""
    ends: tuple[int, ...] = ()
    """In a replay, the batches replace the prior in these cycles, one after the other: those that
    `summary.json` has as `batches.ends`. Later ones do so when they are due."""
    rough_rounds: int = 8
    """The first optimization has at most this number of rounds."""
    rounds: int = 20
    """The second optimization, on knots that follow the result of the first, has at most this number of
    rounds."""
    rounds_from_odometry: int = 24
    """A batch that begins at odometry, since no registration has closed the loop, has at most this number of
    rounds in each optimization."""
    retry: float = 20.0
    """Such a loop is tried again after this length of path (m) where the detections were against it."""
    tolerance: float = 10.0
    """The tolerances of the batch are multiplied by this."""
    max_cycles: float = 6000.0
    """Measurements of the open lap are kept up to this number of cycles. After a longer lap the map goes on
    from what the window has marginalized."""
    max_cones: float = 1500.0
    """A lap with more cones than this goes on from what the window has marginalized, since its batch would
    not be in time."""


@dataclass(frozen=True)
class BatchSettings(Positive):
    """Describes the batch optimization over a whole log."""

    start: Start = "online"
    """The optimization begins at the map of an online run over the log, or at odometry alone."""
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
    """This is the first damping of control points (1/m^2). It resists a motion as seen from the pose beside a
    control point, so a map that swings with its poses isn't damped."""
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
    """The optimization has converged when |cost_before - cost_after| <= tolerance_cost * cost_after over a
    round, and the other two tolerances hold."""
    tolerance_curve: float = 2e-3
    """At convergence, no point of a curve moved farther than this across it in a round, as seen from the
    poses beside it (m)."""
    tolerance_decrease: float = 5e-3
    """At convergence, an undamped step would make the cost smaller by no more than this. A step of one sigma
    in any direction makes it smaller by 1/2, also where it swings a whole map by metres."""
    min_size_share: float = 0.6
    """The map's curves are tried with at least this share of the largest number of control points."""
    curve_samples: int = 2
    """The movement of a curve is measured at this number of points in each knot interval."""
    recurrence: RecurrenceSettings = field(default_factory=RecurrenceSettings)
    """These settings find the length of a lap in a start from odometry."""
    laps: LapCorrespondenceSettings = field(default_factory=LapCorrespondenceSettings)
    """These settings bring the laps together in a start from odometry."""
    cones: ConeSettings = field(default_factory=ConeSettings)
    """These settings cluster detections to cones."""
    association: AssociationSettings = field(default_factory=AssociationSettings)
    """These settings place poses and detections along the curves."""
    foot_points: FootPointSettings = field(default_factory=FootPointSettings)
    """These settings compute foot points."""
    closure: ClosureSettings = field(default_factory=ClosureSettings)
    """These settings decide on loops that no registration has closed."""
    scatter: ScatterSettings = field(default_factory=ScatterSettings)
    """These settings measure how far cones lie from the map's curves."""
