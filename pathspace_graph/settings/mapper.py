"""Settings of the estimators, their evaluation and their output; what nobody changes is a constant."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import inf
from typing import ClassVar, Final, Literal, Self

from pathspace_graph.errors import SettingsError, check_type
from pathspace_graph.labels import Kind

from .checked import Checked, Signed, Unlimited

ONLINE_NAMES: Final = ("fixed-lag", "landmark-fixed-lag", "ckf", "landmark-ckf")
"""Names of our own online estimators, the default one first."""
BATCH_NAMES: Final = ("spline", "landmark-batch")
"""Names of our own batch estimators, the default one first."""

Start = Literal["auto", "online", "odometry"]


@dataclass(frozen=True)
class SplineSettings(Checked):
    """The two boundary curves."""

    degree: int = 3
    """Degree of the splines, 1 or more; a cubic spline has a continuous curvature."""
    spacing: float = 3.5
    """Distance of neighbouring control points of an open, growing curve, m."""
    size_share: float = 0.43
    """Control points after closing as a share of the distinct cones that were detected (paper: 0.44)."""
    sigma_model: float = 0.25
    """Standard deviation of a cone's distance from the curve, m, added in each detection. It is larger than
    the offsets, about 0.1 m, since a cone has the same one each time."""
    sigma_shape: float = 0.1
    """Standard deviation of what a curve with few control points cannot follow, m, added in a closed map."""

    min_size: ClassVar[int] = 8  # least number of control points of a closed boundary
    search_step: ClassVar[float] = 1.0  # m along the curve, of the grid of a global search for foot points
    search_iterations: ClassVar[int] = 2  # Newton steps at the end of that search
    refine_room: ClassVar[float] = 2.0  # m along the curve, of a foot point's move in a Gauss-Newton step
    refine_iterations: ClassVar[int] = 1  # Newton steps that refine a foot point in a Gauss-Newton step


@dataclass(frozen=True)
class ExactSplineSettings(SplineSettings, group="spline"):
    """The same curves with foot points that are more exact than online, as an optimum needs them."""

    search_iterations: ClassVar[int] = 4
    refine_room: ClassVar[float] = 8.0
    refine_iterations: ClassVar[int] = 2


@dataclass(frozen=True)
class GaugeSettings(Checked):
    """The weak priors on what detections leave free."""

    sigma_spacing: float = 0.3
    """Standard deviation of a control point's slide along its curve, as a share of the spacing."""
    sigma_smoothness: float = 1.0
    """Standard deviation of the second difference of control points, as a share of their spacing."""

    sigma_anchor: ClassVar[float] = 1e4  # of its place across the curve, m, which keeps the system regular


@dataclass(frozen=True)
class GateSettings(Checked):
    """Which detections are used, and how much they weigh."""

    chi: float = 3.0
    """Gate of a detection's distance from a curve, in standard deviations of their joint uncertainty."""
    huber: Unlimited = 1.5
    """Whitened residual beyond which the Huber loss reduces a weight; `inf` for plain least squares."""

    view_ahead: ClassVar[float] = 25.0  # m along a curve, of the farthest place ahead that a detection is on
    view_behind: ClassVar[float] = 4.0  # farthest such place behind the vehicle, m
    sigma_floor: ClassVar[float] = 0.1  # m, of errors that the model does not know, added in the gate
    rough: ClassVar[float] = 3.0  # distance from a curve beyond which no detection is associated with it, m
    station_ahead: ClassVar[float] = 8.0  # how far a pose's foot point is searched for ahead of the last, m
    station_behind: ClassVar[float] = 3.0  # how far it goes back, m along the curve
    station_lateral: ClassVar[float] = 10.0
    """Distance from a curve at which the vehicle has lost its place, m, as where it leads the other way:
    the whole of a closed curve is searched then, or the end of an open one."""
    station_room: ClassVar[float] = 40.0  # length of that end, m


@dataclass(frozen=True)
class RelinearizeSettings(Checked):
    """Which factors of the window are relinearized in a step: those whose variables moved.

    This applies after the loop has closed. Until then all factors are relinearized, since an error of
    linearization rotates the map with a long lever.
    """

    point: float = 0.2
    """Largest move of a control point or of a pose's position without a new linearization, m."""
    heading: float = 0.02
    """Largest turn of a pose without one, rad."""


# --- settings of the online mapper: growth of open ends, closing, the front end, and constant errors ----


