"""What every command has in common; and `demo`, `online`, `batch`, `plot` and `export`."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from cyclopts import Group, Parameter

from pathspace_graph.settings.checked import Checked
from pathspace_graph.settings.estimators import BATCH_NAMES, ONLINE_NAMES
from pathspace_graph.settings.mapper import MapperSettings, Start
from pathspace_graph.settings.output import RecordingSettings, SpeedSettings

INLINE: Final = Parameter(name="*")
"""Settings whose options have no prefix."""
FILE: Final = Parameter(allow_leading_hyphen=True)
"""A single file to write, where `-` is standard output."""

_EVERY: Final = Parameter(negative=(), group=Group("Every command", sort_key=3))


def suggest(*names: str) -> Parameter:
    """Complete these names in a shell; others are accepted too, such as estimators of other packages."""
    return Parameter(completer=lambda _: names)


@dataclass(frozen=True, kw_only=True)
class Command:
    """Options of every command."""

    quiet: Annotated[bool, Parameter(name=("--quiet", "-q")), _EVERY] = False
    """Print errors and hints only."""
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v")), _EVERY] = False
    """Print progress in lines, and where an error comes from."""
    json: Annotated[bool, _EVERY] = False
    """Print the result as JSON."""


@dataclass(frozen=True, kw_only=True)
class FolderCommand(Command):
    """Options of a command that writes one folder."""

    force: Annotated[bool, Parameter(negative=())] = False
    """Replace an earlier result in the folder."""


# --- maps of logs, and exports of them -------------------------------------------------------------------

MapKind = Literal["boundaries", "centerline"]
Format = Literal["centerline", "tum", "geojson", "points", "lanelet2", "profile"]


_SETTINGS: Final = Parameter(group=Group("Settings of the estimators", sort_key=2))


@dataclass(frozen=True, kw_only=True)
class Estimation(Command):
    """Options of every command that estimates."""

    file: Annotated[Path | None, Parameter(name="--settings"), _SETTINGS] = None
    """TOML file of settings, or the summary.json of a run; options on the command line override it. A section
    with the name of the estimator has parameters of its own."""
    settings: Annotated[MapperSettings, INLINE, _SETTINGS] = field(default_factory=MapperSettings)

    @classmethod
    def base(cls, given: Mapping[str, Sequence[str]]) -> MapperSettings | None:
        """Settings of the file, if any, which the command line overrides."""
        names = given.get("estimators", given.get("estimator", ()))
        return _read_settings(Path(given["file"][0]), names)[0] if "file" in given else None

    def own(self, estimators: Iterable[str]) -> dict[str, Any]:
        """Own parameters of these estimators, as `NAME.field`, from the file."""
        return {} if self.file is None else _read_settings(self.file, estimators)[1]


def _read_settings(file: Path, estimators: Iterable[str]) -> tuple[MapperSettings, dict[str, Any]]:
    overrides = import_module("pathspace_graph.io.overrides")  # the help need not wait for NumPy
    found: tuple[MapperSettings, dict[str, Any]]
    found = overrides.read_settings(file, MapperSettings(), estimators)
    return found


@dataclass(frozen=True, kw_only=True)
class Demo(Estimation):
    """Simulate a track and map it online: the paper's table beside the landmark graph's, and a picture."""

    out: Path = Path("pathspace-demo")
    """Folder for log, map and picture, in the place of an earlier demo."""
    seed: int = 8
    """Seed of the track and of all noise; by default one whose first lap is typical."""
    laps: int = 5
    """Laps that the vehicle drives."""


@dataclass(frozen=True, kw_only=True)
class Online(Checked, Estimation, FolderCommand, group=""):
    """Map a log online, cycle by cycle, and write the map, the trajectory, the cycles and a summary."""

    log: Path = field(kw_only=False)
    """Folder of the log."""
    out: Path
    """Folder for the map."""
    estimator: Annotated[str, suggest(*ONLINE_NAMES)] = ONLINE_NAMES[0]
    """Name of the online estimator."""
    scale: float | None = None
    """Size of the scene by that of a Formula Student track, such as 0.1 for a model car of 1:10 and 3 for a
    road; by default that of the log."""
    map: MapKind = "boundaries"
    """Kind of map: two boundaries, or one centre line with a width."""
    on: Path | None = None
    """Known map on which the vehicle drives: a map's folder, a track file, `skidpad` or `acceleration`."""
    start: tuple[float, float, float] | None = None
    """Pose X Y HEADING (m, m, rad) on the known map near which the drive begins; by default anywhere."""
    keep_map: bool = False
    """Keep the known map fixed, and only localize."""
    map_sigma: float = 0.15
    """Standard deviation of the cones of a track file, m."""
    plot: Annotated[Path | None, FILE] = None
    """File for a picture of the map (.png, .pdf or .svg)."""
    view: bool = False
    """Show the run in the live viewer rerun."""
    save_view: Annotated[Path | None, FILE] = None
    """File (.rrd) for what the viewer shows."""
    recording: RecordingSettings = field(default_factory=RecordingSettings)


