"""Settings of the mapper: frozen dataclasses, a sentence for each field, and no number anywhere else."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .batch import BatchSettings
from .checked import Positive
from .comparison import CkfSettings, LandmarkSettings
from .knots import Knots


@dataclass(frozen=True)
class SplineSettings(Positive):
    """The two boundary curves."""

    degree: int = 3
    """Degree of the splines (1 or more; cubic has a continuous curvature)."""
    spacing: float = 3.5
    """Distance of the control points (m) while the curve is open and grows."""
    size_share: float = 0.43
    """Control points after closing, as a share of the distinct cones sighted (the paper has 0.44)."""
    min_size: int = 8
    """Fewest control points of a closed boundary."""
    knots: Knots = "cones"
    """Knots of a closed boundary: one at each cone but those that are missed least, or at equal quantiles of
    the curvature (paper: Simplification), from which cones stand off half as much again."""
    linear_baseline: float = 0.5
    """Of knots by curvature the share that is spread evenly."""
    sigma_model: float = 0.25
    """Added to each reading across the curve (m, one sigma): how far cones stand off it. That error is the
    same every time a cone is seen, which is why it is larger than the offsets themselves, about 0.1 m."""
    residual: Literal["across", "point"] = "across"
    """What a reading says online: its distance across the curve, or how far it is from its foot point in both
    directions, as if that were a landmark (for comparison only)."""
    sigma_shape: float = 0.1
    """What a curve of so few control points can't follow (m, one sigma): added to the covariance of a closed
    map, since no number of readings averages it out."""
    sigma_simplify: float = 0.1
    """Shift of a control point (m, one sigma) that simplification may cause: loosens the prior by as much."""
    confirmed_margin: float = 0.5
    """So far past its last sighting (m) an open curve is believed; beyond, it is extrapolated."""
    search_step: float = 1.0
    """Coarse step (m along the curve) of a global search for foot points."""
    search_iterations: int = 2
    """Newton steps of a global search."""
    refine_room: float = 2.0
    """How far from where it was (m along the curve) a foot point is looked for in a Gauss-Newton step."""
    refine_iterations: int = 1
    """Newton steps of each foot point in a Gauss-Newton step, which start at the last one's parameter."""
    fit_smoothness: float = 0.1
    """Weight of second differences where new control points are placed through sightings."""
    fit_held: int = 4
    """Points on the end of the known curve that new control points must keep to."""


@dataclass(frozen=True)
class GaugeSettings(Positive):
    """Weak priors on what readings leave free."""

    sigma_spacing: float = 0.3
    """Deviation of neighbouring control points from their nominal distance, as a share of it."""
    sigma_smoothness: float = 1.0
    """Second difference of control points, as a share of their spacing (1: a circle of that radius)."""
    sigma_anchor: float = 1e4
    """Weak hold of every control point where it is (m): keeps the system regular, too weak to be seen, also
    where the thousand of them on a long track hold its heading together."""


@dataclass(frozen=True)
class GateSettings(Positive):
    """Which readings are used."""

    UNLIMITED = ("huber",)

    chi: float = 3.0
    """A reading joins the curve within this many sigmas of its joint uncertainty."""
    chi_unknown: float = 1.5
    """The same of a reading of unknown colour, by its own uncertainty alone: the large cones of a start line
    stand beside the boundary, and would bend it."""
    sigma_floor: float = 0.1
    """Added to that uncertainty (m): what the model doesn't know of its own errors."""
    rough: float = 3.0
    """A reading farther from the curve than this (m) isn't tested at all."""
    huber: float = 1.5
    """Whitened residual beyond which a row's weight falls."""
    view_ahead: float = 25.0
    """Stretch of the curve ahead of the vehicle (m along it) that a reading may belong to."""
    view_behind: float = 4.0
    """The same behind the vehicle."""
    station_step: float = 1.5
    """A vehicle that moved less than this (m) in a cycle has its foot point near the last one's; else ..."""
    station_ahead: float = 8.0
    """... it is searched for as far ahead of that (m) as this, ..."""
    station_behind: float = 3.0
    """... and so far behind it (m)."""
    station_lateral: float = 10.0
    """A curve farther from the vehicle than this (m), or running against it, isn't beside it: the vehicle has
    lost its place, which is looked for all around a closed curve, ..."""
    station_room: float = 40.0
    """... and on the last such stretch (m) of an open one."""


