"""Maps side by side, and the differences of a study."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pathspace_graph.eval.figures import map_plot, style
from pathspace_graph.eval.figures.map_plot import MARGIN
from pathspace_graph.eval.figures.style import BLUE, DARK, GREY, WIDTH
from pathspace_graph.eval.metrics.accuracy import mapped_points
from pathspace_graph.eval.metrics.measures import METRICS, PAPER
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map

from .statistics import Contrast, contrasts
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
    half_size = (high - low) / 2.0
    title, labels, gap, legend = 0.6, 0.48, 0.12, 2.0  # heights of text, and more than any legend (in)
    for columns in COLUMNS:
        rows = -(-max(len(drawn), 1) // columns)
        width = (WIDTH - labels) / columns - gap
        height = rows * (width * half_size[1] / half_size[0] + title) + labels
        if height <= MAX_HEIGHT:
            break
    with style.figure_context():
        figure = Figure((WIDTH, float(height) + legend), layout="compressed")
        panels = [*figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat]
        for axes, (name, one) in zip(panels, drawn.items(), strict=False):
            for label, boundary in sorted(one.map.boundaries.items()):
                map_plot.draw_boundary(axes, boundary, label)
            if truth is not None:
                map_plot.draw_truth(axes, truth)
            map_plot.draw_trajectory(axes, one.path)
            map_plot.draw_start(axes)
            known = [m for m in PAPER if one.metrics.get(m.key) is not None]
            *words, size = (f"{m.title} {m.text(float(one.metrics[m.key]))} {m.unit}".strip() for m in known)
            axes.set_title("\n".join(filter(None, [name, ", ".join(words), size])))
            style.set_frame(axes, low, high)
        for number, axes in enumerate(panels):
            axes.set_visible(number < len(drawn))
            if number % columns == 0:
                axes.set_ylabel("y [m]")
            if number + columns >= len(drawn):
                axes.set_xlabel("x [m]")
                axes.tick_params(labelbottom=True)
        style.shared_legend(figure)
        style.fit_height(figure)
    return figure


# --- differences of a study -------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> style.Picture:
    """Draw pairs, mean and interval of the difference of each combination from the baseline.

    The panels are the first metrics in which any run differs; where none does, there are means in their
    place.
    """
    every = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [p for p in every if any(d != 0.0 for contrast in p for d in contrast.differences)][:MAX_PANELS]
    differ, panels = bool(panels), panels or every[:MAX_PANELS]
    rows = [i for i in range(len(panels[0])) if not differ or any(panel[i].differences for panel in panels)]
    with style.figure_context():
        figure = style.Picture(figsize=(WIDTH, 1.1 + 0.24 * len(rows)), layout="constrained")
        all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, panel in zip(all_axes, panels, strict=True):
            metric, rng = METRICS[panel[0].metric], np.random.default_rng(0)
            if differ:
                axes.axvline(0.0, color=DARK, linewidth=0.6, zorder=1)
            for row, contrast in enumerate(panel[i] for i in rows):
                shown = contrast.difference if differ else contrast.value
                if shown is None or not shown.count:
                    continue
                color = BLUE if contrast.significant else GREY
                pairs = metric.factor * np.array(contrast.differences)
                scattered = row + rng.uniform(-0.22, 0.22, len(pairs))  # so that they can be seen apart
                axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=3.5, zorder=2)
                mean, half = metric.factor * shown.mean, metric.factor * shown.half
                look: dict[str, Any] = {"color": color, "markersize": 4.5, "elinewidth": 1.0, "zorder": 3}
                axes.errorbar(mean, row, xerr=None if np.isnan(half) else half, fmt="o", **look)
            axes.set_title(metric.heading)
            axes.grid(axis="x")
        all_axes[0].set_yticks(range(len(rows)), [_name(study, panels[0][i]) for i in rows])
        all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
        text = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
        figure.supxlabel(text if differ else "mean and 95 % interval")
    return figure


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
