"""The recorder: an observer that shows each cycle of a run to the live viewer rerun."""

from typing import Any, Final

import numpy as np
from matplotlib.colors import to_hex, to_rgb

from pathspace_graph.eval.figures.map_plot import BOUNDARY_COLORS, HEALTH_COLORS, TRAJECTORY_COLOR
from pathspace_graph.eval.figures.style import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    curve_parameters,
    ellipse_outlines,
    uncertainty_band,
)
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.health import CONDITIONS, LOST, Health
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import BIG_ORANGE, BOUNDARIES, NAMES
from pathspace_graph.labels import ORANGE as ORANGE_CONE
from pathspace_graph.run import ObservedCycle
from pathspace_graph.settings.output import RecordingSettings

from . import entities

WIDEST_BAND: Final = 5.0
"""Largest width of a band on either side of its curve, m."""
VEHICLE: Final = np.array([[1.8, 0.0], [-0.9, 0.7], [-0.9, -0.7], [1.8, 0.0]])
"""The vehicle is shown as this triangle (m, vehicle frame)."""
LOW, MIDDLE, HIGH, TOP = 10.0, 20.0, 30.0, 40.0
"""Things are drawn in this order, the last one on top."""
_PALE: Final = 0.5
"""The edges of a band have this share of their boundary's colour, and the rest is white."""
_MILLISECONDS: Final = 1e3


