"""The film of a run: the map as it grows, with the vehicle and what is known by then, as .gif or .mp4."""

import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray
from PIL import Image

from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.eval.figures import map_plot, style
from pathspace_graph.eval.figures.map_plot import BOUNDARY_COLORS, TRAJECTORY_COLOR, MapStyle
from pathspace_graph.eval.figures.style import DARK, LIGHT, RED
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.eval.metrics.summary import has_cones, lap_times
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES
from pathspace_graph.run import ObservedCycle, Readings
from pathspace_graph.settings.output import FilmSettings

SUFFIXES: Final = (".gif", ".mp4")
DPI: Final = 100.0  # resolution of a frame (dots per inch), which decides how large the text is
VEHICLE: Final = np.array([[2.4, 0.0], [-1.2, 1.2], [-0.6, 0.0], [-1.2, -1.2]])  # arrow (m), larger than life
Pixels = NDArray[np.uint8]
_STYLE: Final = MapStyle(curve_width=1.4, path_width=0.8, marker_size=2.8, widest_band=5.0)
"""Lines are wider than on paper, since a film has few pixels."""
_MAP_PLACE: Final = (0.07, 0.085, 0.69, 0.845)  # left, bottom, width and height, as shares of the frame
_TEXT_PLACE: Final = (0.775, 0.085, 0.212, 0.845)
_FRAME_STEP: Final = 10.0  # step (m) by which the part of the plane that is shown grows


def lap_seconds(log: Log) -> float:
    """Return how long a lap of the log takes (s), by its truth, or by how far the odometry turns.

    A log of less than three quarters of a turn is taken as one lap.
    """
    if not log.cycles:
        return 1.0
    ends, begin, end = lap_times(log), log.cycles[0].t, log.cycles[-1].t
    if len(ends) and ends[0] > begin:
        return float(ends[0] - begin)
    driven = log.odometry.between(begin, end)
    turns = abs(float(driven.twist[:, 2] @ np.diff(np.append(driven.t, end)))) / (2.0 * np.pi)
    return ((end - begin) / (turns if turns > 0.75 else 1.0)) or 1.0


Film = Callable[[Figure, float], None]
"""Function that takes a figure as the next frame of a film, which is shown for a time (s)."""


def check_film_file(file: Path | str) -> None:
    """Raise where no film can be written to `file`, before anything is drawn."""
    suffix = Path(file).suffix.lower()
    if suffix not in SUFFIXES:
        raise SettingsError(f"{file}: expected a film's name that ends in {' or '.join(SUFFIXES)}")
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise SettingsError(
            f"{file}: expected the program ffmpeg for .mp4, found none; a .gif needs no program"
        )
    check_file_target(file)


@contextmanager
def film(file: Path | str, frames_per_second: float) -> Iterator[Film]:
    """Yield a film that is at `file` on success; an earlier one is kept as a numbered backup."""
    check_film_file(file)
    written = _gif if Path(file).suffix.lower() == ".gif" else _mp4
    with atomic_file(file) as temporary, written(temporary, frames_per_second) as add:
        yield add


@contextmanager
def _gif(file: Path, _: float) -> Iterator[Film]:
    """Collect the frames, each in colours of its own, for Pillow's writer."""
    frames, times = list[Image.Image](), [0.0]

    def add(figure: Figure, seconds: float) -> None:
        # one index of the palette is left for what does not change
        frames.append(Image.fromarray(pixels_of(figure)).quantize(255, dither=Image.Dither.NONE))
        times.append(times[-1] + seconds)

    yield add
    if not frames:
        raise OutputError(f"{file.name}: expected a film of at least one frame, found none")
    # rounded to 0.01 s so that errors do not add up
    durations = (10 * np.diff(np.round(100.0 * np.array(times)).astype(int))).tolist()
    options: dict[str, Any] = {"save_all": True, "append_images": frames[1:], "duration": durations}
    frames[0].save(file, format="GIF", loop=0, **options)


def pixels_of(figure: Figure) -> Pixels:
    """Return a figure as pixels (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba(), np.uint8)[:, :, :3]


@contextmanager
def _mp4(file: Path, frames_per_second: float) -> Iterator[Film]:
    """Hand the frames to ffmpeg by matplotlib's writer."""
    writer = FFMpegWriter(fps=cast(int, frames_per_second))  # ffmpeg takes any number

    def add(figure: Figure, seconds: float) -> None:
        if not hasattr(writer, "fig"):
            writer.setup(figure, str(file), figure.dpi)
        writer.fig = figure
        for _ in range(max(1, round(seconds * writer.fps))):
            writer.grab_frame()

    try:
        yield add
        writer.finish()
    except (subprocess.CalledProcessError, BrokenPipeError) as error:
        raise OutputError(f"{file.name}: ffmpeg could not write the film: {error}") from error


