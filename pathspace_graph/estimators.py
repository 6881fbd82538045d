"""The estimators by their names on the command line: our own, and those of other installed packages.

A package adds one by an entry point of its name, in the group `pathspace_graph.online` or
`pathspace_graph.batch`, that refers to what makes it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final

from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.io.log import Log
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.checked import override
from pathspace_graph.settings.mapper import BATCH_NAMES, ONLINE_NAMES, MapperSettings, known_settings

from .errors import SettingsError, check_name, check_type
from .run import BatchEstimator, OnlineEstimator

MakeOnline = Callable[..., OnlineEstimator]  # of settings, known noise and, where it has any, its parameters
MakeBatch = Callable[..., BatchEstimator]

DEFAULT_ONLINE: Final = ONLINE_NAMES[0]  # online estimator where none is named
DEFAULT_BATCH: Final = BATCH_NAMES[0]  # batch estimator where none is named
ONLINE_GROUP: Final = "pathspace_graph.online"  # group of entry points that add online estimators
BATCH_GROUP: Final = "pathspace_graph.batch"  # group of entry points that add batch estimators
ALWAYS_READ: Final = ("kind", "limits", "calibration", "odometry")
"""Settings that are read before an estimator is made, and by what judges its calibration."""

_ENTRY_POINTS: Final = entry_points()  # looked up once, since that reads the metadata of every package


@dataclass(frozen=True)
class Elsewhere:
    """What makes an estimator, by its module, which is imported when it is first asked for."""

    point: EntryPoint

    @cached_property
    def maker(self) -> Any:
        """Return the class or function; a SettingsError says what is broken in another package."""
        try:
            return self.point.load()
        except Exception as error:  # a package of somebody else may raise anything
            raise self.broken(error) from error

    def broken(self, error: Exception) -> SettingsError:
        home = self.point.dist
        of = f" of {home.name} {home.version}" if home else ""
        why = " ".join(f"{type(error).__name__}: {error}".split())
        return SettingsError(
            f"{self.point.name}: expected an estimator at {self.point.value}{of}, found {why}"
        )

    def __call__(self, *arguments: Any) -> Any:
        return self.maker(*arguments)


_BASELINES: Final = {
    name: Elsewhere(EntryPoint(name, f"{__package__}.baselines.{place}", ""))
    for name, place in (
        ("landmark-fixed-lag", "landmark_graph:LandmarkFixedLag"),
        ("ckf", "filters:CkfMapper"),
        ("landmark-ckf", "filters:LandmarkCkf"),
        ("landmark-batch", "landmark_graph:LandmarkBatch"),
    )
}
ONLINE: Final[dict[str, MakeOnline]] = {
    **{point.name: Elsewhere(point) for point in _ENTRY_POINTS.select(group=ONLINE_GROUP)},
    DEFAULT_ONLINE: FixedLagMapper,
    **{name: _BASELINES[name] for name in ONLINE_NAMES[1:]},
}

BATCH: Final[dict[str, MakeBatch]] = {
    **{point.name: Elsewhere(point) for point in _ENTRY_POINTS.select(group=BATCH_GROUP)},
    DEFAULT_BATCH: lambda settings, noise: BatchMapper(settings, noise, FixedLagMapper),
    **{name: _BASELINES[name] for name in BATCH_NAMES[1:]},
}


def known_estimators() -> list[str]:
    """Return the name of every estimator, online ones first."""
    return [*ONLINE, *BATCH]


def maker_of(name: str) -> Any:
    """Return the class or function that makes an estimator; a SettingsError where its package is broken."""
    made_by = ONLINE.get(name) or BATCH[name]
    return made_by.maker if isinstance(made_by, Elsewhere) else made_by


def module_of(name: str) -> str:
    """Return the module of what makes an estimator."""
    made_by = ONLINE.get(name) or BATCH[name]
    return made_by.point.module if isinstance(made_by, Elsewhere) else str(made_by.__module__)


def parameters_of(name: str) -> Any:
    """Return the default of the frozen dataclass `Parameters` of a maker; None where it has none."""
    made_of = getattr(maker_of(name), "Parameters", None)
    return None if made_of is None else made_of()


def with_parameters(name: str, overrides: dict[str, Any], where: str = "") -> tuple[Any, dict[str, Any]]:
    """Return the own parameters of an estimator with overrides of `NAME.field`, and the other overrides.

    The parameters are None where it has none. A wrong field or value is a SettingsError.
    """
    default, prefix = parameters_of(name), f"{name}."
    if default is None:
        return None, overrides
    own = {key.removeprefix(prefix): value for key, value in overrides.items() if key.startswith(prefix)}
    rest = {key: value for key, value in overrides.items() if not key.startswith(prefix)}
    return override(default, own, f"{where}.{name}".strip(".")), rest


def reads(name: str, field: str) -> bool:
    """Whether an estimator reads a setting, by its dotted name.

    Its maker's `READS` are fields and groups; without it, all are read.
    """
    known = getattr(maker_of(name), "__dict__", {}).get("READS")  # a subclass may read more
    return known is None or any(f"{field}.".startswith(f"{own}.") for own in (*ALWAYS_READ, *known))


def check_estimator(name: str, settings: MapperSettings, parameters: Any = None) -> None:
    """Make an estimator of another package once; a SettingsError says what is broken in it."""
    made_by = ONLINE.get(name) or BATCH[name]
    if isinstance(made_by, Elsewhere):
        maker = made_by.maker
        try:
            _make(maker, settings, known_noise(None), parameters)
        except Exception as error:
            raise made_by.broken(error) from error


def _make(made_by: Any, settings: MapperSettings, noise: KnownNoise, parameters: Any) -> Any:
    return made_by(settings, noise) if parameters is None else made_by(settings, noise, parameters)


def check_online(name: str, option: str = "--estimator") -> None:
    """Raise a SettingsError that names the known estimators, unless the name is one of them."""
    known = ", ".join(sorted(ONLINE))
    check_name(name, ONLINE, f"{option}: expected a known online estimator ({known})")


def check_batch(name: str) -> None:
    check_name(name, BATCH, f"--estimator: expected a known batch estimator ({', '.join(sorted(BATCH))})")


def make_online(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> OnlineEstimator:
    """Return an online estimator for a log, which tells the kind of detections and their noise."""
    check_online(name)
    check_type("log", log, Log)
    own = parameters or parameters_of(name)
    made: OnlineEstimator = _make(ONLINE[name], settings_of(settings, log), log.noise, own)
    return made


def settings_of(settings: MapperSettings, log: Log) -> MapperSettings:
    """Return settings with the kind of detections that a log states, where they leave it open."""
    return known_settings(settings).with_kind(log.sensor.kind)


def make_batch(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> BatchEstimator:
    check_batch(name)
    check_type("log", log, Log)
    made: BatchEstimator = _make(BATCH[name], settings, log.noise, parameters or parameters_of(name))
    return made
