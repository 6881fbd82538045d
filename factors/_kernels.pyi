"""Compiled functions of arrays (`kernels/`).

Arrays of shapes that don't fit each other raise ValueError. Limits are tuples, in the order that is told.
"""

from collections.abc import Sequence
from typing import Any, Final, Protocol

from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials
from .noise import TwistNoise

COMPILER: Final[str]
"""Name and version of the compiler that built them."""

class _Layout(Protocol):
    """What is read of `graph.variables:Layout`."""

    @property
    def keys(self) -> IntArray: ...
    @property
    def widths(self) -> IntArray: ...
    @property
    def starts(self) -> IntArray: ...
    @property
    def size(self) -> int: ...
    @property
    def turning(self) -> IntArray: ...
    @property
    def headings(self) -> IntArray: ...

class _Rows(Protocol):
    """What is read of `graph.rows:Rows`."""

    @property
    def keys(self) -> IntArray: ...
    @property
    def jacobian(self) -> Array: ...
    @property
    def residual(self) -> Array: ...
    @property
    def owner(self) -> IntArray: ...
    @property
    def widths(self) -> tuple[int, ...]: ...

class _Link(Protocol):
    """What is read of `graph.inactive:Link`."""

    @property
    def leaving(self) -> _Layout: ...
    @property
    def others(self) -> _Layout: ...
    @property
    def gain(self) -> Array: ...
    @property
    def offset(self) -> Array: ...
    @property
    def noise(self) -> Array: ...

class _MotionSettings(Protocol):
    """What is read of `settings.mapper:MotionSettings`."""

    @property
    def doubt(self) -> float: ...
    @property
    def accelerations(self) -> tuple[float, float, float]: ...

class _Matching(Protocol):
    """`front_end.motion:Matching`, of which all fields are read."""

    @property
    def of_lines(self) -> bool: ...

_Odometry = tuple[Array, Array, Array, Array, Array]
"""The fields of `factors.odometry:IntegratedOdometry`."""
_Parts = tuple[IntArray, Array, Array, IntArray]
"""The fields of `graph.rows:Rows`."""
_FootPoints = tuple[Array, Array, Array, Array, Array, BoolArray, Array, IntArray, IntArray]
"""The fields of `factors.footpoint:FootPoints`."""
_Tracks = tuple[Array, Array, IntArray, Array, IntArray]
"""Points (n, 2), information (n, 2, 2), detections by label (n, 5), newest stamps (n,) and numbers (n,)."""
_Cones = tuple[Array, Array, IntArray]
"""Points (n, 2), covariances (n, 2, 2) and labels (n,) of cones."""

# --- foot points -----------------------------------------------------------------------------------------
class Curves:
    """Curves of one degree, all periodic or none: points on any of them are searched for in one call.

    Parameters are those of each curve. A step from there may lead across the seam of a periodic one.
    """

    def __init__(
        self, bases: Sequence[SpanPolynomials], offsets: Sequence[int] = (0,), distinct: Sequence[int] = ()
    ) -> None:
        """Lay out curves whose control points begin at `offsets` of a common array.

        It holds unwrapped ones, or as many distinct ones of each periodic curve as is told.
        """

    def search(
        self,
        control_points: Array,
        points: Array,
        curve: IntArray,
        u_low: Array,
        u_high: Array,
        coarse_step: float,
        iterations: int,
    ) -> _FootPoints:
        """Find foot points as `footpoint:foot_points`; `curve` (m,) is the index of each row's curve."""

    def refine(
        self,
        control_points: Array,
        points: Array,
        curve: IntArray,
        u_start: Array,
        u_low: Array,
        u_high: Array,
        iterations: int,
    ) -> _FootPoints:
        """Find the local minima of |S(u) - p_i| downhill from u_start (m,) by safeguarded Newton steps.

        The other arguments are as in `search`. A start outside its stretch is moved into it first. No step
        exceeds one mean knot interval; a row that a step leads farther away is searched.
        """

# --- detections and odometry -----------------------------------------------------------------------------
def to_map(points_vehicle: Array, poses: Array) -> Array:
    """Return `p = R z + t` (m, 2), map frame: points z (m, 2) in the vehicle frames of poses (m, 3)."""