class Animation:
    """Draws a frame of a film at equal steps of the log's time; it is an observer of `run.run_online`.

    Call `finish` at the end. The true cones are drawn, and held against the map, where there is a truth.
    """

    def __init__(
        self,
        film: Film,
        lap_seconds: float,
        settings: FilmSettings,
        truth: Truth | None = None,
        title: str = "",
    ) -> None:
        self.settings = settings
        self._film, self._lap, self._truth, self._title = film, lap_seconds, truth, title
        self._begin: float | None = None
        self._frames = 0
        self._poses: list[Array] = []
        self._healths: list[str] = []
        self._seconds: list[float] = []
        self._notice, self._notice_until = "", -np.inf
        self._was_closed, self._size = False, 0
        self._low, self._high = np.full(2, -30.0), np.full(2, 30.0)
        self._cones = np.zeros((0, 2)) if truth is None else truth.cones
        self._show(self._cones)
        self._figure = Figure(figsize=(self.settings.width / DPI, self.settings.height / DPI), dpi=DPI)
        self._axes = self._figure.add_axes(_MAP_PLACE)
        self._text = self._figure.add_axes(_TEXT_PLACE)

    def __call__(self, cycle: ObservedCycle) -> None:
        t, result = cycle.detections.t, cycle.result
        self._begin = t if self._begin is None else self._begin
        film_time = (t - self._begin) * self.settings.seconds_per_lap / self._lap
        if film_time > self.settings.laps * self.settings.seconds_per_lap:
            return
        self._poses.append(np.array(result.pose, float))
        self._healths.append(result.health.condition)
        self._seconds.append(cycle.seconds)
        self._listen(cycle, film_time)
        due = int(film_time * self.settings.frames_per_second) + 1 - self._frames
        if due > 0:
            self._draw(cycle, film_time)
            self._film(self._figure, due / self.settings.frames_per_second)
            self._frames += due

    def finish(self) -> None:
        if self._frames:
            self._film(self._figure, self.settings.hold)

    def _listen(self, cycle: ObservedCycle, film_time: float) -> None:
        result, told = cycle.result, [cycle.result.notice] if cycle.result.notice else []
        if result.closed and not self._was_closed:
            told.append(f"loop closed: {self._size} control points become {sum(result.sizes)}")
        if result.jump is not None:
            told.append(f"the lap was solved again: the pose moves by {np.hypot(*result.jump[:2]):.2f} m")
        if told:
            self._notice, self._notice_until = "\n".join(told), film_time + 2.0
        self._was_closed, self._size = result.closed, sum(result.sizes)

    def _draw(self, cycle: ObservedCycle, film_time: float) -> None:
        axes = self._axes
        with style.figure_context():
            axes.clear()
            style.draw_points(axes, self._cones, "x", LIGHT, markersize=3.0, markeredgewidth=0.7, zorder=1)
            for label, boundary in sorted(cycle.map.boundaries.items()):
                map_plot.draw_boundary(axes, boundary, label, _STYLE)
            for label, cones in sorted(cycle.map.points.items()):
                map_plot.draw_orange(axes, cones.points, label, _STYLE)
            path = np.array(self._poses)
            map_plot.draw_trajectory(axes, path, _STYLE, self._healths)
            _draw_readings(axes, cycle.readings, path[-1])
            _draw_vehicle(axes, path[-1], cycle.window)
            self._show(path[-1:, :2])
            self._set_frame(film_time)
            self._write(cycle)

    def _show(self, points: Array) -> None:
        """Enlarge what is shown so that it holds points (k, 2), m, map frame."""
        if len(points):
            low, high = points.min(axis=0) - map_plot.MARGIN, points.max(axis=0) + map_plot.MARGIN
            self._low = np.minimum(self._low, _FRAME_STEP * np.floor(low / _FRAME_STEP))
            self._high = np.maximum(self._high, _FRAME_STEP * np.ceil(high / _FRAME_STEP))

    def _set_frame(self, film_time: float) -> None:
        axes, middle = self._axes, 0.5 * (self._low + self._high)
        box = np.array([_MAP_PLACE[2] * self.settings.width, _MAP_PLACE[3] * self.settings.height])
        half = 0.5 * box * ((self._high - self._low) / box).max()  # the map's place is filled
        style.set_frame(axes, middle - half, middle + half)
        axes.set_xlabel("x [m]", labelpad=1.0)
        axes.set_ylabel("y [m]", labelpad=0.0)
        axes.set_title(self._title, fontsize=10.0)
        if film_time < self._notice_until:
            frame = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": DARK, "alpha": 0.9}
            place: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.transAxes}
            axes.text(0.5, 0.5, self._notice, fontsize=10.0, bbox=frame, zorder=20, **place)

    def _write(self, cycle: ObservedCycle) -> None:
        axes = self._text
        axes.clear()
        axes.set_axis_off()
        moments = _moments(cycle, self._seconds) | _against_truth(cycle.map, self._truth)
        self._seconds.clear()
        for number, (name, value) in enumerate(moments.items()):
            y = 1.0 - 0.062 * (number + 0.5)
            color = map_plot.HEALTH_COLORS.get(value, TRAJECTORY_COLOR) if name == "health" else "black"
            axes.text(0.0, y, name, color=DARK, va="center", fontsize=8.5)
            axes.text(1.0, y, value, color=color, va="center", ha="right", fontsize=8.5)
        handles = _legend(self._truth, bool(cycle.map.points))
        axes.legend(handles=handles, loc="lower left", borderaxespad=0.0, borderpad=0.0)


