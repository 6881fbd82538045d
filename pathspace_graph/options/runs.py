"""What every command has in common, and the options of those that map logs, once or in studies."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from cyclopts import Group, Parameter

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.settings import mapper
from pathspace_graph.settings.checked import Checked, apart, flatten, override

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
Format = Literal["centerline", "tum", "geojson", "points", "lanelet2", "profile", "graph", "g2o", "dot"]


_SETTINGS: Final = Parameter(group=Group("Settings of the estimators", sort_key=2))


@dataclass(frozen=True, kw_only=True)
class Estimation(Command):
    """Options of every command that estimates."""

    file: Annotated[Path | None, Parameter(name="--settings"), _SETTINGS] = None
    """TOML file of settings, or the summary.json of a run; options on the command line override it. A section
    with the name of the estimator has parameters of its own."""
    settings: Annotated[mapper.MapperSettings, INLINE, _SETTINGS] = field(
        default_factory=mapper.MapperSettings
    )

    @classmethod
    def base(cls, given: Mapping[str, Sequence[str]]) -> mapper.MapperSettings | None:
        """Settings of the file, if any, which the command line overrides."""
        names = given.get("estimators", given.get("estimator", ()))
        return _read_settings(Path(given["file"][0]), names)[0] if "file" in given else None

    def own(self, estimators: Iterable[str]) -> dict[str, Any]:
        """Own parameters of these estimators, as `NAME.field`, from the file."""
        return {} if self.file is None else _read_settings(self.file, estimators)[1]


def _read_settings(file: Path, estimators: Iterable[str]) -> tuple[mapper.MapperSettings, dict[str, Any]]:
    """Settings with those of a file, and the own parameters of some estimators that it has.

    The file is TOML or a run's `summary.json`. An InputError says what is wrong with the settings.
    """
    parsing = import_module("pathspace_graph.io.parsing")  # the help need not wait for NumPy
    text = parsing.read_text(file, "a file of settings", parsing.MAX_HEADER_BYTES)
    content = (parsing.parse_json if file.suffix == ".json" else parsing.parse_toml)(text, file)
    table = content.get("settings", content) if isinstance(content, dict) else content
    if not isinstance(table, dict):
        raise InputError(file, f"expected a table of settings, found {parsing.shown(table)}")
    defaults = mapper.MapperSettings()
    try:
        overrides, own = apart(flatten(table), estimators, defaults)
        return override(defaults, overrides, ""), own
    except SettingsError as error:
        raise InputError(file, str(error)) from error


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
    estimator: Annotated[str, suggest(*mapper.ONLINE_NAMES)] = mapper.ONLINE_NAMES[0]
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
    estimator: Annotated[str, suggest(*mapper.BATCH_NAMES)] = mapper.BATCH_NAMES[0]
    """Name of the batch estimator."""
    scale: float | None = None
    """Size of the scene by that of a Formula Student track; by default that of the log."""
    map: MapKind = "boundaries"
    """Kind of map: two boundaries, or one centre line with a width."""
    start: mapper.Start | None = None
    """Where the optimization begins; by default that of `batch.start`."""
    graph: bool = False
    """Also write the optimized factor graph of a log (`graph.json`, 10 MB a lap), which `export` reads."""


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
class View(Command):
    """Write a result as one page for any browser, which needs no server and no network.

    Map with 2-sigma bands, path, the vehicle by time, health, notices, calibration and metrics.
    """

    result: Path = field(kw_only=False)
    """Folder of the map."""
    html: Annotated[Path, FILE]
    """File for the page, or standard output (`-`)."""
    other: Path | None = None
    """Folder of another map of the track, to align with this one and to draw beside it."""


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a map in a format that planners and other tools read."""

    map: Path = field(kw_only=False)
    """Folder of the map. With `tum` it may also be a log, whose true path is written."""
    format: Annotated[Format, Parameter(name="--as")]
    """Format of the file: the centre line with widths as TUM raceline CSV (`centerline`), the trajectory in
    the TUM format (`tum`), boundaries and centre line as GeoJSON (`geojson`), both boundaries as CSV with the
    columns x, y and label (`points`), both boundaries with lanelets as OSM XML (`lanelet2`), the centre
    line with the speed that friction and curvature allow as CSV (`profile`), or of a `batch --graph` the
    factor graph as JSON of GTSAM's texts (`graph`), for Graphviz (`dot`), or its poses with odometry and
    revisits (`g2o`)."""
    out: Annotated[Path, FILE]
    """File for the result, or standard output (`-`)."""
    step: float = 1.0
    """Distance of the points along a curve (m)."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude of the map's origin (degrees, WGS84), and heading of its x axis, the direction
    of the vehicle at the start (degrees, clockwise from north). `geojson` and `lanelet2` need
    them."""
    speed: mapper.SpeedSettings = field(default_factory=mapper.SpeedSettings)
    """Vehicle of a `profile`."""
    start_speed: float | None = None
    """Speed at which the `profile` of an open track begins (m/s), by default what its curvature allows."""
    stop: bool = False
    """End the `profile` of an open track at a standstill."""


# --- many runs, and their statistics ---------------------------------------------------------------------