@dataclass(frozen=True)
class GrowthSettings(Checked):
    """How the open end of a curve grows, and what a tentative track is."""

    sightings: int = 3
    """Detections within `merge_radius` that confirm a tentative track."""
    merge_radius: float = 1.0
    """Distance within which detections of one label belong to one tentative track (m)."""

    max_unseen: ClassVar[float] = 500.0  # longest stretch of an open curve without any cone, m
    threshold: ClassVar[float] = 0.7  # m from a curve's end below which a tentative track does not extend it
    max_lateral: ClassVar[float] = 10.0  # m from the path at which tracks begin a boundary: half a wide road


@dataclass(frozen=True)
class ClosingSettings(Checked):
    """When the loop may close."""

    gauge_laps: Unlimited = 4.0
    """Laps on the closed map after which its position and heading as a whole are fixed; `inf` for never."""

    min_path: ClassVar[float] = 60.0  # least length of a lap, m
    check_interval: ClassVar[float] = 2.0  # m along the path, from one attempt to close the loop to the next
    radius: ClassVar[float] = 8.0  # m from the first stretch of a drive, where lines and landmarks close it
    drift: ClassVar[float] = 0.03  # growth of `radius` with the path driven (m/m)
    iterations: ClassVar[int] = 2  # Gauss-Newton steps after the loop is found, and after simplification

    def radius_after(self, length: float) -> float:
        """Distance from the first stretch within which the loop may close after a length (m)."""
        return self.radius + self.drift * length


@dataclass(frozen=True)
class LimitSettings(Checked, group="limits"):
    """What a vehicle and its sensors can do at most.

    A cycle beyond that is refused; a single detection beyond the range is dropped instead.
    """

    speed: float = 100.0
    """Largest speed ahead or to a side, m/s."""
    yaw_rate: float = 10.0
    """Largest yaw rate, rad/s."""
    silence: Unlimited = 30.0
    """Longest time without a twist or a cycle, s. After a longer one a cycle is refused, and the next that
    agrees with it is used."""
    range_max: float = 300.0
    """Largest distance of a detection from the vehicle, m."""


@dataclass(frozen=True)
class MotionSettings(Checked):
    """The check of the odometry against the detections; where they contradict it, their motion is used."""

    doubt: Unlimited = 5.0
    """Contradiction from which the odometry is distrusted, standard deviations; `inf` to trust it always."""

    accelerations: ClassVar = (5.0, 5.0, 1.5)
    """Growth of the twist's uncertainty where one is held for longer than usual (m/s^2, m/s^2, rad/s^2)."""


@dataclass(frozen=True)
class SidesSettings(Checked):
    """How the side of a cone is found from the driven path."""

    colourless: float = 0.7
    """Share of detections without a colour from which rows of cones give the sides; 1 for never."""


# --- priors of constant errors, which become wide where a drive contradicts them -------------------------

WIDE_ODOMETRY: Final = 10.0  # standard deviations of the odometry's wide priors by those of a calibrated one
HELD: Final = 0.02  # standard deviation of a fixed scale, by its own