def shifted(measured: Array, twists: Array, sensor: Array) -> Array:
    """Return `z + C b` (m, 2) of detections z (m, 2): C of `sensor:by_sensor` and a calibration b (5,).

    Twists are (m, 3), or (3,) for all.
    """

def detection_rows(
    points_map: Array,
    covariances: Array,
    poses: Array,
    normals: Array,
    distances: Array,
    basis: Array,
    measured: Array,
    twists: Array,
    sensor: Array,
    sigma_model: float,
) -> tuple[Array, Array, Array]:
    """Return `r = n . (p - S(u))` (m,) with u the foot point of p, their sigmas (m,), and derivatives.

    normals n (m, 2), distances r (m,) and basis beta (m, p + 1) are of the foot points, and sigmas those of
    `residuals:sigma_across`. At an interior foot point every term through u vanishes, so with J the quarter
    turn and a = p - t the arm from the pose,

        dr/dt = n,   dr/dtheta = n . (J a),   dr/dc_j = -beta_j(u) n

    Derivatives (m, 3 + 5 + 2 p + 2) are by [pose | sensor | controls]. Where the sensor's calibration b (5,)
    is not empty, residuals and derivatives are multiplied by `f = 1 + rates b`, with `rates = n' R (d M^-1)
    R' n` of `sensor:by_range`, since noise is stated for measured detections. Those by b are `f n' R C + r
    rates`, with C of `sensor:by_sensor`: the detections were measured at (m, 2), vehicle frame, with twists
    (m, 3).
    """

def station_rows(
    points_map: Array,
    covariances: Array,
    poses: Array,
    value: Array,
    slope: Array,
    control: Array,
    measured: Array,
    twists: Array,
    sensor: Array,
    sigma_station: Array,
) -> tuple[Array, Array, Array]:
    """Return `r = t . (p - S(u))` (m,) along the tangent t at stations u, their sigmas (m,), and derivatives.

    A station is the parameter of a cone on its curve. value and slope (m, p + 1) are the basis and its
    derivative there, control (m, p + 1, 2) the control points that they weigh, and sigma_station (m,) the
    standard deviations of the cones along the curve, in m. With the normal n and the speed |S'|,

        dr/dp = t,   dr/dc_j = -beta_j(u) t + n . (p - S) beta'_j(u) / |S'| n

    The rest is as in `detection_rows`.
    """

def integrated(
    durations: Array, twists: Array, sigmas: Array, ends: IntArray, least: float
) -> list[tuple[Array, Array, Array, Array]]:
    """Return the fields of `IntegratedOdometry` but its twist, for each motion that ends at `ends` (m,).

    The whitener is lower triangular, with `least^2` added to the variances.
    """

def odometry_residuals(poses_start: Array, poses_end: Array, deltas: Array) -> tuple[Array, Array, Array]:
    """Return `r = Log(delta^-1 start^-1 end)` (m, 3), and its Jacobians (m, 3, 3) by start and end.

    It is the residual of GTSAM's BetweenFactorPose2, a tangent in the frame of the end (m, m, rad). Poses
    (m, 3) are in the map frame, deltas (m, 3) in the frame of the start. The Jacobians are by (x, y, theta)
    in the map frame.
    """

def whitened_odometry(
    poses_start: Array,
    poses_end: Array,
    deltas: Array,
    whiteners: Array,
    by_calibration: Array,
    calibration: Array,
) -> tuple[Array, Array]:
    """Return `W (r + G b)` (m, 3) with r of `odometry_residuals`, and its derivatives (m, 3, 8).

    W (m, 3, 3) are whiteners, and G (m, 3, 2) derivatives by the calibration b (2,). The result's
    derivatives are by [b | start | end].
    """

# --- layouts and rows ------------------------------------------------------------------------------------
def laid_out(
    keys: IntArray, sensor_key: int, first_pose: int, sizes: tuple[int, int, int], bounds: IntArray
) -> tuple[IntArray, IntArray, int, list[int]]:
    """Return the widths (k,) and the first columns (k,) of variables, and their number of columns.

    The sizes are those of a point, of the sensor's calibration, and of a pose. The last result has the column
    from which on the variables have keys of at least each of the bounds.
    """

