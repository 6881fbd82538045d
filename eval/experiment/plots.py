"""Figures: differences from the baseline, faults, and maps side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from pathspace_graph.eval.figures import map_plot, style
from pathspace_graph.eval.figures.map_plot import MARGIN, WHOLE_TRACK, MapStyle
from pathspace_graph.eval.figures.style import BLUE, DARK, GREEN, GREY, ORANGE, RED, WIDTH
from pathspace_graph.eval.metrics.accuracy import MISSED_DISTANCE, cone_distances, mapped_points
from pathspace_graph.eval.metrics.metric import METRICS, PAPER
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.labels import BOUNDARIES

from .cells import Outcome
from .faults import CLEAN, by_kind, fault_of
from .frame import Contrast, contrasts
from .study import Study

MAX_PANELS: Final = 3
"""Most metrics side by side in the figure of differences."""
FAULT_COLUMNS: Final = 4
"""Panels side by side in the figure of faults."""
COLUMNS: Final = (2, 3, 4)
"""Numbers of maps side by side; the first with which the figure fits a page is taken."""
MAX_HEIGHT: Final = 10.0
"""Height of a page (in)."""
DISTANCES: Final = (MISSED_DISTANCE, 2.0, 1.0)
"""Distances (m) within which nothing is mapped at a missed cone, in the order in which they are tried."""
CLOSE_UP: Final = MapStyle(curve_width=1.1, marker_size=4.2, landmark_size=3.0, path_width=0.8)
"""Style of a panel that shows a short stretch of a track."""


# --- differences -----------------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> Figure | None:
    """Draw every pair, their mean and its interval: a row for each combination, a panel for each metric.

    Only the first metrics of the study have a panel, and there is none where no run differs.
    """
    panels = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [p for p in panels if any(d != 0.0 for contrast in p for d in contrast.differences)]
    panels = panels[:MAX_PANELS]
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
    counts = {"noise": study.noise, "estimator": study.estimators, "variant": study.points}
    several = [getattr(contrast, column) for column, of in counts.items() if len(of) > 1]
    name = ", ".join(several) or f"{contrast.estimator}: {contrast.variant}"
    last = {field: field.rpartition(".")[2] for field in study.varied}
    if len(set(last.values())) == len(last):
        for field, short in last.items():
            name = name.replace(f"{field}=", f"{short}=")
    return name


# --- faults ----------------------------------------------------------------------------------------------


def plot_faults(study: Study, runs: pd.DataFrame) -> Figure:
    """Draw a panel for each kind of fault: the mean, and every run, filled where anything was said.

    The runs are those of `beside_clean`.
    """
    panels = [noises for noises in by_kind(study) if noises != [CLEAN]]
    rows = max(1, -(-len(panels) // FAULT_COLUMNS))
    with style.figure_context():
        figure = Figure(figsize=(WIDTH, 0.5 + 1.45 * rows), layout="constrained")
        every = figure.subplots(rows, FAULT_COLUMNS, sharey=True, squeeze=False).ravel()
        for axes, noises in zip(every, panels, strict=False):
            _draw_fault(axes, noises, runs)
        for axes in every[len(panels) :]:
            axes.set_visible(False)
        ratios = np.append(runs["ratio"].dropna(), 1.0)
        every[0].set_yscale("log")
        every[0].set_ylim(ratios.min() / 1.15, ratios.max() * 1.15)
        style.label_logarithms(every[0])
        figure.supylabel("rmse by that of the clean run")
        style.shared_legend(figure, columns=6)
    return figure


def _draw_fault(axes: Axes, noises: Sequence[str], runs: pd.DataFrame) -> None:
    axes.axhline(1.0, color=DARK, linewidth=0.6)
    means = []
    for at, noise in enumerate(noises):
        own = runs[runs["noise"] == noise]
        means.append(own["ratio"].mean())
        spread = 0.15 if len(own) > 1 else 0.0
        places = at + np.linspace(-spread, spread, len(own))
        for place, *run in zip(places, own["ratio"], own["lost_at_end"] == 1.0, own["told"], strict=True):
            _draw_faulty_run(axes, float(place), *run)
    known = np.flatnonzero(~np.isnan(means))
    if len(known):
        axes.plot(known, np.array(means)[known], color=BLUE, linewidth=0.9, label="mean", zorder=1)
    faults = [fault_of(noise) for noise in noises]
    axes.set_xticks(range(len(faults)), [f"{fault.value:g}" for fault in faults])
    axes.set_xlim(-0.5, len(faults) - 0.5)
    title = f"{faults[0].kind} [{faults[0].unit}]".removesuffix(" []")
    cut = title.rfind(" ", 0, 30) if len(title) > 30 else 0
    axes.set_title(f"{title[:cut]}\n{title[cut + 1 :]}" if cut > 0 else title)
    axes.grid(axis="y")


def _draw_faulty_run(axes: Axes, at: float, ratio: float, lost: bool, told: bool) -> None:
    """Draw a triangle where the vehicle is lost at the end, a cross at the top where there is no map."""
    if np.isnan(ratio):
        edge = axes.get_xaxis_transform()
        axes.plot(at, 0.95, "x", color=ORANGE, markersize=4.0, transform=edge, label="no map")
        return
    color = ORANGE if lost else GREEN
    label = f"{'lost at the end' if lost else 'not lost'}{', said so' if told else ''}"
    look: dict[str, Any] = {"markerfacecolor": color if told else "none", "markersize": 4.0}
    axes.plot(at, ratio, "^" if lost else "o", color=color, markeredgewidth=0.8, label=label, **look)


# --- maps side by side ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BlindSpot:
    """Stretch of the track, and the true cones in it that maps miss."""

    centre: Array
    """Centre (2,) of the stretch in m, map frame."""
    half_size: tuple[float, float]
    """Half width and half height of the stretch (m)."""
    distance: float
    """Distance (m) within which nothing is mapped at a missed cone."""
    cones: int
    missed: tuple[Array, ...]
    """Positions (k, 2) of the cones that each map misses in the stretch."""


def find_blind_spot(
    truth: Truth, spline_map: Map, landmark_map: Map, half_size: tuple[float, float] = (17.0, 13.0)
) -> BlindSpot | None:
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
            centre = _densest(cones[bridged], np.minimum(distances[1][bridged], 10.0), half_size)
            inside = (np.abs(cones - centre) <= half_size).all(axis=1)
            missed = tuple(cones[inside & (d > distance)] for d in distances)
            spot = BlindSpot(centre, half_size, distance, int(inside.sum()), missed)
            if len(spot.missed[1]) > 1:
                return spot
            best = best or spot
    return best


def _densest(points: Array, weights: Array, half_size: tuple[float, float]) -> Array:
    """Return the centre (2,) of the points (k, 2) around the one with most neighbours, then most weight."""
    scaled = points / np.array(half_size)
    neighbours = KDTree(scaled).query_ball_point(scaled, 1.0, p=np.inf)
    best = max(neighbours, key=lambda members: (len(members), float(weights[members].sum())))
    chosen: Array = points[best]
    return np.asarray(0.5 * (chosen.min(axis=0) + chosen.max(axis=0)))


def plot_maps(outcomes: Sequence[Outcome], log: Log) -> Figure:
    """Draw a panel for each map over the truth, all of the same area; failures have no panel."""
    drawn = [(outcome, outcome.result.map) for outcome in outcomes if outcome.result is not None]
    low, high = _extent([track for _, track in drawn], log.truth)
    with style.figure_context():
        figure, panels, columns = _panels(len(drawn), (high - low) / 2.0)
        for axes, (outcome, track) in zip(panels, drawn, strict=False):
            _draw_map(axes, track, log.truth, WHOLE_TRACK)
            map_plot.draw_start(axes, WHOLE_TRACK)
            axes.set_title(_caption(outcome))
            style.set_frame(axes, low, high)
        _finish(figure, panels, len(drawn), columns)
    return figure


def plot_blind_spot(spot: BlindSpot, maps: Sequence[tuple[str, Map]], truth: Truth) -> Figure:
    """Draw the same area of several maps side by side, with rings around the cones that a map misses."""
    half_size = np.array(spot.half_size)
    shows_start = bool((np.abs(spot.centre) < half_size).all())
    with style.figure_context():
        figure, panels, columns = _panels(len(maps), half_size)
        for axes, (name, track), missed in zip(panels, maps, spot.missed, strict=False):
            _draw_map(axes, track, truth, CLOSE_UP)
            if shows_start:
                map_plot.draw_start(axes, CLOSE_UP)
            ring = {"markersize": 8.0, "markerfacecolor": "none", "markeredgewidth": 1.0, "zorder": 8}
            text = f"missed: nothing within {spot.distance:g} m"
            style.draw_points(axes, missed, "o", RED, text, **ring)
            axes.set_title(f"{name}\n{len(missed)} of {spot.cones} true cones missed here")
            style.set_frame(axes, spot.centre - half_size, spot.centre + half_size)
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


def _caption(outcome: Outcome) -> str:
    row = outcome.rows[-1].values
    *words, size = (f"{m.title} {m.text(float(row[m.key]))} {m.unit}".strip() for m in PAPER if m.key in row)
    return "\n".join([outcome.names["estimator"], ", ".join(words), size])


def _extent(maps: Sequence[Map], truth: Truth | None) -> tuple[Array, Array]:
    """Return two corners (2,) around the true cones and a margin, or around all maps without true cones."""
    points = [truth.cones] if truth is not None and len(truth.cones) else []
    if not points:
        points = [mapped_points(boundary) for track in maps for boundary in track.boundaries.values()]
    together = np.concatenate([np.zeros((1, 2)), *points])
    return together.min(axis=0) - MARGIN, together.max(axis=0) + MARGIN
