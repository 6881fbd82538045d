"""A recording for the live viewer rerun, as a file or in a window."""

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.colors import to_hex, to_rgb

from pathspace_graph import labels
from pathspace_graph.errors import SettingsError, install
from pathspace_graph.eval.figures import drawing
from pathspace_graph.eval.figures.drawing import BLUE, DARK, GREEN, GREY, LIGHT, ORANGE, RED
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.health import CONDITIONS, LOST, Health
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import NAMES
from pathspace_graph.run import ObservedCycle

SUFFIX: Final = ".rrd"
DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")  # one is set with a display, on Linux
BAND_EVERY: Final = 10  # cycles from one band to the next: each needs the joint covariance of the map
PORT: Final = 9876  # the viewer's port, rerun's own; a viewer that is there already is used


def import_rerun(option: str) -> Any:
    """Return the package `rerun`; a SettingsError says how to install it where it is missing."""
    try:
        # the package is optional
        import rerun  # noqa: PLC0415
        import rerun.blueprint  # noqa: PLC0415
    except ImportError as error:
        told = f"{option}: expected the package rerun-sdk, found none; {install('view')}"
        raise SettingsError(told) from error
    return rerun


def check_recording(file: Path | None, window: bool) -> None:
    """Raise a SettingsError where a recording could not be opened, before anything is mapped."""
    if file is not None:
        if file.suffix.lower() != SUFFIX:
            raise SettingsError(f"{file}: expected a recording's name that ends in {SUFFIX}")
        check_file_target(file)
    if file is not None or window:
        import_rerun("--view" if window else "--save-view")
    if window and sys.platform.startswith("linux") and not any(map(os.environ.get, DISPLAYS)):
        names = " or ".join(DISPLAYS[:2])
        hint = f"--save-view FILE{SUFFIX} writes the recording without a window"
        raise SettingsError(f"--view: expected a display ({names}), found none; {hint}")


@contextmanager
def recording(
    file: Path | str | None = None,
    *,
    window: bool = False,
    truth: Truth | None = None,
) -> "Iterator[Recorder]":
    """Yield an observer that records each cycle, and the true cones if known, to a file, a window, or both.

    The file appears as a whole at the end, in the place of an earlier one; the window stays open.
    """
    target = None if file is None else Path(file)
    check_recording(target, window)
    rerun = import_rerun("recording")
    with ExitStack() as stack:
        path = None if target is None else stack.enter_context(atomic_file(target))
        stream = rerun.RecordingStream("pathspace_graph")
        stack.callback(stream.disconnect)  # before the file gets its name
        sinks = [] if path is None else [rerun.FileSink(str(path))]
        if window:
            beside = Path(sys.executable).with_name("rerun")  # need not be on the path
            viewer = {
                "executable_path": str(beside) if beside.exists() else None,
                "hide_welcome_screen": True,
            }
            try:  # to start it, unless one is there already
                rerun.spawn(port=PORT, connect=False, recording=stream, **viewer)
                socket.create_connection(("127.0.0.1", PORT), 2.0).close()
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
                raise SettingsError(f"--view: the viewer could not be started: {reason}") from error
            except OSError as error:
                told = f"--view: expected the viewer on port {PORT}, found none: {error}"
                raise SettingsError(told) from error
            sinks.append(rerun.GrpcSink(f"rerun+http://127.0.0.1:{PORT}/proxy"))
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.set_sinks(*sinks, default_blueprint=blueprint(rerun))
        yield Recorder(rerun, stream, truth)


# --- what is shown --------------------------------------------------------------------------------------

TIMELINES: Final = ("cycle", "time")  # timelines of the perception cycles, from 0, and of the log's time (s)
TIMELINE, TIME = TIMELINES

MAP: Final = "map"  # entity above all that has a place, in the map frame (m)
TRAJECTORY: Final = f"{MAP}/trajectory"  # way from the pose of the cycle before
VEHICLE: Final = f"{MAP}/vehicle"
WINDOW: Final = f"{MAP}/window"
READINGS: Final = f"{MAP}/readings"  # above `used`, `gated` or, where that is not known, `detected`
FEET: Final = f"{READINGS}/feet"  # line from each detection in use to its foot point
TRUE_CONES: Final = f"{MAP}/truth/cones"

HEALTH: Final = "health"
MESSAGES: Final = "messages"
UPDATE: Final = "update"  # entity above the time of each update (ms)
SIZES: Final = "size"  # entity above the numbers of control points or landmarks
READING_COUNTS: Final = "readings"  # entity above the numbers of detections that were offered and used