@dataclass(frozen=True)
class PathSettings(Positive):
    """The way driven, and the way ahead."""

    step: float = 0.3
    """Least distance of two kept positions (m)."""
    memory: float = 60.0
    """Stretch behind the vehicle (m) that is kept; the drive's first such stretch is kept for closing."""
    beginning_step: float = 1.0
    """Least distance of two kept poses of the first stretch (m)."""
    max_curvature: float = 0.3
    """Largest curvature of the path predicted ahead of the vehicle (1/m)."""
    curvature_gain: float = 0.4
    """Share of a cycle's measured curvature in the smoothed one."""
    min_speed: float = 1.0
    """Slower than this (m/s), yaw rate over speed says nothing of the curvature."""


@dataclass(frozen=True)
class GrowthSettings(Positive):
    """How an open end grows."""

    UNLIMITED = ("forget_after",)

    reach: float = 7.0
    """How far ahead of the vehicle along its path (m) a boundary is extended."""
    sightings: int = 3
    """Readings within `merge_radius` that make a sighting trustworthy."""
    merge_radius: float = 1.0
    """Readings of one label so close together are one sighting (m)."""
    forget_after: float = 6.0
    """A sighting not seen again for so long (s) is dropped."""
    threshold: float = 0.7
    """A sighting closer than this to the end of the curve (m) doesn't extend it."""
    max_lateral: float = 10.0
    """Farthest from the driven path (m) that a boundary may start: circuits are up to 15 m wide."""
    lateral_change: float = 1.5
    """How much farther from the path than the end of the curve the next sighting may be (m)."""
    lateral_rate: float = 0.2
    """The same, for each metre along the path beyond that (-)."""
    beside: float = 2.0
    """Of sightings that are so near to each other along the path (m) ..."""
    lateral_gap: float = 0.8
    """... those are left out that stand so much farther from it than the nearest (m)."""
    station_margin: float = 0.3
    """A sighting must lie so far past the end of the curve (m along the path) to extend it."""
    end_behind: float = 5.0
    """An end is no farther behind the vehicle than this (m along the path), as a stranded one is carried on;
    that it may be nearer to an older stretch of the path, across the infield, says nothing."""
    recall: float = 25.0
    """On the last stretch of a curve, so long (m), it is seen to that cones are in the order of the drive."""
    stranded: float = 2.0
    """An end so far behind the vehicle (m along the path), nothing ahead, is carried along it, ..."""
    stranded_left: float = 0.5
    """... to this share of that distance behind it."""
    min_lateral: float = 0.5
    """A carried end keeps at least so far from the path (m)."""
    min_carry: float = 0.5
    """An end is carried by so much at least (m), or not at all."""


@dataclass(frozen=True)
class ClosingSettings(Positive):
    """Loop closing."""

    min_path: float = 60.0
    """Shortest lap (m)."""
    check_interval: float = 2.0
    """Path (m) between two attempts to close."""
    radius: float = 8.0
    """Distance from the start (m) within which the loop may close, ..."""
    drift: float = 0.03
    """... and this much more for each metre driven."""
    heading: float = 0.8
    """Largest angle to the heading at the start (rad)."""
    overlap: float = 8.0
    """Stretch of the beginning (m) that must have been driven again."""
    inlier_distance: float = 0.4
    """A reading this near to the beginning's curve (m) agrees with it."""
    inlier_share: float = 0.8
    """Share of the readings that must agree."""
    min_readings: int = 25
    """Fewest readings that may close a loop, ..."""
    min_boundary_readings: int = 5
    """... and fewest of each boundary among those that agree."""
    window: float = 2.0
    """Time (s) of the newest readings that are registered with the beginning."""
    prior_scale: float = 1.5
    """Trust in the vehicle's own uncertainty: its sigmas are multiplied by this."""
    sigma_reading: float = 0.5
    """Deviation (m) of a reading in the registration: large, since many readings are of one cone."""
    sigma_max: float = 0.3
    """The registered position must be this certain (m, one sigma along its worst direction) ..."""
    patience: float = 40.0
    """... or, once so much of the beginning (m) has been driven again, ..."""
    sigma_patience: float = 0.85
    """... this certain: a straight says nothing along it, however much of it is driven again. Not where the
    vehicle is less certain itself than `icp_reach`."""
    beginning: float = 60.0
    """Stretch of the curves (m) that counts as their beginning, ..."""
    beginning_share: float = 0.6
    """... or this share of a shorter curve."""
    icp_reach: float = 3.0
    """A reading farther than this from the beginning doesn't pull in the first iteration (m), ..."""
    icp_shrink: float = 0.7
    """... and this share of the distance with each further one, down to `inlier_distance`."""
    start_step: float = 2.0
    """Where the vehicle is less certain than that, the registration tries places so far apart (m) on the
    beginning to start from, ..."""
    start_chi2: float = 16.3
    """... as long as the vehicle's uncertainty allows them (chi-square of 3, 99.9 %)."""
    icp_iterations: int = 7
    """Iterations of the registration."""
    keyframe_interval: float = 12.0
    """Path (m) between the keyframes in whose frames the drive so far is kept until the loop closes."""
    iterations: int = 2
    """Gauss-Newton steps after the tie, and again after simplification, ..."""
    sigma_step: float = 10.0
    """... in which a control point moves so far freely (m): hardly damped."""
    join_margin: float = 10.0
    """The seam lies on a curve's last stretch, as long as `beginning` and this (m), ..."""
    join_share: float = 0.5
    """... or, on a short curve, past this share of it."""
    overlap_step: float = 1.0
    """Step (m) at which the overlap's end is put on its beginning."""
    overlap_room: float = 4.0
    """Room (m along the curve) about the place on the beginning where a point of the overlap belongs."""
    seam_margin: float = 0.5
    """A sighting this near to the seam (m) is the beginning's own cone, and isn't counted twice."""