class _Priors(Checked):
    """Priors of constant errors: a known value and a standard deviation of each."""

    ERRORS: ClassVar[tuple[str, ...]]  # names of the errors in order
    sensor = True  # whether the errors are estimated

    @property
    def means(self) -> tuple[float, ...]:
        """Known errors, (2,) of odometry or (5,) in the order of `factors.sensor:SENSOR`, or none."""
        return tuple(getattr(self, name) for name in self.ERRORS if self.sensor)

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Standard deviations in the same order, or none."""
        return tuple(getattr(self, f"sigma_{name}") for name in self.ERRORS if self.sensor)

    def about(self, errors: Iterable[float]) -> Self:
        """Replace the means: errors in the order of `means`, or none."""
        return replace(self, **dict(zip(self.ERRORS, errors, strict=False)))  # type: ignore[type-var]


@dataclass(frozen=True)
class OdometrySettings(_Priors):
    """Priors of the odometry's constant errors."""

    ERRORS = ("scale", "bias")

    sigmas_start: ClassVar = (1e-4, 1e-4, 1e-5)
    """Standard deviations (m, m, rad) of the first pose: zero by definition, but that has no information."""

    scale: Signed = 0.0
    """Known scale error of the speeds (-): mean of its prior."""
    bias: Signed = 0.0
    """Known bias of the yaw rate, rad/s."""
    sigma_scale: float = 0.005
    """Standard deviation of the scale error (-)."""
    sigma_bias: float = 0.002
    """Standard deviation of the bias, rad/s."""
    doubt: Unlimited = 4.0
    """Contradiction from which both priors become wide, standard deviations; `inf` for never."""
    hold_scale: bool = False
    """Whether the scale is fixed, since the speeds set the size of the map: a free one would shrink it to
    reduce its residuals. Its standard deviation is that of the size, in every covariance."""

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Standard deviations of the priors; a fixed scale is nearly known."""
        return self.sigma_scale * (HELD if self.hold_scale else 1.0), self.sigma_bias

    @property
    def sigma_size(self) -> float:
        """Standard deviation of the size of the world, where it is no variable (-)."""
        return self.sigma_scale if self.hold_scale else 0.0

    def widened(self) -> Self:
        """Widen the priors, which are not doubted again."""
        scale = self.sigma_scale if self.hold_scale else WIDE_ODOMETRY * self.sigma_scale
        return replace(self, doubt=inf, sigma_scale=scale, sigma_bias=WIDE_ODOMETRY * self.sigma_bias)


@dataclass(frozen=True)
class CalibrationSettings(_Priors):
    """Priors of the sensor's mounting, stamps and ranges."""

    ERRORS = ("yaw", "lateral", "latency", "range_scale", "range_bias")

    sensor: bool = True
    """Whether the sensor's constant errors are estimated along with the map."""
    sigma_yaw: float = 0.001
    """Standard deviation of the yaw, rad."""
    sigma_lateral: float = 0.005
    """Standard deviation of the lateral offset, m."""
    sigma_latency: float = 0.001
    """Standard deviation of the latency, s."""
    sigma_range_scale: float = 0.0005
    """Standard deviation of the scale error of the ranges (-)."""
    sigma_range_bias: float = 0.005
    """Standard deviation of the bias of the ranges, m."""
    yaw: Signed = 0.0
    """Known yaw of the sensor, positive to the left, rad: mean of its prior."""
    lateral: Signed = 0.0
    """Known lateral offset of the sensor, positive to the left, m."""
    latency: Signed = 0.0
    """Known age of detections at their stamps, s; negative where they are newer."""
    range_scale: Signed = 0.0
    """Known scale error of the ranges (-)."""
    range_bias: Signed = 0.0
    """Known bias of the ranges, m."""
    trust: Literal["odometry", "ranges"] | None = None
    """Which of the two sets the size of the map where ranges and speeds disagree: only their ratio can be
    seen. By default the odometry, unless ranges scatter by less than its scale is known."""
    doubt: Unlimited = 4.0
    """Contradiction from which the priors become wide, standard deviations; `inf` for never."""

    def widened(self) -> Self:
        """Widen the priors, which are not doubted again.

        Their standard deviations are 20 times those of a calibrated sensor. The scale of the ranges keeps its
        own, or the size of the map would rest on the wheels alone.
        """
        names = (f"sigma_{name}" for name in self.ERRORS if name != "range_scale")
        return replace(self, doubt=inf, **{name: 20.0 * getattr(self, name) for name in names})


# --- the batch, and the estimators to compare with ---------------------------------------------------------


@dataclass(frozen=True)
class OpenLapSettings(Checked, group="open_lap"):
    """Batch over the open lap, which closes the loop online."""

    cycles: int = 20
    """Cycles after the return at which the batch closes the loop, or as many as the window holds."""
    ends: tuple[int, ...] = ()
    """Cycles in which the batches replace the prior in a replay: `batches.ends` of `summary.json`."""


@dataclass(frozen=True)
class BatchSettings(Checked):
    """The batch optimization over a whole log."""

    start: Start = "auto"
    """Start of the optimization: odometry alone, or the map of an online run over the log. With `auto` it is
    odometry where cones are met again and nothing speaks against the closed loop, else an online run."""
    size_share: float = 0.43
    """Most control points as a share of the distinct cones that were detected (the paper has 0.44)."""
    sigma_smoothness: float = 0.4
    """Standard deviation of the second difference of control points, as a share of their spacing: smaller
    than online, so that a curve between cones that were never detected has one best shape."""

    dense_share: ClassVar[float] = 1.0  # control points for each cone of the curves that are solved for
    sigma_model: ClassVar[float] = 0.05  # m, of a cone's distance from these; online they have fewer points
    gate: ClassVar[float] = 4.0  # sigmas of a detection from its curve, beyond which it is not used


@dataclass(frozen=True)
class CkfSettings(Checked):
    """The paper's filters."""

    sigma_bend: float = 0.5
    """Standard deviation of the second difference of the control points that an extension moves or adds, as a
    share of their spacing. A large value gives the filter as it is published, whose uncertainty multiplies
    with each extension."""
    sightings: int = 3
    """Detections that make a landmark of the baseline filter; its description has 1: every one."""

    sigma_model: ClassVar[float] = 0.25  # m, of a cone's distance from a smooth curve, of each detection


