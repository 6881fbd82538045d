"""The front door of estimators: inside, every scene has the size of a Formula Student track."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import wraps
from numbers import Real
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from pathspace_graph.errors import ReadingError, SettingsError, check_type
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.lengths import POSE, scaled, times
from pathspace_graph.run import settings_dict
from pathspace_graph.settings.mapper import MapperSettings

from .scene import SceneScale, scale_of

C = TypeVar("C", bound=type[Any])

ANSWERS: Final = ("map", "outline", "readings", "vehicle_state", "noise_used", "window_poses", "smoothed")
"""What these methods of an online estimator return has its lengths multiplied by the scale."""


class FrontDoor:
    """The scale of an estimator and, until that is final, what it takes to begin anew."""

    constant: ClassVar = True
    """An estimator that goes back to what it was before an update keeps it."""

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
    """Return the noise of an estimator's odometry as it is at scale 1."""
    if noise is None or isinstance(noise, KnownNoise):
        return scaled(noise, 1.0 / scale)
    try:
        return np.asarray(times(np.asarray(noise, float), POSE, 1.0 / scale))
    except (TypeError, ValueError):
        raise SettingsError(f"odometry_sigma: expected 3 positive numbers, found {noise!r:.80}") from None


def in_scene(error: ReadingError, scale: float) -> ReadingError:
    """Return an error of a cycle at scale 1 with the lengths of the scene."""
    expected, found = times(error.expected, 1, scale), error.found
    if expected != error.expected and isinstance(found, float):
        found = found * scale
    return type(error)(error.field, expected, found, error.row, error.t)


def at_scale(estimator: C) -> C:
    """Let an online estimator map scenes of any size.

    Lengths of odometry and detections are divided by `settings.scale`, and those of results are multiplied by
    it. Where the setting is None, the first cycles tell the scale. If they tell another one than what was
    believed, the estimator begins anew with it, and takes the cycles so far again.
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
    for name in ANSWERS:
        if hasattr(estimator, name):
            setattr(estimator, name, _outwards(getattr(estimator, name)))
    if hasattr(estimator, "ahead"):
        estimator.ahead = _ahead_at_scale(estimator.ahead)
    estimator.scale = property(lambda self: self._door.scene.value, doc="Return the scale of the scene.")
    return estimator


def _outwards(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def answer(self: Any, *arguments: Any) -> Any:
        found, scale = method(self, *arguments), self._door.scene.value
        return times(found, POSE, scale) if isinstance(found, np.ndarray) else scaled(found, scale)

    return answer


def _ahead_at_scale(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def ahead(self: Any, distance: float, step: float = 1.0) -> Any:
        for name, length in (("distance", distance), ("step", step)):
            if not isinstance(length, Real):
                raise SettingsError(f"{name}: expected a number (m), found {length!r}")
        scale = self._door.scene.value
        return scaled(method(self, distance / scale, step / scale), scale)

    return ahead


def log_at_scale(estimator: C) -> C:
    """Let a batch estimator map logs of any size, by the scale of the settings or as the log tells it."""
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
        result = scaled(solve(inner, scaled(log, 1.0 / scale), *options, **named), scale)
        return replace(result, settings=settings_dict(settings))

    estimator.__init__, estimator.solve = begin_and_keep, solve_at_scale
    return estimator