@dataclass(frozen=True)
class OdometrySettings(Positive):
    """What is not white in the odometry: constant errors, estimated along with the map."""

    sigma_scale: float = 0.005
    """Scale error of the speeds (one sigma)."""
    sigma_bias: float = 0.002
    """Bias of the yaw rate (rad/s, one sigma)."""
    sigma_start: float = 1e-4
    """Position of the vehicle at the first odometry stamp (m, one sigma): zero by definition, ..."""
    sigma_start_heading: float = 1e-5
    """... and its heading (rad): not exactly zero, so that the first pose's information is finite."""

    @property
    def sigmas_start(self) -> tuple[float, float, float]:
        """Of the pose at the first odometry stamp: (m, m, rad), one sigma."""
        return self.sigma_start, self.sigma_start, self.sigma_start_heading


@dataclass(frozen=True)
class FarSettings(Positive):
    """The part of the map that is not solved for in every cycle: changes speed, not results."""

    stretch: float = 12.0
    """So much of an open curve behind the vehicle (m) becomes far at once."""
    room: float = 25.0
    """The near part of a closed curve reaches so far beyond what the vehicle sees (m), so that it lasts."""


@dataclass(frozen=True)
class RelinearizeSettings(Positive):
    """Which factors of the window are linearized anew in a step: those that hold what has moved farther.

    After the loop has closed. Until then all are: an error of linearization is a rotation of the map with a
    long lever there.
    """

    point: float = 0.2
    """A control point, or the position of a pose (m)."""
    heading: float = 0.02
    """The heading of a pose (rad)."""


@dataclass(frozen=True)
class MapperSettings(Positive):
    """Everything that the estimators can be told; each takes the parts that are its own."""

    lag: float = 3.0
    """Time (s) that poses stay in the window."""
    steps: int = 1
    """Gauss-Newton steps a cycle, each relinearized at the current estimate."""
    steps_grown: int = 1
    """The same in a cycle in which a curve grew."""
    sigma_step: float = 0.5
    """How far a control point moves freely in a step (m): damps sliding along the curve, not the optimum."""
    spline: SplineSettings = field(default_factory=SplineSettings)
    """The curves."""
    gauge: GaugeSettings = field(default_factory=GaugeSettings)
    """Weak priors."""
    gate: GateSettings = field(default_factory=GateSettings)
    """Which readings are used."""
    path: PathSettings = field(default_factory=PathSettings)
    """The way driven and the way ahead."""
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    """How ends grow."""
    closing: ClosingSettings = field(default_factory=ClosingSettings)
    """How the loop closes."""
    far: FarSettings = field(default_factory=FarSettings)
    """What is not solved for in every cycle."""
    relinearize: RelinearizeSettings = field(default_factory=RelinearizeSettings)
    """Which factors are linearized anew in a step."""
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    """Calibration of the odometry."""
    batch: BatchSettings = field(default_factory=BatchSettings)
    """The batch optimization over a whole log."""
    landmark: LandmarkSettings = field(default_factory=LandmarkSettings)
    """The Hungarian landmark graph."""
    ckf: CkfSettings = field(default_factory=CkfSettings)
    """The paper's filters."""


ODOMETRY_SIGMA = (0.25, 0.12, 0.035)
"""Noise of a twist reading (m/s, m/s, rad/s) where nothing else is told: that of the simulator."""