OUTLINE: Final = np.array([[1.8, 0.0], [-0.9, 0.7], [-0.9, -0.7], [1.8, 0.0]])  # vehicle (m)
LOW, MIDDLE, HIGH, TOP = 10.0, 20.0, 30.0, 40.0  # order of drawing, the last one on top
_SERIES: Final = {  # colour of each curve over time
    f"{UPDATE}/milliseconds": BLUE,
    f"{SIZES}/left": BLUE,
    f"{SIZES}/right": ORANGE,
    f"{READING_COUNTS}/offered": GREY,
    f"{READING_COUNTS}/used": GREEN,
}


def blueprint(rerun: Any) -> Any:
    """Return the arrangement: the map on the left, and all else below each other on the right."""
    views = rerun.blueprint
    beside = views.Vertical(
        views.StateTimelineView(origin=HEALTH, name="health"),
        views.TimeSeriesView(origin=UPDATE, name="time per cycle [ms]"),
        views.TimeSeriesView(origin=SIZES, name="size of the map"),
        views.TimeSeriesView(origin=READING_COUNTS, name="readings per cycle"),
        views.TextLogView(origin=MESSAGES, name="messages"),
        row_shares=[1, 2, 2, 2, 2],
    )
    begin, now = rerun.TimeRangeBoundary.infinite(), rerun.TimeRangeBoundary.cursor_relative()
    ranges = [rerun.VisibleTimeRange(name, start=begin, end=now) for name in TIMELINES]
    look = {"background": (255, 255, 255), "overrides": {TRAJECTORY: views.VisibleTimeRanges(ranges)}}
    track = views.Spatial2DView(origin="/", contents=f"{MAP}/**", name="map", **look)
    return views.Blueprint(
        views.Horizontal(track, beside, column_shares=[3, 2]),
        views.TimePanel(timeline=TIMELINE, state="collapsed"),
        views.BlueprintPanel(state="collapsed"),
        views.SelectionPanel(state="collapsed"),
    )