def spread(starts: IntArray, widths: IntArray) -> IntArray:
    """Return the columns (n,) of blocks (k,) with these first columns and widths, one after the other."""

def columns_of(layout: _Layout, rows: _Rows) -> IntArray:
    """Return the column (m, n) of each derivative of rows, which is -1 where a key is not in the layout."""

def moved_residual(layout: _Layout, rows: _Rows, change: Array) -> Array:
    """Return `r - J c` (m,) with c the change (n,) of a layout's variables; ValueError for rows on others."""

def blocks_of(layout: _Layout, groups: Sequence[_Rows]) -> list[tuple[int, IntArray, Array]]:
    """Return each owner, ascending, with places (h,) of the variables that its rows hold, and `[J -r]`.

    The block (m, n + 1) is on these variables, stored by columns. ValueError for rows on others.
    """

class RowStore:
    """Rows `J d + r` with d = value - reference, which are kept until those of their owner are replaced.

    Keys and owners that are given are ascending.
    """

    def __init__(self) -> None: ...
    def copy(self) -> RowStore:
        """Return a store that can change independently."""

    def parts(self) -> list[_Parts]:
        """Return keys, derivatives, residuals and owners of the rows of each widths of variables."""

    def holding(self, keys: IntArray) -> IntArray:
        """Return the owners of rows that hold any of some keys (k,)."""

    def stale(self, owners: IntArray, keys: IntArray) -> BoolArray:
        """Return which owners (k,) have no rows, or hold any of some keys."""

    def replace(self, owners: IntArray, fresh: Sequence[_Rows], layout: _Layout, change: Array) -> None:
        """Replace all rows of some owners by fresh ones.

        These are linearized where a layout's unknowns are `change` (n,). ValueError for rows on others.
        """

    def drop(self, owners: IntArray) -> None:
        """Remove all rows of some owners."""

    def pop(self, owner: int, layout: _Layout) -> tuple[IntArray, Array]:
        """Remove the rows of an owner; return places and block as `blocks_of` does."""

def summed(
    layout: _Layout, factors: list[tuple[IntArray, Array]], rows: RowStore, change: Array
) -> tuple[Array, Array]:
    """Return the lower triangle of H (n, n), by columns, and the negative gradient (n,), at `change` (n,).

    They are sums over factors `[[L, g], [g', f]]` and all rows of a store, on variables of a layout.
    """

# --- frames of poses -------------------------------------------------------------------------------------
def relative_block(
    root: Array, right: Array, local: Array, values: Array, change: Array, keys: _Layout
) -> Array:
    """Return `[J | J d - r]` (r, q + 4), by columns, with derivatives J and residuals r of a relative factor.

    The values (q + 3,) and the unknowns d, which are `change` (q + 3,) now, are those of its variables and
    then of the frame.
    """

def link_means(
    values: Array, links: Sequence[_Link], frames: IntArray, leaving: IntArray, others: IntArray
) -> Array:
    """Return all values (n,), with the inactive variables at their conditional means, newest link first.

    The columns are those of `InactiveChain._columns`.
    """

def origin_by_active(
    values: Array, links: Sequence[_Link], frames: IntArray, leaving: IntArray, others: IntArray, origin: int
) -> tuple[Array, Array]:
    """Return the derivative (3, n) of the origin's pose by the active variables, and its covariance (3, 3).

    Each link, oldest first, replaces its variables y by `from(G to(z, f) + e + N w, f)` in its frame f, with
    w of unit covariance. The covariance is given the active variables; `origin` is the column of its pose.
    """

# --- front end -------------------------------------------------------------------------------------------
def usable(points: Array, covariances: Array, limits: tuple[float, ...]) -> tuple[BoolArray, BoolArray]:
    """Return which points (m, 2) are where a sensor sees, and which covariances (m, 2, 2) are possible.

    The limits are those of the range, MAX_ASYMMETRY, MIN_DETERMINANT, MIN_SIGMA and MAX_SIGMA.
    """

