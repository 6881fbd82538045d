"""Settings of the estimators; a number that nobody changes is a constant, here or beside its use."""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Literal, Self

from pathspace_graph.errors import check_type
from pathspace_graph.labels import Kind

from .checked import Checked, Unlimited
from .online import (
    CalibrationSettings,
    ClosingSettings,
    GrowthSettings,
    LimitSettings,
    MotionSettings,
    OdometrySettings,
    SidesSettings,
)

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
