"""Settings of the mapper: frozen dataclasses with a sentence for each field, and no number anywhere else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

from .batch import BatchSettings, OpenLapSettings
from .calibration import CalibrationSettings
from .checked import Positive
from .closing import ClosingSettings
from .comparison import CenterlineSettings, CkfSettings, LandmarkSettings
from .front_end import MotionSettings, SidesSettings
from .growth import GrowthSettings
from .health import HealthSettings
from .knots import Knots
from .limits import LimitSettings


@dataclass(frozen=True)
class SplineSettings(Positive):
    """Describes the two boundary curves."""

    degree: int = 3
    """The splines have this degree, 1 or more; a cubic spline has a continuous curvature."""
    spacing: float = 3.5
    """Neighbouring control points of an open, growing curve are this far apart (m)."""
    size_share: float = 0.43
    """After closing, the number of control points is this share of the number of distinct cones that were
    detected (the paper has 0.44)."""
    min_size: int = 8
    """A closed boundary has at least this many control points."""
    knots: Knots = "cones"
    """The knots of a closed boundary follow its cones or its curvature. With `cones` they begin at the cones,
    and those whose removal costs least are removed. With `curvature` they lie at equal quantiles of the
    curvature (paper: Simplification), and the distances of cones from the curve are half as large again."""
    linear_baseline: float = 0.5
    """This share of the knots that follow the curvature is spread evenly along the curve."""
    sigma_model: float = 0.25
    """This is the standard deviation (m) of a cone's distance from the curve; its square is added to the
    variance of each detection across the curve. A cone has the same offset each time it is detected, so this
    is larger than the offsets themselves, which are about 0.1 m."""
    sigma_shape: float = 0.1
    """This is the standard deviation (m) of what a curve with few control points cannot follow. It is added
    to the covariance of a closed map, since no number of detections averages it out."""
    sigma_simplify: float = 0.1
    """Simplification may move a control point by this standard deviation (m); the prior is loosened by as
    much."""
    confirmed_margin: float = 0.5
    """An open curve is believed up to this distance (m) past the last cone it was grown through; beyond, it
    is extrapolated."""
    search_step: float = 1.0
    """A global search for foot points begins on a grid with this step (m along the curve)."""
    search_iterations: int = 2
    """A global search for foot points ends with this number of Newton steps."""
    refine_room: float = 2.0
    """A Gauss-Newton step looks for a foot point within this distance (m along the curve) of its last
    place."""
    refine_iterations: int = 1
    """A Gauss-Newton step refines each foot point by this number of Newton steps, from its last parameter
    on."""
    fit_smoothness: float = 0.1
    """This is the weight of second differences where new control points are fitted to tentative tracks."""
    fit_held: int = 4
    """New control points are fitted to this number of points at the end of the known curve, too, so that it
    keeps its shape."""


@dataclass(frozen=True)
class GaugeSettings(Positive):
    """Describes the weak priors on what detections leave free."""

    sigma_spacing: float = 0.3
    """This is the standard deviation of the distance of neighbouring control points from its nominal value,
    as a share of that value."""
    sigma_smoothness: float = 1.0
    """This is the standard deviation of the second difference of control points, as a share of their spacing;
    at 1, a circle whose radius is the spacing is one standard deviation away."""
    sigma_anchor: float = 1e4
    """This is the standard deviation (m) of the prior that holds each control point at its place. It keeps
    the system regular, and is too weak to be noticed even where a thousand control points of a long track
    hold its heading together."""


@dataclass(frozen=True)
class GateSettings(Positive):
    """Describes which detections are used, and how much they weigh."""

    UNLIMITED = ("huber",)

    chi: float = 3.0
    """A detection is associated with a curve within this many standard deviations of their joint
    uncertainty."""
    chi_unknown: float = 1.5
    """A detection of unknown colour is associated with a curve within this many standard deviations of its
    own uncertainty alone. The large cones of a start line stand beside the boundary, and would bend it."""
    sigma_floor: float = 0.1
    """The square of this standard deviation (m) is added to the variance in the gate, for errors that the
    model does not know."""
    rough: float = 3.0
    """A detection farther from the curve than this (m) is never associated with it."""
    huber: float = 1.5
    """Beyond this whitened residual, the Huber loss reduces the weight of a detection; inf means plain least
    squares."""
    view_ahead: float = 25.0
    """A detection may belong to the curve up to this far ahead of the vehicle (m along the curve)."""
    view_behind: float = 4.0
    """A detection may belong to the curve up to this far behind the vehicle (m along the curve)."""
    station_step: float = 1.5
    """If the vehicle moved less than this in a cycle (m), the foot point of its newest pose on each curve is
    refined from the last pose's foot point; otherwise it is searched for."""
    station_ahead: float = 8.0
    """The foot point of the newest pose is searched for up to this far ahead of the last pose's foot point (m
    along the curve)."""
    station_behind: float = 3.0
    """The foot point of the newest pose is searched for up to this far behind the last pose's foot point (m
    along the curve)."""
    station_lateral: float = 10.0
    """The vehicle has lost its place on a curve that is farther from it than this (m), or that leads in the
    opposite direction. Its place is then searched for on the whole of a closed curve, or at the end of an
    open one."""
    station_room: float = 40.0
    """This is the length (m) at the end of an open curve that is searched when the vehicle has lost its
    place."""