def _moments(cycle: ObservedCycle, seconds: Sequence[float]) -> dict[str, str]:
    """Return the figures of the moment, each with its unit."""
    result, condition = cycle.result, cycle.result.health.condition
    points = any(isinstance(one, PointBoundary) for one in cycle.map.boundaries.values())
    moments = {
        "time": f"{result.t:.1f} s",
        "lap": str(cycle.lap),
        "loop": "closed" if result.closed else "open",
        "landmarks" if points else "control points": " + ".join(map(str, result.sizes)),
        "readings used": f"{result.readings} of {len(cycle.detections.labels)}",
        "update": f"{1e3 * float(np.mean(seconds)):.1f} ms",
    }
    return moments | ({"health": condition} if condition else {})


def _against_truth(track: Map, truth: Truth | None) -> dict[str, str]:
    if not has_cones(truth):
        return {}
    metrics = lap_metrics(track, truth, 0)
    rmse = "" if np.isnan(metrics.rmse) else f"{metrics.rmse:.2f} m"
    return {"rmse": rmse, "cones missed": f"{100.0 * metrics.missed:.0f} %"}


def _draw_readings(axes: Axes, readings: Readings | None, pose: Array) -> None:
    if readings is None or len(readings.points) == 0:
        return
    for chosen, color, marker in ((readings.used, DARK, "o"), (~readings.used, RED, "x")):
        points = readings.points[chosen]
        for point in points:
            axes.plot(*np.array([pose[:2], point]).T, color=color, linewidth=0.35, alpha=0.6, zorder=5)
        style.draw_points(axes, points, marker, color, markersize=3.2, markeredgewidth=1.0, zorder=8)


def _draw_vehicle(axes: Axes, pose: Array, window: Array) -> None:
    """Draw the vehicle at its pose (3,), and the window of poses (P, 3) behind it."""
    axes.plot(*window[:, :2].T, color=TRAJECTORY_COLOR, linewidth=2.6, solid_capstyle="round", zorder=6)
    outline = to_map(VEHICLE, np.tile(pose, (len(VEHICLE), 1)))
    axes.add_patch(Polygon(outline, facecolor="black", edgecolor="white", linewidth=0.5, zorder=10))


def _legend(truth: Truth | None, orange: bool) -> list[Any]:
    def line(name: str, color: str, **look: Any) -> Line2D:
        return Line2D([], [], color=color, label=name, **look)

    def mark(name: str, color: str, marker: str) -> Line2D:
        return line(name, color, marker=marker, linestyle="none", markersize=4.0)

    entries = [
        *(line(f"{NAMES[label]} boundary", BOUNDARY_COLORS[label], linewidth=1.4) for label in BOUNDARIES),
        line("tentative", BOUNDARY_COLORS[LEFT], linestyle=map_plot.TENTATIVE_DASHES),
        Patch(facecolor=BOUNDARY_COLORS[LEFT], alpha=map_plot.BAND_ALPHA, label=f"{style.SIGMAS:g}σ band"),
        mark("reading, used", DARK, "o"),
        mark("reading, gated", RED, "x"),
        line("trajectory", TRAJECTORY_COLOR, linewidth=0.8),
        line("window", TRAJECTORY_COLOR, linewidth=2.6),
    ]
    if orange:
        entries.append(mark("orange cone", RED, "^"))
    return entries if truth is None or len(truth.cones) == 0 else [*entries, mark("true cone", LIGHT, "x")]
