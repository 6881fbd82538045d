"""Maps side by side, and the differences of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pathspace_graph.eval.figures import map_plot, style
from pathspace_graph.eval.figures.map_plot import MARGIN
from pathspace_graph.eval.figures.style import BLUE, DARK, GREY, WIDTH
from pathspace_graph.eval.metrics.accuracy import mapped_points
from pathspace_graph.eval.metrics.metric import METRICS, PAPER
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map

from .frame import Contrast, contrasts
from .study import Study

COLUMNS: Final = (2, 3, 4)  # maps side by side; the first with which the figure fits a page is taken
MAX_HEIGHT: Final = 10.0  # height of a page (in)
MAX_PANELS: Final = 3  # most metrics side by side in the figure of differences


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
            _draw_map(axes, one.map, truth)
            map_plot.draw_trajectory(axes, one.path)
            map_plot.draw_start(axes)
            axes.set_title(_caption(name, one.metrics))
            style.set_frame(axes, low, high)
        _finish(figure, panels, len(drawn), columns)
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


def _draw_map(axes: Axes, track: Map, truth: Truth | None) -> None:
    for label, boundary in sorted(track.boundaries.items()):
        map_plot.draw_boundary(axes, boundary, label)
    if truth is not None:
        map_plot.draw_truth(axes, truth)


def _caption(name: str, row: Mapping[str, Any]) -> str:
    known = [m for m in PAPER if row.get(m.key) is not None]
    *words, size = (f"{m.title} {m.text(float(row[m.key]))} {m.unit}".strip() for m in known)
    return "\n".join(filter(None, [name, ", ".join(words), size]))


# --- differences of a study -------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> style.Picture | None:
    """Draw pairs, mean and interval of each combination for the first metrics; None where no run differs."""
    every = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [p for p in every if any(d != 0.0 for contrast in p for d in contrast.differences)][:MAX_PANELS]
    if not panels:
        return None
    rows = [i for i in range(len(panels[0])) if any(panel[i].differences for panel in panels)]
    names = [_name(study, panels[0][i]) for i in rows]
    with style.figure_context():
        figure = style.Picture(figsize=(WIDTH, 1.1 + 0.24 * len(rows)), layout="constrained")
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
