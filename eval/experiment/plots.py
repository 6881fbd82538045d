"""Maps side by side, the stretch where landmarks miss most cones, and the differences of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from pathspace_graph.eval.figures import map_plot, style
from pathspace_graph.eval.figures.map_plot import MARGIN, WHOLE_TRACK, MapStyle
from pathspace_graph.eval.figures.style import BLUE, DARK, GREY, RED, WIDTH
from pathspace_graph.eval.metrics.accuracy import MISSED_DISTANCE, cone_distances, mapped_points
from pathspace_graph.eval.metrics.metric import METRICS, PAPER
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES

from .frame import Contrast, contrasts
from .study import Study

COLUMNS: Final = (2, 3, 4)  # maps side by side; the first with which the figure fits a page is taken
MAX_HEIGHT: Final = 10.0  # height of a page (in)
HALF_SIZE: Final = np.array([17.0, 13.0])  # half width and half height of a blind spot's stretch (m)
DISTANCES: Final = (MISSED_DISTANCE, 2.0, 1.0)  # distances (m) of a missed cone, as they are tried
MAX_PANELS: Final = 3  # most metrics side by side in the figure of differences
# style of a panel that shows a short stretch of a track
CLOSE_UP: Final = MapStyle(curve_width=1.1, marker_size=4.2, landmark_size=3.0, path_width=0.8)


@dataclass(frozen=True, eq=False)
class BlindSpot:
    """Stretch of the track, and the true cones in it that maps miss."""

    centre: Array  # (2,) centre of the stretch, map frame (m)
    distance: float  # distance (m) within which nothing is mapped at a missed cone
    cones: int
    missed: tuple[Array, ...]  # positions (k, 2) of the cones that each map misses in the stretch


def find_blind_spot(truth: Truth, spline_map: Map, landmark_map: Map) -> BlindSpot | None:
    """Return the stretch where the landmark map misses the most cones that the spline map doesn't, if any.

    They are missed at the largest of `DISTANCES` at which a stretch misses several, else at the largest at
    which any is missed. Of equal stretches it is the one with the largest total distance, each up to 10 m.
    """
    cones = truth.cones[np.isin(truth.cone_labels, BOUNDARIES)]
    distances = [cone_distances(track, truth) for track in (spline_map, landmark_map)]
    best: BlindSpot | None = None
    for distance in DISTANCES:
        bridged = (distances[0] <= distance) & (distances[1] > distance)
        if bridged.any():
            points, weights = cones[bridged], np.minimum(distances[1][bridged], 10.0)
            near: Any = KDTree(points / HALF_SIZE).query_ball_point(points / HALF_SIZE, 1.0, p=np.inf)
            chosen = points[max(near, key=lambda members: (len(members), weights[members].sum()))]
            centre = 0.5 * (chosen.min(axis=0) + chosen.max(axis=0))
            inside = (np.abs(cones - centre) <= HALF_SIZE).all(axis=1)
            missed = tuple(cones[inside & (d > distance)] for d in distances)
            spot = BlindSpot(centre, distance, int(inside.sum()), missed)
            if len(spot.missed[1]) > 1:
                return spot
            best = best or spot
    return best


def blind_spot_figure(maps: Mapping[str, Map], reference: str, truth: Truth) -> Figure | None:
    """Return the reference beside the first landmark map that misses cones that it passes, or None."""
    kinds = {name: {type(boundary) for boundary in track.boundaries.values()} for name, track in maps.items()}
    points = [name for name, own in kinds.items() if PointBoundary in own]
    for name in points if reference not in points else ():
        spot = find_blind_spot(truth, maps[reference], maps[name])
        if spot is not None:
            return plot_blind_spot(spot, [(reference, maps[reference]), (name, maps[name])], truth)
    return None


@dataclass(frozen=True, eq=False)
class Drawn:
    """A map with the driven path (n, 3), map frame, and its metrics at the end of the log by their keys."""

    map: Map
    path: Array
    metrics: Mapping[str, Any]


def plot_maps(drawn: Mapping[str, Drawn], truth: Truth | None) -> Figure:
    """Draw a panel for the map of each estimator over the truth, with the driven path.

    All are of the area of the true cones, or else of all maps.
    """
    points = [] if truth is None else [truth.cones]
    if not sum(map(len, points)):
        points = [
            mapped_points(boundary) for one in drawn.values() for boundary in one.map.boundaries.values()
        ]
    together = np.concatenate([np.zeros((1, 2)), *points])
    low, high = together.min(axis=0) - MARGIN, together.max(axis=0) + MARGIN
    with style.figure_context():
        figure, panels, columns = _panels(len(drawn), (high - low) / 2.0)
        for axes, (name, one) in zip(panels, drawn.items(), strict=False):
            _draw_map(axes, one.map, truth, WHOLE_TRACK)
            map_plot.draw_trajectory(axes, one.path, WHOLE_TRACK)
            map_plot.draw_start(axes, WHOLE_TRACK)
            axes.set_title(_caption(name, one.metrics))
            style.set_frame(axes, low, high)
        _finish(figure, panels, len(drawn), columns)
    return figure


def plot_blind_spot(spot: BlindSpot, maps: Sequence[tuple[str, Map]], truth: Truth) -> Figure:
    """Draw the same area of several maps side by side, with rings around the cones that a map misses."""
    with style.figure_context():
        figure, panels, columns = _panels(len(maps), HALF_SIZE)
        for axes, (name, track), missed in zip(panels, maps, spot.missed, strict=False):
            _draw_map(axes, track, truth, CLOSE_UP)
            if (np.abs(spot.centre) < HALF_SIZE).all():
                map_plot.draw_start(axes, CLOSE_UP)
            ring = {"markersize": 8.0, "markerfacecolor": "none", "markeredgewidth": 1.0, "zorder": 8}
            text = f"missed: nothing within {spot.distance:g} m"
            style.draw_points(axes, missed, "o", RED, text, **ring)
            axes.set_title(f"{name}\n{len(missed)} of {spot.cones} true cones missed here")
            style.set_frame(axes, spot.centre - HALF_SIZE, spot.centre + HALF_SIZE)
        _finish(figure, panels, len(maps), columns)
    return figure


def _panels(count: int, half_size: Array) -> tuple[Figure, list[Axes], int]:
    """Return a figure, its panels and columns: `count` panels of that shape, as large as a page allows."""
    title, labels, gap, legend = 0.6, 0.48, 0.12, 2.0  # heights of text, and more than any legend (in)
    for columns in COLUMNS:
        rows = -(-max(count, 1) // columns)
        width = (WIDTH - labels) / columns - gap
        height = rows * (width * half_size[1] / half_size[0] + title) + labels
        if height <= MAX_HEIGHT:
            break
    figure = Figure((WIDTH, float(height) + legend), layout="compressed")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    return figure, list(panels.flat), columns


def _finish(figure: Figure, panels: list[Axes], used: int, columns: int) -> None:
    """Add axis titles to the outer panels and a legend, hide unused panels, and cut the figure."""
    for number, axes in enumerate(panels):
        axes.set_visible(number < used)
        if number % columns == 0:
            axes.set_ylabel("y [m]")
        if number + columns >= used:
            axes.set_xlabel("x [m]")
            axes.tick_params(labelbottom=True)
    style.grouped_legend(figure)
    style.fit_height(figure)


def _draw_map(axes: Axes, track: Map, truth: Truth | None, look: MapStyle) -> None:
    for label, boundary in sorted(track.boundaries.items()):
        map_plot.draw_boundary(axes, boundary, label, look)
    if truth is not None:
        map_plot.draw_truth(axes, truth, look)


def _caption(name: str, row: Mapping[str, Any]) -> str:
    known = [m for m in PAPER if row.get(m.key) is not None]
    *words, size = (f"{m.title} {m.text(float(row[m.key]))} {m.unit}".strip() for m in known)
    return "\n".join(filter(None, [name, ", ".join(words), size]))


# --- differences of a study -------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> Figure | None:
    """Draw pairs, mean and interval of each combination for the first metrics; None where no run differs."""
    every = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [p for p in every if any(d != 0.0 for contrast in p for d in contrast.differences)][:MAX_PANELS]
    if not panels:
        return None
    rows = [i for i in range(len(panels[0])) if any(panel[i].differences for panel in panels)]
    names = [_name(study, panels[0][i]) for i in rows]
    with style.figure_context():
        figure = Figure(figsize=(WIDTH, 1.1 + 0.24 * len(rows)), layout="constrained")
        all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, panel in zip(all_axes, panels, strict=True):
            _draw_differences(axes, [panel[i] for i in rows])
        all_axes[0].set_yticks(range(len(rows)), names)
        all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
        text = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
        figure.supxlabel(text)
    return figure


def _draw_differences(axes: Axes, rows: Sequence[Contrast]) -> None:
    metric = METRICS[rows[0].metric]
    rng = np.random.default_rng(0)
    axes.axvline(0.0, color=DARK, linewidth=0.6, zorder=1)
    for row, contrast in enumerate(rows):
        if contrast.difference is None or not contrast.difference.count:
            continue
        color = BLUE if contrast.significant else GREY
        pairs = metric.factor * np.array(contrast.differences)
        scattered = row + rng.uniform(-0.22, 0.22, len(pairs))  # so that they can be seen apart
        axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=3.5, zorder=2)
        mean, half = metric.factor * contrast.difference.mean, metric.factor * contrast.difference.half
        look: dict[str, Any] = {"color": color, "markersize": 4.5, "elinewidth": 1.0}
        axes.errorbar(mean, row, xerr=None if np.isnan(half) else half, fmt="o", zorder=3, **look)
    axes.set_title(metric.heading)
    axes.grid(axis="x")


def _name(study: Study, contrast: Contrast) -> str:
    """Return the names of a combination that others have differently, `sigma_spacing=1` for
    `gauge.sigma_spacing=1` unless two groups have a setting of one name."""
    counts = {"noise": study.noises, "estimator": study.estimators, "variant": study.points}
    several = [getattr(contrast, column) for column, of in counts.items() if len(of) > 1]
    name = ", ".join(several) or f"{contrast.estimator}: {contrast.variant}"
    last = {field: field.rpartition(".")[2] for field in study.varied}
    if len(set(last.values())) == len(last):
        for field, short in last.items():
            name = name.replace(f"{field}=", f"{short}=")
    return name