class MotionCheck:
    """Check of each cycle's odometry against the detections of the newest cycles; see `front_end.motion`."""

    def __init__(self, noise: TwistNoise, settings: _MotionSettings, matching: _Matching) -> None: ...
    @property
    def pose(self) -> Array:
        """Newest pose (3,) by dead reckoning; the first one is 0."""

    @property
    def seen_again(self) -> BoolArray:
        """Which detections (m,) of the newest cycle lie on those of the cycles before."""

    @property
    def errors(self) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of yaw and latency of the sensor."""

    def copy(self) -> MotionCheck:
        """Return a check that can change independently."""

    def set_noise(self, noise: TwistNoise) -> None:
        """Set the noise of a twist, and forget the detections and the learned errors of the sensor."""

    def update(
        self,
        stamps: Array,
        twists: Array,
        t: float,
        points: Array,
        covariances: Array,
        may_contradict: bool,
    ) -> tuple[_Odometry, Array, bool, bool, bool, tuple[float, float] | None, Array | None, Array, bool]:
        """Return the fields of the motion since the previous cycle, and whether a rest ends with it.

        They are those of `mapping.motion:MeasuredMotion`, with those of its odometry, and of its bias. Twists
        (k, 3) have stamps (k,), and detections at t (s) points (m, 2), vehicle frame, and covariances (m, 2,
        2).
        """

def matched(
    earlier: Array,
    points_vehicle: Array,
    variances: Array,
    start: Array,
    reaches: Sequence[float],
    matching: _Matching,
) -> tuple[Array, Array, BoolArray, float, bool]:
    """Register detections (m, 2) to earlier ones (n, 2) by Gauss-Newton steps from a pose (3,).

    Each step, one for each of the reaches (m), minimizes `sum_i |R z_i + t - m_i|^2 / sigma_i^2` with Huber's
    loss. m_i is the weighted mean of the earlier detections near the point, n_i the sum of the weights, and
    `sigma_i^2 = variance_i (1 + 1/n_i) + sigma_cone^2`. Of a point of a line, only the distance across the
    line counts, and the start is held along it.

    The results are the pose (3,) in the frame of the earlier detections, the information (3, 3) about it,
    which detections (m,) coincide with earlier ones, the mean square of their whitened distances, and whether
    enough of them do and hold the pose in every direction (lines: its heading). All but the pose are those of
    the last step; for lines those at the pose, and the information includes `lines_alike`.
    """

def misfit(
    earlier: Array, points_vehicle: Array, variances: Array, pose: Array, reach: float, matching: _Matching
) -> float:
    """Return the mean square of the whitened distances of `matched` at a given pose (3,).

    Each counts up to `most_misfit`, and so do detections that match nothing.
    """

def by_constants(
    seen: Array, twists: Array, poses: Array, by_bias: Array, first: IntArray, bends_from: float
) -> Array:
    """Return the derivatives (n, 2, 7) of sightings at points (n, 2), vehicle frame, in the map frame.

    They are by the constants (`PRIOR`). The bias of the yaw rate counts from each cone's first sighting, at
    rows (n,): before, it turns all of the cone's alike.
    """

def centred(
    begins: IntArray, information: Array, columns: Array, points: Array
) -> tuple[Array, Array, Array, Array]:
    """Return columns A (n, 2, 7) and points p (n, 2) less each cone's weighted mean, and its sums.

    Those are `A' W A` (c, 7, 7) and `A' W p` (c, 7), with information W (n, 2, 2) of the sightings of cones
    that begin at rows (c,).
    """

def references(
    cone: IntArray, t: Array, ranges: Array, weight: Array, values: Array, sought: tuple[float, float]
) -> tuple[IntArray, IntArray, Array]:
    """Return the rows (k,) of sightings with two references or more, their counts, and means (k, 1 + q).

    References of a sighting (n,) are those of its cone within a share of its range and a time of it (s). The
    weighted means over them are of the time to them and of values (n, q).
    """

# --- curves ----------------------------------------------------------------------------------------------
def placed(
    rows: IntArray,
    cycles: IntArray,
    measured: Array,
    twists: Array,
    poses: Array,
    first_cycle: int,
    sensor: Array,
) -> Array:
    """Return `DetectionColumns.points_map` of some rows, by the poses (P, 3) from `first_cycle` on."""

def open_rows(
    labels: IntArray, since: IntArray, label: IntArray, boundary: IntArray, used: BoolArray, unknown: int
) -> tuple[IntArray, IntArray]:
    """Return `DetectionTable.open_to` for a table with these columns."""

def in_view(
    curves: Curves,
    control_points: Array,
    trusted: Array,
    points: Array,
    curve: IntArray,
    slot: IntArray,
    pose_u: list[Array],
    pose: Array,
    rooms: tuple[float, float, float, float],
    step: float,
    iterations: int,
) -> tuple[_FootPoints, list[tuple[float, float, float]]]:
    """Return the foot points of detections at points (m, 2), each on its curve (m,) beside its pose (m,).

    The poses have parameters (P,) on each of the curves. The second result has, for each curve, the parameter
    of the newest pose (3,), the cosine of its angle with the curve, and its distance; it is near the pose
    before it. The rooms are those behind and ahead of a detection's pose, and of the newest one.
    """

def gated(
    rows: IntArray,
    cycle: IntArray,
    label: IntArray,
    covariances: Array,
    poses: Array,
    first_cycle: int,
    foot: tuple[Array, Array, BoolArray],
    limits: tuple[float, float, float, float, float, int],
) -> tuple[Array, BoolArray, BoolArray]:
    """Return the variance (m,) of each detection by row, whether its curve accepts it, or else may do so.

    The foot points have normals (m, 2), distances (m,) and whether they are interior (m,). The limits are
    the sigma of the model, the least sigma, the largest distance, both gates in sigmas, and `UNKNOWN`.
    """

def curve_rows(
    curves: Curves,
    on_curves: tuple[Array, IntArray, IntArray, Array, Array],
    table: tuple[Any, ...],
    cycles: IntArray,
    poses: Array,
    first_cycle: int,
    sensor: Array,
    limits: tuple[float, int, float, float],
    names: tuple[int, int],
    stations: tuple[Array, Array, IntArray, Array] | None,
) -> tuple[IntArray, Array, bool, list[_Parts]]:
    """Return detections by row, their refined parameters (m,), and the parts of `CurveMap.rows`.

    The third result says whether one has slid to where a curve is inactive. Curves have control points
    (n, 2), labels (k,), keys (n,), and parameters (k,) up to which and from which on they may be used. The
    table has the columns of `DetectionTable.associated`. Stations (s,), whose rows come second, have basis
    functions and derivatives (s, p + 1), rows (s, p + 1) of the control points, and sigmas (s,).
    """

def along_and_across(points: Array, path: Array, stations: Array) -> tuple[Array, Array]:
    """Return the station (m,) and signed distance (m,), left positive, of points (m, 2) beside a polyline.

    The polyline has at least two positions (n, 2) with stations (n,). Beyond the last position the station
    continues along the last segment.
    """

# --- cones -----------------------------------------------------------------------------------------------
def merged(
    known: _Tracks,
    points: Array,
    covariances: Array,
    labels: IntArray,
    stamps: Array,
    following: int,
    gate: tuple[float, float, float, float, bool],
) -> tuple[_Tracks, IntArray]:
    """Return the columns of tracks with detections added as `Tracks.add` does, and the number (m,) of each.

    New tracks are numbered from `following` on. The gate is a radius (m), its multiple within which smeared
    detections are tested, their sigmas, the memory (s), and whether labels must be equal.
    """

def laid(
    seen: _Cones,
    known: _Cones,
    views: Array,
    centres: Array,
    means: Array,
    prior: Array,
    reach: tuple[float, float],
    limits: tuple[float, ...],
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the places where seen cones may lie, as `places.find:find` compares them.

    They are poses (m, 3) about centres (k, 3), the information (m, 3, 3) about each from the cones that lie
    on others, the sum (m,) of the capped squares of the cones in view, their number (m,), and the square (m,)
    of the way from its mean (k, 3).
    """