class Recorder:
    """Shows each cycle to a stream of rerun: places and numbers; colours and sizes once, for all times."""

    def __init__(self, rerun: Any, stream: Any, truth: Truth | None) -> None:
        self._rerun, self._stream = rerun, stream
        self._last_pose: Array | None = None
        self._last_health = Health()
        self._closed = False
        keep = partial(stream.log, static=True)
        lines, points = rerun.LineStrips2D, rerun.Points2D
        sides = drawing.BOUNDARY_COLORS.items()
        pale = [(label, to_hex(0.5 + 0.5 * np.array(to_rgb(color)))) for label, color in sides]
        styles = [  # kind, entity, colour, radius and order of drawing
            *((lines, _path(k, "curve"), color, 1.5, MIDDLE) for k, color in sides),
            *((lines, _path(k, "tentative"), color, 1.0, MIDDLE) for k, color in sides),
            *((lines, _path(k, "band"), color, 0.7, LOW) for k, color in pale),
            *((points, _path(k, "points"), color, 2.0, MIDDLE) for k, color in sides),
            (points, _path(labels.ORANGE, "points"), RED, 2.0, MIDDLE),
            (points, _path(labels.BIG_ORANGE, "points"), RED, 3.0, MIDDLE),
            (lines, TRAJECTORY, GREEN, 0.7, MIDDLE),
            (lines, WINDOW, GREEN, 2.0, HIGH),
            (lines, VEHICLE, "#000000", 1.5, TOP),
            (lines, FEET, DARK, 0.7, HIGH),
            (points, f"{READINGS}/used", DARK, 3.0, TOP),
            (points, f"{READINGS}/gated", RED, 3.0, TOP),
            (points, f"{READINGS}/detected", GREY, 3.0, TOP),
            (points, TRUE_CONES, LIGHT, 2.0, LOW),
        ]
        # the y axis of a two-dimensional view points down, as that of a picture does
        keep(MAP, rerun.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))
        for kind, path, color, radius, order in styles:
            radii = [rerun.Radius.ui_points(radius)]
            keep(path, kind.from_fields(colors=[_rgb(color)], radii=radii, draw_order=order))
        for path, color in _SERIES.items():
            name = path.rpartition("/")[2]
            keep(path, rerun.SeriesLines(colors=[_rgb(color)], names=[name], widths=[1.0]))
        colors = [_rgb(drawing.HEALTH_COLORS.get(condition, GREEN)) for condition in CONDITIONS]
        keep(HEALTH, rerun.StateConfiguration(values=list(CONDITIONS), colors=colors))
        if truth is not None and len(truth.cones):
            keep(TRUE_CONES, rerun.Points2D(truth.cones))

    def __call__(self, cycle: ObservedCycle) -> None:
        rerun, log, pose = self._rerun, self._stream.log, np.asarray(cycle.result.pose, float)
        self._stream.set_time(TIMELINE, sequence=cycle.number)
        self._stream.set_time(TIME, duration=cycle.detections.t)
        self._show_map(cycle.outline)
        replaced = cycle.result.jump is not None or cycle.result.closed != self._closed
        if cycle.number % BAND_EVERY == 0 or replaced:
            for label, boundary in cycle.map.boundaries.items():
                if isinstance(boundary, SplineBoundary):
                    u = drawing.curve_parameters(boundary.spline, 6)
                    band = [*drawing.uncertainty_band(boundary, u)]
                else:
                    band = [*drawing.ellipse_outlines(boundary.points, boundary.covariance)]
                self._lines(_path(label, "band"), band)
        self._lines(VEHICLE, [to_map(OUTLINE, np.tile(pose, (len(OUTLINE), 1)))])
        before = pose if self._last_pose is None else self._last_pose
        self._lines(TRAJECTORY, [np.array([before[:2], pose[:2]])])
        self._last_pose = pose
        if len(cycle.window):
            self._lines(WINDOW, [cycle.window[:, :2]])
        readings, seen = cycle.readings, cycle.detections.points_vehicle
        if readings is None:
            self._points(f"{READINGS}/detected", to_map(seen, np.tile(pose, (len(seen), 1))))
        else:
            self._points(f"{READINGS}/used", readings.points[readings.used])
            self._points(f"{READINGS}/gated", readings.points[~readings.used])
            self._lines(FEET, list(np.stack([readings.points, readings.feet], axis=1)[readings.used]))
        values = (1e3 * cycle.seconds, *cycle.result.sizes, len(seen), cycle.result.readings)
        for path, value in zip(_SERIES, values, strict=True):
            if np.isfinite(value):
                log(path, rerun.Scalars(value))
        self._show_messages(cycle)

    def _lines(self, path: str, strips: list[Array]) -> None:
        self._stream.log(path, self._rerun.LineStrips2D.from_fields(strips=strips))

    def _points(self, path: str, points: Array) -> None:
        self._stream.log(path, self._rerun.Points2D.from_fields(positions=points))

    def _show_map(self, track: Map) -> None:
        """Show each curve, its tentative stretch dashed, control points or landmarks, and orange cones."""
        for label, boundary in (*track.boundaries.items(), *track.points.items()):
            if isinstance(boundary, PointBoundary):
                self._points(_path(label, "points"), boundary.points)
                continue
            confirmed, tentative = drawing.curve_parts(boundary, 6)
            self._lines(_path(label, "curve"), [confirmed])
            dashes = [tentative[k : k + 2] for k in range(0, len(tentative) - 1, 2)]
            self._lines(_path(label, "tentative"), dashes)
            self._points(_path(label, "points"), boundary.spline.distinct_control_points)

    def _show_messages(self, cycle: ObservedCycle) -> None:
        result, health, levels = cycle.result, cycle.result.health, self._rerun.TextLogLevel
        if health.condition and health.condition != self._last_health.condition:
            self._stream.log(HEALTH, self._rerun.StateChange(state=[health.condition]))
        said = list[tuple[str, str]]()
        if health.condition and health != self._last_health:
            level = (
                levels.ERROR if health.condition == LOST else levels.WARN if health.reason else levels.INFO
            )
            said.append((": ".join(filter(None, (health.condition, health.reason))), level))
        told = [f"the loop is closed, on {sum(result.sizes)} points"] * (result.closed and not self._closed)
        if result.jump is not None:
            told.append(f"the pose has jumped by {np.hypot(*result.jump[:2]):.2f} m")
        if told or result.notice:
            said.append(("; ".join(filter(None, (*told, result.notice))), levels.INFO))
        for text, level in said:
            self._stream.log(MESSAGES, self._rerun.TextLog(text, level=level))
        self._last_health, self._closed = health, result.closed


def _path(label: int, part: str) -> str:
    return f"{MAP}/{NAMES[label]}/{part}"


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(color.removeprefix("#")))
