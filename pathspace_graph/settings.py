"""Settings of the mapper: frozen dataclasses, a sentence for each field, and no number anywhere else."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SplineSettings:
    """The two boundary curves."""

    degree: int = 3
    """Degree of the splines (1 or more; cubic has a continuous curvature)."""
    spacing: float = 3.5
    """Distance of the control points (m) while the curve is open and grows."""
    size_share: float = 0.42
    """Control points after closing, as a share of the distinct cones that were sighted (the paper has 0.44)."""
    min_size: int = 8
    """Fewest control points of a closed boundary."""
    linear_baseline: float = 0.5
    """Share of the knots spread evenly; the rest follows the curvature (paper: Simplification)."""
    sigma_model: float = 0.08
    """How far cones stand off a smooth curve (m, one sigma), added to each reading across the curve."""
    sigma_simplify: float = 0.05
    """Displacement of a control point (m, one sigma) that simplification may cause; loosens the prior by as much."""


@dataclass(frozen=True)
class GaugeSettings:
    """Weak priors on what readings leave free."""

    sigma_spacing: float = 0.3
    """Deviation of neighbouring control points from their nominal distance, as a share of it."""
    sigma_smoothness: float = 1.0
    """Second difference of control points, as a share of their spacing (a circle of radius one spacing has 1)."""
    sigma_anchor: float = 100.0
    """Weak hold of every control point where it is (m): keeps the system regular, too weak to be seen."""


@dataclass(frozen=True)
class GateSettings:
    """Which readings are used."""

    chi: float = 3.0
    """A reading joins the curve within this many sigmas of its joint uncertainty."""
    sigma_floor: float = 0.1
    """Added to that uncertainty (m): what the model doesn't know of its own errors."""
    huber: float = 1.5
    """Whitened residual beyond which a row's weight falls."""
    view_ahead: float = 25.0
    """Stretch of the curve ahead of the vehicle (m along it) that a reading may belong to."""
    view_behind: float = 4.0
    """The same behind the vehicle."""


@dataclass(frozen=True)
class GrowthSettings:
    """How an open end grows."""

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
    max_lateral: float = 5.5
    """Farthest from the driven path (m) that a boundary may start."""
    lateral_change: float = 1.5
    """How much farther from the path than the end of the curve the next sighting may be (m)."""
    lateral_rate: float = 0.2
    """The same, for each metre along the path beyond that (-)."""
    max_curvature: float = 0.3
    """Largest curvature of the path predicted ahead of the vehicle (1/m)."""
    stranded: float = 2.0
    """An end so far behind the vehicle (m along the path) with nothing ahead is carried on along the path."""


@dataclass(frozen=True)
class ClosingSettings:
    """Loop closing."""

    min_path: float = 60.0
    """Shortest lap (m)."""
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
    """Fewest readings that may close a loop."""
    window: float = 2.0
    """Time (s) of the newest readings that are registered with the beginning."""
    prior_scale: float = 1.5
    """Trust in the vehicle's own uncertainty: its sigmas are multiplied by this."""
    sigma_reading: float = 0.5
    """Deviation (m) that a reading counts with in the registration: many readings are of one and the same cone."""
    sigma_max: float = 0.3
    """The registered position must be this certain (m, one sigma along its worst direction) ..."""
    patience: float = 40.0
    """... until so much of the beginning (m) has been driven again."""
    beginning: float = 60.0
    """Stretch of the curves (m) that counts as their beginning."""
    icp_reach: float = 3.0
    """A reading farther than this from the beginning doesn't pull in the first iteration (m)."""
    icp_iterations: int = 10
    """Iterations of the registration."""
    keyframe_interval: float = 12.0
    """Path (m) between the keyframes in whose frames the drive so far is kept until the loop closes."""
    iterations: int = 4
    """Gauss-Newton steps after the tie, and again after simplification."""


@dataclass(frozen=True)
class OdometrySettings:
    """What is not white in the odometry: constant errors, estimated along with the map."""

    sigma_scale: float = 0.005
    """Scale error of the speeds (one sigma)."""
    sigma_bias: float = 0.002
    """Bias of the yaw rate (rad/s, one sigma)."""


@dataclass(frozen=True)
class MapperSettings:
    """Everything that the fixed-lag mapper can be told."""

    lag: float = 3.0
    """Time (s) that poses stay in the window."""
    steps: int = 1
    """Gauss-Newton steps a cycle, each relinearized at the current estimate."""
    sigma_step: float = 0.5
    """How far a control point moves freely in one step (m): damps the slide along the curve, not the optimum."""
    spline: SplineSettings = field(default_factory=SplineSettings)
    """The curves."""
    gauge: GaugeSettings = field(default_factory=GaugeSettings)
    """Weak priors."""
    gate: GateSettings = field(default_factory=GateSettings)
    """Which readings are used."""
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    """How ends grow."""
    closing: ClosingSettings = field(default_factory=ClosingSettings)
    """How the loop closes."""
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    """Calibration of the odometry."""