EVERY = (*mapper.ONLINE_NAMES, *mapper.BATCH_NAMES)
STUDIES = tuple(sorted(file.stem for file in (Path(__file__).parents[1] / "eval" / "studies").glob("*.toml")))


@dataclass(frozen=True, kw_only=True)
class Compare(Estimation, FolderCommand):
    """Run every estimator on a log or a folder of logs; or compare two maps.

    Of logs, tables, figures and all maps are written; of two maps, their distances and a picture.

    The paper's table is printed, or without truth what can be said without it; files have all metrics.
    For several logs the tables have means. An estimator that fails is reported and does not stop the others;
    the exit code is 3 then. Finished runs are kept in `OUT.unfinished` until all are there, so that the same
    command resumes after it was killed.
    """

    log: tuple[Path, ...] = field(kw_only=False)
    """Folder of the log, or of several logs; or the folders of two maps of one track."""
    out: Path
    """Folder for tables, figures and maps."""
    estimators: Annotated[tuple[str, ...], suggest(*EVERY)] = ()
    """Names of the estimators, online and batch ones; by default all."""
    jobs: int = 1
    """Number of runs at a time, -1 for one on each core; times of updates are comparable with 1 only."""


@dataclass(frozen=True, kw_only=True)
class StudyCommand(Command):
    """Options of every command that runs a study."""

    out: Path
    """Folder for everything; a study that was begun there is continued."""
    jobs: int = -1
    """Number of processes at a time, -1 for one on each core."""
    cluster: str | None = None
    """Address of a Dask scheduler (tcp://HOST:8786) on whose workers the study runs instead."""
    keep: bool = False
    """Keep map, trajectory, cycles and summary of each run, in a folder of its cell."""
    retry_failed: bool = False
    """Run again what failed before."""
    tracks: tuple[str, ...] = ()
    """Track files, and seeds of generated tracks, in place of the study's own."""
    logs: tuple[Path, ...] = ()
    """Recorded logs, or folders of them, in place of the study's own drives, each of a track of its own."""
    seeds: tuple[int, ...] = ()
    """Seeds in place of the study's own."""
    laps: int | None = None
    """Number of laps in place of the study's own."""


@dataclass(frozen=True, kw_only=True)
class Ablate(StudyCommand):
    """Run a study, or what remains of it, and write its results, its summary and its figures."""

    study: Annotated[Path, suggest(*STUDIES)] = field(kw_only=False)
    """TOML file of the study, or name of one that comes with the package."""
    baseline: str | None = None
    """Variant or estimator that the others are compared with, in place of the study's own; a finished study
    gets new tables only."""


@dataclass(frozen=True, kw_only=True)
class FaultSuite(StudyCommand):
    """Run the suite of faults, or what remains of it, and write a table and a figure of what each costs.

    The suite is the shipped study `faults`. Each run is compared with the clean run on the same track and
    with the same seed.
    """

    estimator: Annotated[str, suggest(*EVERY)] = mapper.ONLINE_NAMES[0]
    """Name of the estimator, an online or a batch one."""
    only: tuple[str, ...] = ()
    """Names of the faults to run, as in the table."""
    quick: bool = False
    """Run each fault at its greatest strength only."""


@dataclass(frozen=True, kw_only=True)
class Scale(Estimation, FolderCommand):
    """Time every online estimator on ever larger maps and more and more detections, and draw the slopes.

    All run in this one process, cycle for cycle in turn, so that other work of the machine slows all of them
    alike. An estimator that takes longer than the budget is stopped there, and the table says so. Finished
    sweeps are kept in `OUT.unfinished` until all are there, so that the same command goes on where it was
    killed.
    """

    out: Path
    """Folder for points, slopes and figures."""
    estimators: Annotated[tuple[str, ...], suggest(*mapper.ONLINE_NAMES)] = ()
    """Names of the online estimators; by default all."""
    quick: bool = False
    """Take less than a minute, with small maps and few laps, to see that everything works. It excludes all
    other `scaling` options."""
    scaling: mapper.ScalingSettings = field(default_factory=mapper.ScalingSettings)
    """What is measured."""


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Measure the figures of the pages, or what remains of them, and write each table as a tidy CSV.

    The experiments are `accuracy`, `skidpad`, `camera`, `faults`, `hard`, `lines`, `endurance`, `centerline`,
    the ablations `stations`, `gauge`, `robust`, `density`, `lag`, `relinearize`, `degree` and `covariance`,
    and `known`, `joint`, `speed`, `scale` and, with logs, `real`. Each row of a table says by which
    command, at which commit, on which machine and when it was measured.
    """

    out: Path
    """Folder for the tables and the runs; a report that was begun there is continued."""
    jobs: int = -1
    """Number of processes at a time, -1 for one on each core."""
    only: tuple[str, ...] = ()
    """Names of the experiments to run."""
    tracks: tuple[Path, ...] = ()
    """Track files, or folders of them, that `accuracy` drives beside the generated tracks."""
    real: tuple[Path, ...] = ()
    """Folders of logs of a real car, which are mapped as well."""
    quick: bool = False
    """Drive little, to see that everything works."""