@dataclass(frozen=True)
class OdometrySettings(Positive):
    """Describes the constant errors of the odometry, which are estimated along with the map."""

    UNLIMITED = ("doubt",)
    SIGNED = ("scale", "bias")

    scale: float = 0.0
    """Known scale error of the speeds (-): the mean of its prior."""
    bias: float = 0.0
    """Known bias of the yaw rate (rad/s)."""
    sigma_scale: float = 0.005
    """This is the standard deviation of the scale error of the speeds (-)."""
    sigma_bias: float = 0.002
    """This is the standard deviation of the bias of the yaw rate (rad/s)."""
    doubt: float = 4.0
    """Where the drive contradicts a prior by this number of standard deviations, both become wide: the
    odometry is not what it was said to be. It is infinite where the priors always hold."""
    wide: float = 10.0
    """The wide priors have this number of times the standard deviations."""
    hold_scale: bool = False
    """The prior of the speeds' scale never becomes wide, since the speeds set the size of the map."""
    doubt_cycles: int = 10
    """All calibrations are judged again after this number of cycles."""
    sigma_start: float = 1e-4
    """This is the standard deviation of the position at the first odometry stamp (m); the position is zero by
    definition."""
    sigma_start_heading: float = 1e-5
    """This is the standard deviation of the heading at the first odometry stamp (rad); it is not zero, so
    that the first pose's information is finite."""

    def widened(self) -> OdometrySettings:
        """Returns the settings of wide priors, which are not doubted again."""
        scale = self.sigma_scale if self.hold_scale else self.wide * self.sigma_scale
        bias = self.wide * self.sigma_bias
        return replace(self, doubt=inf, sigma_scale=scale, sigma_bias=bias)

    @property
    def sigmas_calibration(self) -> tuple[float, float]:
        """Returns the standard deviations of the scale error (-) and of the yaw-rate bias (rad/s)."""
        return self.sigma_scale, self.sigma_bias

    @property
    def calibration(self) -> tuple[float, float]:
        """Returns the known scale error (-) and yaw-rate bias (rad/s)."""
        return self.scale, self.bias

    @property
    def sigmas_start(self) -> tuple[float, float, float]:
        """Returns the standard deviations (m, m, rad) of the pose at the first odometry stamp."""
        return self.sigma_start, self.sigma_start, self.sigma_start_heading


@dataclass(frozen=True)
class FarSettings(Positive):
    """Describes the inactive part of the map, which is not solved for in every cycle.

    These settings change speed, not results.
    """

    stretch: float = 12.0
    """Control points of an open curve become inactive in stretches of at least this length behind the vehicle
    (m)."""
    room: float = 25.0
    """The active part of the curves reaches this far beyond what the vehicle sees (m), so that it need not
    change in every cycle."""