class Recorder:
    """Shows each cycle to a stream of rerun; `recording` makes one, and `run.run_online` calls it.

    Colours and sizes are logged once, for all times. Each cycle logs places and numbers.
    """

    def __init__(self, rerun: Any, stream: Any, settings: RecordingSettings, truth: Truth | None) -> None:
        self._rerun, self._stream, self._settings = rerun, stream, settings
        self._last_pose: Array | None = None
        self._last_health = Health()
        self._closed = False
        self._set_styles()
        if truth is not None and len(truth.cones):
            stream.log(entities.TRUE_CONES, rerun.Points2D(truth.cones), static=True)

    def __call__(self, cycle: ObservedCycle) -> None:
        """Records one cycle."""
        self._stream.set_time(entities.TIMELINE, sequence=cycle.number)
        self._stream.set_time(entities.TIME, duration=cycle.detections.t)
        self._show_map(cycle.outline)
        if cycle.number % self._settings.band_every == 0 or self._is_replaced(cycle):
            self._show_bands(cycle.map)
        self._show_vehicle(cycle)
        self._show_readings(cycle)
        self._show_figures(cycle)
        self._tell(cycle)

    def _is_replaced(self, cycle: ObservedCycle) -> bool:
        """Returns whether the cycle has replaced the map, so that the last band is not beside it any more."""
        return cycle.result.jump is not None or cycle.result.closed != self._closed

    # --- colours and sizes -------------------------------------------------------------------------------

    def _set_styles(self) -> None:
        """Logs what stays as it is: the map's y axis points up, colours, widths and the order of drawing."""
        rerun, log = self._rerun, self._log_static
        # the y axis of a two-dimensional view points down, as that of a picture does
        log(entities.MAP, rerun.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))
        for label in BOUNDARIES:
            color = BOUNDARY_COLORS[label]
            self._style_lines(_path(label, "curve"), color, 1.5, MIDDLE)
            self._style_lines(_path(label, "tentative"), color, 1.0, MIDDLE)
            self._style_lines(_path(label, "band"), pale(color), 0.7, LOW)
            self._style_points(_path(label, "points"), color, 2.0, MIDDLE)
        for label in (ORANGE_CONE, BIG_ORANGE):
            self._style_points(_path(label, "points"), RED, 3.0 if label == BIG_ORANGE else 2.0, MIDDLE)
        self._style_lines(entities.TRAJECTORY, TRAJECTORY_COLOR, 0.7, MIDDLE)
        self._style_lines(entities.WINDOW, TRAJECTORY_COLOR, 2.0, HIGH)
        self._style_lines(entities.VEHICLE, "#000000", 1.5, TOP)
        self._style_lines(entities.FEET, DARK, 0.7, HIGH)
        for name, color in (("used", DARK), ("gated", RED), ("detected", GREY)):
            self._style_points(f"{entities.READINGS}/{name}", color, 3.0, TOP)
        self._style_points(entities.TRUE_CONES, LIGHT, 2.0, LOW)
        self._style_series()

    def _style_series(self) -> None:
        """Names the curves over time, and colours them; the conditions of health have those of the plots."""
        rerun = self._rerun
        for path, color in (
            (f"{entities.UPDATE}/milliseconds", BLUE),
            (f"{entities.SIZES}/left", BLUE),
            (f"{entities.SIZES}/right", ORANGE),
            (f"{entities.READING_COUNTS}/offered", GREY),
            (f"{entities.READING_COUNTS}/used", GREEN),
        ):
            name = path.rpartition("/")[2]
            self._log_static(path, rerun.SeriesLines(colors=[_rgb(color)], names=[name], widths=[1.0]))
        colors = [_rgb(HEALTH_COLORS.get(condition, GREEN)) for condition in CONDITIONS]
        self._log_static(entities.HEALTH, rerun.StateConfiguration(values=list(CONDITIONS), colors=colors))

    def _style_lines(self, path: str, color: str, width: float, order: float) -> None:
        radius = self._rerun.Radius.ui_points(width)
        style = {"colors": [_rgb(color)], "radii": [radius], "draw_order": order}
        self._log_static(path, self._rerun.LineStrips2D.from_fields(**style))

    def _style_points(self, path: str, color: str, radius: float, order: float) -> None:
        style = {
            "colors": [_rgb(color)],
            "radii": [self._rerun.Radius.ui_points(radius)],
            "draw_order": order,
        }
        self._log_static(path, self._rerun.Points2D.from_fields(**style))

    def _log_static(self, path: str, what: Any) -> None:
        self._stream.log(path, what, static=True)

    # --- what has a place --------------------------------------------------------------------------------

    def _lines(self, path: str, strips: list[Array]) -> None:
        self._stream.log(path, self._rerun.LineStrips2D.from_fields(strips=strips))

    def _points(self, path: str, points: Array) -> None:
        self._stream.log(path, self._rerun.Points2D.from_fields(positions=points))

    def _show_map(self, track: Map) -> None:
        """Shows each curve, its tentative stretch dashed, control points or landmarks, and orange cones."""
        for label, boundary in (*track.boundaries.items(), *track.points.items()):
            if isinstance(boundary, PointBoundary):
                self._points(_path(label, "points"), boundary.points)
                continue
            u = curve_parameters(boundary.spline, self._settings.samples_per_span)
            until = boundary.confirmed_until
            confirmed, tentative = u[u <= until], u[u > until]
            if len(tentative):
                confirmed, tentative = np.append(confirmed, until), np.append(until, tentative)
            self._lines(_path(label, "curve"), [boundary.spline.evaluate(confirmed)])
            self._lines(_path(label, "tentative"), dashes(boundary.spline.evaluate(tentative)))
            self._points(_path(label, "points"), boundary.spline.distinct_control_points)

    def _show_bands(self, track: Map) -> None:
        for label, boundary in track.boundaries.items():
            self._lines(_path(label, "band"), self._band(boundary))

    def _band(self, boundary: MapBoundary) -> list[Array]:
        """Returns both edges of a curve's band, or the ellipse of each landmark."""
        if isinstance(boundary, SplineBoundary):
            u = curve_parameters(boundary.spline, self._settings.samples_per_span)
            return list(uncertainty_band(boundary, u, widest=WIDEST_BAND))
        return list(ellipse_outlines(boundary.points, boundary.covariance))

    def _show_vehicle(self, cycle: ObservedCycle) -> None:
        """Shows the vehicle, the way that it has come since the cycle before, and the window."""
        pose = np.array(cycle.result.pose, float)
        self._lines(entities.VEHICLE, [to_map(VEHICLE, np.tile(pose, (len(VEHICLE), 1)))])
        before = pose if self._last_pose is None else self._last_pose
        self._lines(entities.TRAJECTORY, [np.array([before[:2], pose[:2]])])
        self._last_pose = pose
        if len(cycle.window):
            self._lines(entities.WINDOW, [cycle.window[:, :2]])

    def _show_readings(self, cycle: ObservedCycle) -> None:
        """Shows the readings, used and gated ones apart where the estimator says it, and foot points."""
        readings = cycle.readings
        if readings is None:
            local = cycle.detections.points_vehicle
            points = to_map(local, np.tile(np.asarray(cycle.result.pose, float), (len(local), 1)))
            self._points(f"{entities.READINGS}/detected", points)
            return
        self._points(f"{entities.READINGS}/used", readings.points[readings.used])
        self._points(f"{entities.READINGS}/gated", readings.points[~readings.used])
        feet = np.stack([readings.points[readings.used], readings.feet[readings.used]], axis=1)
        self._lines(entities.FEET, list(feet))

    # --- what has none -----------------------------------------------------------------------------------

    def _show_figures(self, cycle: ObservedCycle) -> None:
        """Shows the figures that are curves over time."""
        left, right = cycle.result.sizes
        figures: dict[str, float] = {
            f"{entities.SIZES}/left": left,
            f"{entities.SIZES}/right": right,
            f"{entities.READING_COUNTS}/offered": len(cycle.detections.labels),
            f"{entities.READING_COUNTS}/used": cycle.result.readings,
        }
        if np.isfinite(cycle.seconds):
            figures[f"{entities.UPDATE}/milliseconds"] = _MILLISECONDS * cycle.seconds
        for path, value in figures.items():
            self._stream.log(path, self._rerun.Scalars(value))

    def _tell(self, cycle: ObservedCycle) -> None:
        """Tells of a new condition of health with its reason, of the closing of the loop, and of notices."""
        result, health, levels = cycle.result, cycle.result.health, self._rerun.TextLogLevel
        if health.condition and health.condition != self._last_health.condition:
            self._stream.log(entities.HEALTH, self._rerun.StateChange(state=[health.condition]))
        if health.condition and health != self._last_health:
            level = (
                levels.ERROR if health.condition == LOST else levels.WARN if health.reason else levels.INFO
            )
            self._say(f"{health.condition}: {health.reason}" if health.reason else health.condition, level)
        if result.closed and not self._closed:
            self._say(f"the loop is closed, on {sum(result.sizes)} points", levels.INFO)
        if result.jump is not None:
            self._say(f"the pose has jumped by {np.hypot(*result.jump[:2]):.2f} m", levels.INFO)
        if result.notice:
            self._say(result.notice, levels.INFO)
        self._last_health, self._closed = health, result.closed

    def _say(self, text: str, level: str) -> None:
        self._stream.log(entities.MESSAGES, self._rerun.TextLog(text, level=level))


def dashes(points: Array) -> list[Array]:
    """Returns every other piece of the line through points (k, 2)."""
    return [points[first : first + 2] for first in range(0, len(points) - 1, 2)]


def _path(label: int, part: str) -> str:
    """Returns the path of a part of a boundary."""
    return f"{entities.MAP}/{NAMES[label]}/{part}"


def pale(color: str) -> str:
    """Returns a colour "#rrggbb" mixed with white."""
    return str(to_hex(1.0 - _PALE * (1.0 - np.array(to_rgb(color)))))


def _rgb(color: str) -> tuple[int, ...]:
    """Returns red, green and blue, 0 to 255 each, of a colour "#rrggbb"."""
    return tuple(bytes.fromhex(color.removeprefix("#")))
