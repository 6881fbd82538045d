"""A result as one page of HTML for any browser: map, poses by time, health, notices, other map."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from bokeh.document import Document
from bokeh.embed import file_html
from bokeh.events import DocumentReady, Tap
from bokeh.models import ColumnDataSource, CustomJS, Div, HoverTool, Slider, Span
from bokeh.plotting import figure
from bokeh.resources import INLINE
from bokeh.themes import Theme
from jinja2 import Template

from pathspace_graph.eval.figures import drawing
from pathspace_graph.eval.figures.drawing import BLUE, DARK, GREEN, GREY, LIGHT, ORANGE, PURPLE, RED
from pathspace_graph.eval.figures.notebook import notice, sections, table
from pathspace_graph.eval.metrics.accuracy import mapped_points
from pathspace_graph.eval.metrics.alignment import STEP, MapsApart
from pathspace_graph.factors.arrays import Array
from pathspace_graph.health import GOOD, Health, stretches
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary
from pathspace_graph.labels import NAMES

from .recording import OUTLINE

TRAIL: Final = 10.0  # time for which the path behind the vehicle is thick (s)
OVER: Final[dict[str, Any]] = {  # of a figure over the time or along a boundary
    **{"height": 165, "sizing_mode": "stretch_width"},
    **{"min_border_left": 55, "toolbar_location": None},  # the axes below each other
}

PAGE, MOVE, PICK = (
    Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.html", "move.js", "pick.js")
)
"""The page around the figures, and scripts that place the vehicle and pick a cycle."""


def page(
    title: str,
    track: Map,
    cycles: pd.DataFrame,
    summary: Mapping[str, Any],
    *,
    passed: Array | None = None,
    other: tuple[str, Map, MapsApart] | None = None,
) -> str:
    """HTML of a result, with all scripts in it, so that it needs no server and no network.

    `cycles` are those of `frames.run_frame`, with poses x, y (m) and theta (rad) in the map frame, and
    `passed` the poses (n, 3) as they were estimated at their time, where those of `cycles` are smoothed.
    `other` is the name of another map, the map, and how it lies on this one (`maps_apart(other, track)`).
    """
    begin = float(cycles["t"].iloc[0])
    optional = {"offered": 0, "health": "", "reason": ""}
    missing = {name: value for name, value in optional.items() if name not in cycles}
    cycles = cycles.assign(since=cycles["t"] - begin, ms=1e3 * cycles["seconds"], **missing)
    source = ColumnDataSource({name: cycles[name].to_numpy() for name in cycles}, name="cycles")
    vehicle, driven = (ColumnDataSource({"x": [], "y": []}, name=name) for name in ("vehicle", "driven"))
    readout, last = Div(name="readout", sizing_mode="stretch_width"), len(cycles) - 1
    slider = Slider(name="slider", title="cycle", start=0, end=last, value=last, sizing_mode="stretch_width")

    drawn = _map_figure(track, source, summary, passed, other)
    look = {"color": GREEN, "line_width": 4, "legend_label": f"last {TRAIL:g} s"}
    drawn.line("x", "y", source=driven, **look)
    drawn.patch("x", "y", source=vehicle, color="black", line_width=4)
    drawn.legend.update(ncols=3, label_width=88, location="center")
    drawn.add_layout(drawn.legend[0], "below")
    over, told = _time_figures(source, summary, begin), sections(summary)
    cursors = [Span(location=0.0, dimension="height") for _ in over]
    for one, cursor in zip(over, cursors, strict=True):
        one.add_layout(cursor)
        one.js_on_event(Tap, CustomJS(args={"cycles": source, "slider": slider}, code=PICK))
    if other is not None:
        name, known, apart = other
        if shared := sorted(set(track.splines) & set(apart.distances)):
            axes = {"title": f"distance from {name} [m]", "x_axis_label": "along the boundary [m]"}
            beside = figure(name="over distance", tools="", **axes, **OVER)
            for label in shared:  # of each curve of the map, along it
                own = apart.distances[label][len(mapped_points(known.boundaries[label], STEP)) :]
                line = {"color": drawing.BOUNDARY_COLORS[label], "legend_label": NAMES[label]}
                beside.line(STEP * np.arange(len(own)), own, name=f"distance {NAMES[label]}", **line)
            _legend_above(beside)
            over.append(beside)
        rows = [(of, *(f"{x:.3f}" for x in own.values())) for of, own in apart.statistics().items()]
        told[f"Distance from {name}"] = table(rows, ("boundary [m]", "mean", "rms", "p95", "max"))

    ahead, left = OUTLINE.T.tolist()
    moved = {"slider": slider, "vehicle": vehicle, "driven": driven, "readout": readout, "cursors": cursors}
    fixed = {"cycles": source, "ahead": ahead, "left": left, "trail": TRAIL}
    move = CustomJS(args=moved | fixed, code=MOVE)
    slider.js_on_change("value", move)
    legend = {"padding": 2, "margin": 0, "label_text_font_size": "9pt", "click_policy": "hide"}
    document = Document(theme=Theme(json={"attrs": {"Legend": legend}}))
    document.js_on_event(DocumentReady, move)
    for root in (slider, readout, drawn, *over):
        document.add_root(root)
    variables = {"sections": {escape(name): part for name, part in told.items()}}
    return str(
        file_html(document, INLINE, escape(title), template=Template(PAGE), template_variables=variables)
    )


def _map_figure(
    track: Map,
    source: ColumnDataSource,
    summary: Mapping[str, Any],
    passed: Array | None,
    other: tuple[str, Map, MapsApart] | None,
) -> figure:
    width, height = (np.ptp(source.data[axis]) + 20.0 for axis in "xy")
    shape = {"aspect_ratio": float(np.clip(width / height, 0.9, 1.5)), "sizing_mode": "scale_width"}
    tools: dict[str, Any] = {"tools": "pan,wheel_zoom,box_zoom,reset,save", "active_scroll": "wheel_zoom"}
    axes = {"x_axis_label": "x [m]", "y_axis_label": "y [m]", "toolbar_location": "above"}
    drawn = figure(name="map", match_aspect=True, **shape, **tools, **axes)
    drawn.toolbar.update(logo=None)
    for label, boundary in sorted(track.boundaries.items()):
        _draw_boundary(drawn, boundary, NAMES[label], drawing.BOUNDARY_COLORS[label])
    for label, cones in sorted(track.points.items()):
        name = f"{NAMES[label].replace('_', ' ')} cones"
        drawn.scatter(*cones.points.T, marker="triangle", size=8, color=RED, legend_label=name, name=name)
    if other is not None:
        name, known, apart = other
        for label, boundary in known.moved(apart.motion).boundaries.items():
            points, look = mapped_points(boundary), {"color": DARK, "name": f"other {NAMES[label]}"}
            if isinstance(boundary, PointBoundary):
                drawn.scatter(*points.T, size=4, legend_label=name, **look)
            else:
                drawn.line(*points.T, line_dash="dashed", legend_label=name, **look)
    if differences := summary.get("differences"):
        places = {axis: [one[axis] for one in differences] for axis in "xy"}
        drawn.scatter(**places, marker="x", size=10, color=PURPLE, legend_label="not as the known map")
    if passed is not None:
        drawn.line(*passed[:, :2].T, color=LIGHT, legend_label="as estimated then", name="passed")
    path = drawn.line("x", "y", source=source, color=GREEN, legend_label="path", name="path")
    for condition, color in drawing.HEALTH_COLORS.items():
        chosen = source.data["health"] == condition
        if chosen.any():
            x, y = (np.where(chosen, source.data[axis], np.nan) for axis in "xy")
            drawn.line(x, y, color=color, line_width=4, legend_label=condition, name=condition)
    tips = [("time", "@since{0.0} s"), ("lap", "@lap"), ("cycle", "$index"), ("health", "@health @reason")]
    drawn.add_tools(HoverTool(renderers=[path], tooltips=tips))
    return drawn


def _draw_boundary(drawn: figure, boundary: MapBoundary, name: str, color: str) -> None:
    """Draw a curve with its 2-sigma band, control points and cones, or landmarks with their ellipses."""
    band = {"color": color, "alpha": 0.3, "line_width": 0, "name": f"{name} band"}
    if isinstance(boundary, PointBoundary):
        ellipses = drawing.ellipse_outlines(boundary.points, boundary.covariance)
        drawn.patches(*(list(ellipses[:, :, axis]) for axis in (0, 1)), legend_label=f"{name}, 2σ", **band)
        drawn.scatter(*boundary.points.T, size=4, color=color, legend_label=f"{name} landmarks", name=name)
        return
    spline, (known, rest) = boundary.spline, drawing.curve_parts(boundary)
    left, right = drawing.uncertainty_band(boundary, drawing.curve_parameters(spline))
    drawn.patch(*np.concatenate([left, right[::-1]]).T, legend_label=f"{name}, 2σ band", **band)
    look = {"color": color, "line_width": 1.5}
    drawn.line(*known.T, legend_label=f"{name}, 2σ band", name=name, **look)
    if len(rest):
        end = f"{name} tentative"
        drawn.line(*rest.T, line_dash="dashed", legend_label=end, name=end, **look)
    if len(boundary.cones):
        cones, end = spline.evaluate(boundary.cones[:, 0]), f"{name} cones"
        drawn.scatter(*cones.T, size=5, color=color, legend_label=end, name=end)
    squares = {"marker": "square", "size": 5, "fill_color": "white", "line_color": color}
    points, end = spline.distinct_control_points, f"{name} control points"
    drawn.scatter(*points.T, legend_label="control points", name=end, visible=False, **squares)


def _time_figures(source: ColumnDataSource, summary: Mapping[str, Any], begin: float) -> list[figure]:
    """Health with notices, and the numbers of each cycle, over the time since the begin (s)."""
    data, tools = source.data, {"tools": "xpan,xwheel_zoom,reset", "active_scroll": "xwheel_zoom"}
    strip = OVER | {"height": 90, "y_range": (0, 1), "y_axis_type": None}
    bar = figure(name="over health", title="health, and notices", **tools, **strip)
    since, healths = data["since"], [*map(Health, data["health"], data["reason"])]
    watched = any(one.condition for one in healths)
    spans = [(GOOD if watched else "not monitored", 0.0, since[-1], "", GREEN if watched else LIGHT)]
    spans += [(*vars(one).values(), drawing.HEALTH_COLORS[one.health]) for one in stretches(since, healths)]
    names = ("health", "begin", "end", "reason", "color")
    bars = dict(zip(names, zip(*spans, strict=True), strict=True))
    look = {"fill_color": "color", "line_color": "color", "name": "health"}
    drawn = bar.quad("begin", "end", 1.0, 0.0, source=ColumnDataSource(bars), **look)
    tips = [("health", "@health @reason"), ("from", "@begin{0.0} s"), ("to", "@end{0.0} s")]
    bar.add_tools(HoverTool(renderers=[drawn], tooltips=tips))
    events = summary.get("events", [])
    told = {"since": [one["t"] - begin for one in events], "text": [notice(one) for one in events]}
    mark = {"marker": "inverted_triangle", "size": 11, "color": "black", "name": "notices"}
    drawn = bar.scatter("since", 0.5, source=ColumnDataSource(told), **mark)
    bar.add_tools(HoverTool(renderers=[drawn], tooltips=[("at", "@since{0.0} s"), ("notice", "@text")]))
    found = [bar]
    for title, lines in (
        ("detections per cycle", {"offered": ("offered", GREY), "readings": ("used", GREEN)}),
        ("control points or landmarks", {"size_left": ("left", BLUE), "size_right": ("right", ORANGE)}),
        ("time of an update [ms]", {"ms": ("wall time", BLUE)}),
    ):
        drawn = figure(name=f"over {title}", title=title, x_range=bar.x_range, **tools, **OVER)
        for column, (label, color) in lines.items():
            drawn.line("since", column, source=source, color=color, legend_label=label, name=column)
        _legend_above(drawn)
        found.append(drawn)
    found[-1].xaxis.update(axis_label="time [s]")
    return found


def _legend_above(drawn: figure) -> None:
    for legend in drawn.legend:
        legend.update(orientation="horizontal")
        drawn.add_layout(legend, "above")