@dataclass(frozen=True)
class RelinearizeSettings(Positive):
    """Says which factors of the window are linearized anew in a step: those whose variables moved.

    This applies after the loop has closed. Until then all factors are linearized anew, since an error of
    linearization turns the map with a long lever there.
    """

    point: float = 0.2
    """A factor is linearized anew when a control point or the position of a pose has moved farther than this
    (m)."""
    heading: float = 0.02
    """A factor is linearized anew when the heading of a pose has turned by more than this (rad)."""


@dataclass(frozen=True)
class MapperSettings(Positive):
    """Holds all settings of the estimators; each estimator takes the groups that are its own."""

    lag: float = 3.0
    """Poses stay in the window for this time (s)."""
    max_poses: int = 400
    """The window holds at most this number of poses, however fast the cycles follow each other."""
    steps: int = 1
    """Each cycle takes this number of Gauss-Newton steps, each relinearized at the current estimate."""
    steps_grown: int = 1
    """A cycle in which a curve grew takes this number of Gauss-Newton steps."""
    sigma_step: float = 0.5
    """A control point moves this far freely in a step (m): this damps sliding along the curve, and leaves the
    optimum where it is."""
    noise: Literal["measured", "stated"] | None = None
    """Noise of odometry and detections that is used: what the log states, or what is measured in the drive.
    By default what is stated, and measured where nothing is. Constant errors of the sensor are measured
    unless this is `stated`."""
    scale: float | None = None
    """Size of the scene by that of a Formula Student track: 0.1 for a model car of 1:10, 3 for a road. All
    lengths of the settings are those at scale 1. By default the first metres of the drive tell it."""
    limits: LimitSettings = field(default_factory=LimitSettings)
    """These settings say what a perception cycle may hold."""
    spline: SplineSettings = field(default_factory=SplineSettings)
    """These settings describe the two boundary curves."""
    gauge: GaugeSettings = field(default_factory=GaugeSettings)
    """These settings describe the weak priors on what detections leave free."""
    gate: GateSettings = field(default_factory=GateSettings)
    """These settings describe which detections are used, and how much they weigh."""
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    """These settings describe how the open end of a curve grows."""
    closing: ClosingSettings = field(default_factory=ClosingSettings)
    """These settings describe loop closing."""
    open_lap: OpenLapSettings = field(default_factory=OpenLapSettings)
    """These settings describe how the open lap is solved as a batch when the loop closes."""
    health: HealthSettings = field(default_factory=HealthSettings)
    """These settings describe when an estimate is good, degraded or lost."""
    far: FarSettings = field(default_factory=FarSettings)
    """These settings describe the inactive part of the map, which is not solved for in every cycle."""
    relinearize: RelinearizeSettings = field(default_factory=RelinearizeSettings)
    """These settings say which factors are linearized anew in a step."""
    motion: MotionSettings = field(default_factory=MotionSettings)
    """These settings describe how the odometry is checked against the detections."""
    sides: SidesSettings = field(default_factory=SidesSettings)
    """These settings describe how the side of a cone is told from the way driven."""
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    """These settings describe the constant errors of the odometry."""
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    """These settings describe the constant errors of the sensor."""
    batch: BatchSettings = field(default_factory=BatchSettings)
    """These settings describe the batch optimization over a whole log."""
    landmark: LandmarkSettings = field(default_factory=LandmarkSettings)
    """These settings describe the Hungarian landmark graph."""
    ckf: CkfSettings = field(default_factory=CkfSettings)
    """These settings describe the paper's filters."""
    centerline: CenterlineSettings = field(default_factory=CenterlineSettings)
    """These settings describe the estimators of a centre line with a width."""

    @property
    def calibrations(self) -> tuple[float, ...]:
        """Returns the priors' means, (2,) or (7,), of odometry and sensor."""
        return (*self.odometry.calibration, *self.calibration.means)

    @property
    def sigmas_calibrations(self) -> tuple[float, ...]:
        """Returns the priors' standard deviations, (2,) or (7,), of odometry and sensor."""
        return (*self.odometry.sigmas_calibration, *self.calibration.sigmas)


ODOMETRY_SIGMA = (0.25, 0.12, 0.035)
"""These are the standard deviations of a twist (m/s, m/s, rad/s) where none are given; they are the
simulator's."""