@dataclass(frozen=True, kw_only=True)
class Batch(Checked, Estimation, FolderCommand, group=""):
    """Optimize whole logs at once, and write the map, the trajectory, the cycles and a summary.

    Several logs of one track give one map, in the frame of the first, and a trajectory for each. A drive that
    does not fit the map of the others is left out, and the exit code is 3.
    """

    log: tuple[Path, ...] = field(kw_only=False)
    """Folder of the log, or folders of several drives of one track."""
    out: Path
    """Folder for the map."""
    estimator: Annotated[str, suggest(*BATCH_NAMES)] = BATCH_NAMES[0]
    """Name of the batch estimator."""
    scale: float | None = None
    """Size of the scene by that of a Formula Student track; by default that of the log."""
    map: MapKind = "boundaries"
    """Kind of map: two boundaries, or one centre line with a width."""
    start: Start | None = None
    """Where the optimization begins; by default that of `batch.start`."""


@dataclass(frozen=True, kw_only=True)
class Plot(Checked, Command, group=""):
    """Draw a map: both boundaries with their 2-sigma band, control points, trajectory and any truth."""

    map: Path = field(kw_only=False)
    """Folder of the map."""
    out: Annotated[Path, FILE]
    """File for the picture (.png, .pdf or .svg), or standard output (`-`)."""
    log: Path | None = None
    """Folder of the log whose truth is drawn as well."""
    band_scale: float = 1.0
    """Factor by which the band is widened in the picture; the legend states it."""
    title: str | None = None
    """Title of the picture."""


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a map in a format that planners and other tools read."""

    map: Path = field(kw_only=False)
    """Folder of the map. With `tum` it may also be a log, whose true path is written."""
    format: Annotated[Format, Parameter(name="--as")]
    """Format of the file: the centre line with widths as TUM raceline CSV (`centerline`), the trajectory in
    the TUM format (`tum`), boundaries and centre line as GeoJSON (`geojson`), both boundaries as CSV with the
    columns x, y and label (`points`), both boundaries with lanelets as OSM XML (`lanelet2`), or the centre
    line with the speed that friction and curvature allow as CSV (`profile`)."""
    out: Annotated[Path, FILE]
    """File for the result, or standard output (`-`)."""
    step: float = 1.0
    """Distance of the points along a curve (m)."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude of the map's origin (degrees, WGS84), and heading of its x axis, the direction
    of the vehicle at the start (degrees, clockwise from north). `geojson` and `lanelet2` need
    them."""
    speed: SpeedSettings = field(default_factory=SpeedSettings)
    """Vehicle of a `profile`."""
    start_speed: float | None = None
    """Speed at which the `profile` of an open track begins (m/s), by default what its curvature allows."""
    stop: bool = False
    """End the `profile` of an open track at a standstill."""
