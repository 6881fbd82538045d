"""Scenes of any size: inside of an estimator, every scene has the size of a Formula Student track.

The scale of a scene is found from the width of its road and the gaps of its rows where the drive begins.
Lengths are divided by it on the way in, and multiplied by it on the way out.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial, wraps
from numbers import Real
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.settings.mapper import MapperSettings

from .errors import ReadingError, SettingsError, check_type, solving
from .labels import LEFT, RIGHT, UNKNOWN
from .lengths import POSE, Text, scaled, times
from .run import settings_dict, split_odometry

C = TypeVar("C", bound=type[Any])

WIDTH: Final = 3.5  # m from a cone to the nearest one of the other side in Formula Student, median
GAP: Final = 3.2  # distance of a cone from the nearest one of its row there, m, median
SCALES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)  # within a factor of 1.7 of one, maps are as good
NEAREST: Final = 5  # number of the nearest cones of each side that tell the scale
FEWEST: Final = 3  # number of cones of each side that a cycle needs
SAME: Final = 3.0  # largest distance (sigmas) of two detections of one cone
FARTHEST: Final = 1e4  # largest distance of a cone (m), in a scene of any scale
MOVED: Final = 0.1  # share of a gap by which the vehicle moves until the next cycle counts
JUDGED: Final = (1, 5, 20)  # cycles that count after which the scale is judged, the last time finally
PATIENCE: Final = 200  # number of cycles after which it is final in any case


class SceneScale:
    """Finder of a scene's scale, cycle by cycle, as soon as both sides of the road and a row are seen.

    It is the less extreme one of what width and gaps say, and 1 where they disagree, since a wide road isn't
    a large scene, or where they are out of the range of `SCALES`.
    """

    def __init__(self, scale: float | None = None) -> None:
        self.value = 1.0 if scale is None else scale  # scale as far as it is known
        self.is_final = scale is not None  # whether the value changes no more
        self._widths: list[float] = []
        self._gaps: list[float] = []
        self._driven = np.inf  # since the last cycle that counted
        self._cycles = self._counted = 0

    def see(self, odometry: Odometry, detections: Detections) -> None:
        if self.is_final:
            return
        self._cycles += 1
        held = np.diff(np.append(odometry.t, max(detections.t, *odometry.t[-1:], -np.inf)))
        self._driven += float(np.hypot(*odometry.twist[:, :2].T) @ held) if len(held) else 0.0
        width, gap = width_and_gap(detections)
        if not np.isnan(gap) and self._driven >= MOVED * gap:
            self._driven = 0.0
            self._counted += 1
            self._gaps.append(gap)
            self._widths.append(width)
            if self._counted in JUDGED:
                self.value = _nearest(self._widths, self._gaps)
        self.is_final = self._counted >= JUDGED[-1] or self._cycles >= PATIENCE


def scale_of(log: Log) -> float:
    """Return the scale of a log's scene, which the first metres of its drive tell."""
    scene = SceneScale()
    for cycle in split_odometry(log):
        scene.see(*cycle)
        if scene.is_final:
            break
    return scene.value


def width_and_gap(detections: Detections) -> tuple[float, float]:
    """Return the width of the road and the gap of its rows (m) in a cycle; NaN where they aren't seen."""
    usable = (np.abs(detections.points_vehicle) < FARTHEST).all(axis=1)  # the gate drops the others
    points, labels = detections.points_vehicle[usable], detections.labels[usable]
    sides = labels if (labels != UNKNOWN).any() else np.where(points[:, 1] > 0.0, LEFT, RIGHT)
    covariances = detections.covariances[usable]
    rows = [_nearest_cones(points[sides == s], covariances[sides == s]) for s in (LEFT, RIGHT)]
    if min(map(len, rows)) < FEWEST:
        return np.nan, np.nan
    nearest = [np.asarray(KDTree(row).query(row, k=2)[0])[:, 1] for row in rows]
    left, right = rows
    across = np.append(KDTree(right).query(left)[0], KDTree(left).query(right)[0])
    return float(np.median(across)), float(np.mean([np.median(gaps) for gaps in nearest]))