@dataclass(frozen=True)
class MapperSettings(Checked, group=""):
    """All settings of the estimators; each takes the groups that are its own."""

    lag: float = 3.0
    """Time that poses stay in the window, s."""
    max_poses: int = 400
    """Largest number of poses in the window, however fast the cycles follow each other."""
    steps: int = 1
    """Gauss-Newton steps of a cycle, each relinearized at the current estimate."""
    steps_grown: int = 1
    """Gauss-Newton steps of a cycle in which a curve grew."""
    stations: bool = True
    """Whether the cones of a closed map constrain the vehicle along its curves, not only across them."""
    noise: Literal["measured", "stated"] | None = None
    """Noise of odometry and detections: by default as stated, and measured where nothing is. Constant errors
    of the sensor are measured unless this is `stated`."""
    kind: Kind | None = None
    """What detections are of: cones, which stay where they are, or a line, whose points lie anywhere along
    it. By default it is what the log states, and cones where it states nothing."""
    limits: LimitSettings = field(default_factory=LimitSettings)
    spline: SplineSettings = field(default_factory=SplineSettings)
    gauge: GaugeSettings = field(default_factory=GaugeSettings)
    gate: GateSettings = field(default_factory=GateSettings)
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    closing: ClosingSettings = field(default_factory=ClosingSettings)
    open_lap: OpenLapSettings = field(default_factory=OpenLapSettings)
    relinearize: RelinearizeSettings = field(default_factory=RelinearizeSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    sides: SidesSettings = field(default_factory=SidesSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    batch: BatchSettings = field(default_factory=BatchSettings)
    ckf: CkfSettings = field(default_factory=CkfSettings)

    sigma_step: ClassVar[float] = 0.5  # of a control point's move in a step, m: damps sliding along the curve

    @property
    def of_lines(self) -> bool:
        """Whether detections are points of lines."""
        return self.kind == "line"

    def with_kind(self, stated: Kind | None) -> Self:
        """Return settings with the stated kind where they leave it open; lines have no stations."""
        kind = self.kind or stated or "cones"
        return replace(self, kind=kind, stations=self.stations and kind == "cones")

    @property
    def calibrations(self) -> tuple[float, ...]:
        """Prior means, (2,) or (7,), of odometry and sensor."""
        return (*self.odometry.means, *self.calibration.means)

    @property
    def sigmas_calibrations(self) -> tuple[float, ...]:
        """Prior standard deviations, (2,) or (7,), of odometry and sensor."""
        return (*self.odometry.sigmas, *self.calibration.sigmas)


def known_settings(settings: MapperSettings | None) -> MapperSettings:
    """Settings of an estimator, by default the defaults; SettingsError for anything else."""
    settings = MapperSettings() if settings is None else settings
    check_type("settings", settings, MapperSettings)
    return settings


# --- settings of a speed profile ------------------------------------------------------------------------


@dataclass(frozen=True)
class SpeedSettings(Checked):
    """How fast a vehicle may be on its tyres; the defaults are those of a careful Formula Student car."""

    lateral: float = 10.0
    """Largest lateral acceleration, m/s^2: the friction coefficient times gravity."""
    forward: float = 5.0
    """Largest acceleration on a straight, m/s^2."""
    braking: float = 8.0
    """Largest deceleration on a straight, m/s^2."""
    top: Unlimited = 30.0
    """Largest speed, m/s."""


# --- settings of the evaluation: extent of the timing ---------------------------------------------------

CONES_MIN: Final = 50.0  # number of cones seen at which the sweep over cones begins


@dataclass(frozen=True)
class ScalingSettings(Checked):
    """Extent of the timing."""

    cones_max: float = 2000.0
    """Number of cones seen at which the sweep over cones ends, which begins at 50."""
    bins: int = 16
    """Number of points of the sweep over cones, evenly spaced on a logarithmic axis."""
    fit_from: float = 200.0
    """Number of cones from which on the slope against cones is fitted."""
    readings: tuple[int, ...] = (2, 4, 8, 14, 20, 28, 40)
    """Numbers of detections of the updates that are timed."""
    readings_cones: int = 300
    """Number of cones of the dense road, where these updates are timed."""
    warm_up: int = 30
    """Cycles at the beginning of the dense road that are not counted."""
    laps: int = 20
    """Laps of the closed road."""
    laps_cones: int = 100
    """Cones of the closed road."""
    budget: float = 0.5
    """Mean update at which an estimator is stopped (s)."""

    def __post_init__(self) -> None:
        """Raise SettingsError as well where a range is empty."""
        super().__post_init__()
        if self.cones_max <= CONES_MIN:
            raise SettingsError(f"cones_max: expected more than {CONES_MIN:g}, found {self.cones_max:g}")
        if not self.readings or min(self.readings) < 1:
            raise SettingsError(f"readings: expected numbers of at least 1, found {self.readings}")