def _nearest_cones(points: Array, covariances: Array) -> Array:
    chosen: list[int] = []
    for k in np.argsort(np.hypot(*points.T)).tolist():
        apart = ((points[chosen] - points[k]) ** 2).sum(axis=1)
        variance = 0.5 * np.trace(covariances[chosen] + covariances[k], axis1=1, axis2=2)
        if (apart > SAME**2 * variance).all():
            chosen.append(k)
        if len(chosen) == NEAREST:
            break
    return np.asarray(points[chosen])


def _nearest(widths: list[float], gaps: list[float]) -> float:
    ratios = np.log10([np.median(widths) / WIDTH, np.median(gaps) / GAP])
    if ratios[0] * ratios[1] <= 0.0:
        return 1.0
    away = 2.0 * ratios[np.abs(ratios).argmin()]
    place = round(float(away)) + SCALES.index(1.0)
    return SCALES[place] if 0 <= place < len(SCALES) else 1.0


# --- the front door of estimators ------------------------------------------------------------------------

ANSWERS: Final = (  # methods of an online estimator that return what has lengths
    *("map", "outline", "ahead", "readings", "vehicle_state", "noise_used"),
    *("window_poses", "smoothed"),
)


class FrontDoor:
    """The scale of an estimator and, until that is final, what it takes to begin anew."""

    constant: ClassVar = True  # an estimator that goes back to what it was before an update keeps it

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Any = None, *others: Any, **named: Any
    ) -> None:
        """Keep what an estimator is made from, whose settings may give the scale."""
        settings = MapperSettings() if settings is None else settings
        check_type("settings", settings, MapperSettings)
        self.scene = SceneScale(settings.scale)
        self.made_from = (settings, odometry_sigma, *deepcopy((others, named)))
        self.cycles: list[tuple[Odometry, Detections]] = []

    def make(self, begin: Callable[..., None], estimator: Any) -> None:
        """Let an estimator begin, or begin anew, at the present scale."""
        settings, noise, others, named = self.made_from
        begin(estimator, settings, noise_at(noise, self.scene.value), *deepcopy(others), **deepcopy(named))

    def see(self, odometry: Odometry, detections: Detections) -> bool:
        """Take a cycle into account, and return whether the scale is another one now."""
        if self.scene.is_final:
            return False
        before = self.scene.value
        self.cycles.append((odometry, detections))
        self.scene.see(odometry, detections)
        return self.scene.value != before

    def inwards(self, odometry: Odometry, detections: Detections) -> tuple[Odometry, Detections]:
        """Return a cycle as it is at scale 1; one of wrong types or shapes is left to the gate as it is."""
        factor = 1.0 / self.scene.value
        try:
            with np.errstate(over="ignore"):  # what overflows is impossible, and dropped
                return scaled(odometry, factor), scaled(detections, factor)
        except (TypeError, ValueError):
            return odometry, detections


def noise_at(noise: Array | KnownNoise | None, scale: float) -> Array | KnownNoise | None:
    if noise is None:
        return None
    if isinstance(noise, KnownNoise):
        positive_sigmas(noise.odometry)
        return scaled(noise, 1.0 / scale)
    return np.asarray(times(positive_sigmas(noise), POSE, 1.0 / scale))


def positive_sigmas(values: Any) -> Array:
    """Return the standard deviations (3,) of a twist; SettingsError for anything but positive numbers."""
    try:
        sigmas = np.array(values, float)
    except (TypeError, ValueError):
        sigmas = np.zeros(0)
    if sigmas.shape != (3,) or not ((sigmas > 0.0) & (sigmas < np.inf)).all():
        found = values.tolist() if isinstance(values, np.ndarray) else values
        raise SettingsError(f"odometry_sigma: expected 3 positive numbers, found {found!r:.80}")
    return sigmas


def in_scene(error: ReadingError, scale: float) -> ReadingError:
    if not isinstance(error.expected, Text):
        return error
    found = error.found * scale if isinstance(error.found, float) else error.found
    return type(error)(error.field, error.expected.scaled(scale), found, error.row, error.t)


def at_scale(estimator: C) -> C:
    """Let an online estimator map scenes of any size.

    Lengths of odometry and detections are divided by `settings.scale`, those of results multiplied by it.
    Where it is None, the first cycles tell the scale. With each new one, the estimator begins anew and takes
    the cycles so far again.
    """
    begin, step = estimator.__init__, estimator.update

    @wraps(begin)
    def begin_at_scale(self: Any, *arguments: Any, **named: Any) -> None:
        self._door = FrontDoor(*arguments, **named)
        self._door.make(begin, self)

    @wraps(step)
    def update(self: Any, odometry: Odometry, detections: Detections, *factors: Any, **named: Any) -> Any:
        door: FrontDoor = self._door
        try:
            result = step(self, *door.inwards(odometry, detections), *factors, **named)
        except ReadingError as error:
            raise in_scene(error, door.scene.value) from None
        if any(factors) or any(named.values()):
            door.scene.is_final = True  # the user's factors have lengths of this scale
        if door.see(odometry, detections):
            door.make(begin, self)
            for cycle in door.cycles:
                try:
                    again = step(self, *door.inwards(*cycle))
                except ReadingError:  # a cycle that is possible at one scale may not be so at another
                    continue
                result = replace(again, refused=result.refused)
        if door.scene.is_final:
            door.cycles = []
        return scaled(result, door.scene.value)

    estimator.__init__, estimator.update = begin_at_scale, update
    for name in filter(partial(hasattr, estimator), ANSWERS):
        setattr(estimator, name, _outwards(getattr(estimator, name)))
    estimator.scale = property(lambda self: self._door.scene.value, doc="Return the scale of the scene.")
    return estimator


def _outwards(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method whose answer has its lengths multiplied by the scale; what `ahead` takes is divided."""

    @wraps(method)
    def answer(self: Any, *arguments: Any) -> Any:
        found, scale = method(self, *arguments), self._door.scene.value
        return times(found, POSE, scale) if isinstance(found, np.ndarray) else scaled(found, scale)

    @wraps(method)
    def ahead(self: Any, distance: float, step: float = 1.0) -> Any:
        for name, length in (("distance", distance), ("step", step)):
            if not isinstance(length, Real):
                raise SettingsError(f"{name}: expected a number (m), found {length!r}")
        scale = self._door.scene.value
        try:
            return scaled(method(self, distance / scale, step / scale), scale)
        except SettingsError as error:
            raise SettingsError(times(error.args[0], 0, scale)) from None

    return ahead if method.__name__ == "ahead" else answer


def log_at_scale(estimator: C) -> C:
    """Let a batch estimator map logs of any size, by the scale of the settings or as the log tells it.

    BLAS has one thread, and whatever numerics raise is a SolveError.
    """
    begin, solve = estimator.__init__, estimator.solve

    @wraps(begin)
    def begin_and_keep(self: Any, *arguments: Any, **named: Any) -> None:
        self._door = FrontDoor(*arguments, **named)
        begin(self, *arguments, **named)

    @wraps(solve)
    def solve_at_scale(self: Any, log: Log, *options: Any, **named: Any) -> Any:
        check_type("log", log, Log)
        settings, noise, others, by_name = self._door.made_from
        scale = settings.scale or scale_of(log)
        inner = object.__new__(type(self))
        begin(inner, replace(settings, scale=1.0), noise_at(noise, scale), *others, **by_name)
        with threadpool_limits(limits=1), solving("the batch"):
            result = solve(inner, scaled(log, 1.0 / scale), *options, **named)
        return replace(scaled(result, scale), settings=settings_dict(settings))

    estimator.__init__, estimator.solve = begin_and_keep, solve_at_scale
    return estimator
