"""A study's figures: paired differences from the baseline, and accuracy against size and against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pathspace_graph.eval.figures.style import BLUE, DARK, GREY
from pathspace_graph.eval.metrics.measures import METRICS

from .statistics import Contrast, contrasts
from .study import Study

ACCURACY: Final = "rmse"
SIZE: Final = "size"
TIME: Final = "ms_mean"
JITTER_SEED: Final = 0
"""Of the vertical scatter of single pairs, which means nothing."""


@dataclass(frozen=True)
class StudyPlotStyle:
    """How a study is drawn; lengths in inches, line widths and markers in points."""

    width: float = 7.0
    """Width of a figure: two columns of a paper."""
    row: float = 0.24
    """Height of a combination in the figure of differences."""
    furniture: float = 1.1
    """Height of what is around them."""
    scatter_height: float = 3.6
    """Height of accuracy against size or time, for each noise."""
    panels: int = 3
    """Most metrics side by side in the figure of differences."""
    font_size: float = 8.0
    """Of all text (pt)."""
    color: str = BLUE
    """Of a significant difference."""
    quiet_color: str = GREY
    """Of one that may be chance."""
    line_color: str = DARK
    """Of the baseline."""
    marker_size: float = 4.5
    """Of means."""
    point_size: float = 3.5
    """Of single pairs."""
    jitter: float = 0.22
    """Greatest vertical scatter of single pairs, in rows."""
    markers: str = "osD^v<>PXphd*"
    """Shapes, one after the other with the colours."""


def figures(study: Study, frame: pd.DataFrame, style: StudyPlotStyle | None = None) -> dict[str, Figure]:
    """Every figure that the study has runs for, by its file's name."""
    style = style or StudyPlotStyle()
    with mpl.rc_context({"font.size": style.font_size, "axes.linewidth": 0.6, "pdf.fonttype": 42}):
        drawn = {
            "differences": plot_differences(study, frame, style),
            "accuracy_size": plot_against(study, frame, SIZE, style),
            "accuracy_time": plot_against(study, frame, TIME, style),
        }
    return {name: figure for name, figure in drawn.items() if figure is not None}


# --- differences -----------------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame, style: StudyPlotStyle) -> Figure | None:
    """A row for each combination, a panel for each of the first metrics: every pair, mean and interval."""
    panels = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [panel for panel in panels if _differs(panel)][: style.panels]
    if not panels:
        return None
    rows = [i for i in range(len(panels[0])) if any(_is_known(panel[i]) for panel in panels)]
    figure = Figure(figsize=(style.width, style.furniture + style.row * len(rows)), layout="constrained")
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(all_axes, panels, strict=True):
        _draw_differences(axes, [panel[i] for i in rows], style)
    all_axes[0].set_yticks(range(len(rows)), [_row_name(study, panels[0][i]) for i in rows])
    all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
    told = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
    figure.supxlabel(told, fontsize=style.font_size)
    return figure


def _is_known(contrast: Contrast) -> bool:
    """Whether it isn't the baseline itself, and there are pairs."""
    return contrast.difference is not None and contrast.difference.count > 0


def _differs(panel: Sequence[Contrast]) -> bool:
    """Whether any run differs from the baseline."""
    return any(d != 0.0 for contrast in panel for d in contrast.differences)


def _draw_differences(axes: Axes, rows: Sequence[Contrast], style: StudyPlotStyle) -> None:
    metric = METRICS[rows[0].metric]
    rng = np.random.default_rng(JITTER_SEED)
    axes.axvline(0.0, color=style.line_color, linewidth=0.6, zorder=1)
    for row, contrast in enumerate(rows):
        if contrast.difference is None or not contrast.difference.count:
            continue
        color = style.color if contrast.significant else style.quiet_color
        pairs = metric.factor * np.array(contrast.differences)
        scattered = row + rng.uniform(-style.jitter, style.jitter, len(pairs))
        axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=style.point_size, zorder=2)
        mean, half = metric.factor * contrast.difference.mean, metric.factor * contrast.difference.half
        bar = None if np.isnan(half) else half
        axes.errorbar(
            mean, row, xerr=bar, fmt="o", color=color, markersize=style.marker_size, elinewidth=1.0, zorder=3
        )
    axes.set_title(metric.heading, fontsize=style.font_size)
    axes.tick_params(width=0.6, length=2.5)
    axes.grid(axis="x", linewidth=0.3, alpha=0.5)


def _row_name(study: Study, contrast: Contrast) -> str:
    several = [name for name in ("noise", "estimator", "variant") if len(_of(study, name)) > 1]
    return _brief(study, ", ".join(getattr(contrast, name) for name in several))


def _brief(study: Study, name: str) -> str:
    """`sigma_spacing=1` for `gauge.sigma_spacing=1`, where no other group's setting is called so."""
    last = {field: field.rpartition(".")[2] for field in study.varied}
    if len(set(last.values())) == len(last):
        for field, short in last.items():
            name = name.replace(f"{field}=", f"{short}=")
    return name


def _of(study: Study, name: str) -> Sequence[str]:
    return {"noise": list(study.noise), "estimator": study.estimators, "variant": list(study.points)}[name]


# --- accuracy against ------------------------------------------------------------------------------------


def plot_against(study: Study, frame: pd.DataFrame, metric: str, style: StudyPlotStyle) -> Figure | None:
    """Mean accuracy of each combination against the mean of another metric, with both intervals."""
    if metric not in frame or ACCURACY not in frame:
        return None
    across, up = contrasts(study, frame, metric), contrasts(study, frame, ACCURACY)
    figure = Figure(figsize=(style.width, style.scatter_height * len(study.noise)), layout="constrained")
    all_axes = figure.subplots(len(study.noise), 1, squeeze=False)[:, 0]
    for axes, noise in zip(all_axes, study.noise, strict=True):
        pairs = [(a, b) for a, b in zip(across, up, strict=True) if a.noise == noise and a.value.count]
        for index, (a, b) in enumerate(pairs):
            _draw_point(axes, a, b, index, _label(study, a), style)
        axes.set_xlabel(METRICS[metric].heading)
        axes.set_ylabel(METRICS[ACCURACY].heading)
        axes.set_title(noise if len(study.noise) > 1 else "", fontsize=style.font_size)
        axes.grid(linewidth=0.3, alpha=0.5)
        axes.tick_params(width=0.6, length=2.5)
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False)
    return figure


def _draw_point(
    axes: Axes, across: Contrast, up: Contrast, index: int, label: str, style: StudyPlotStyle
) -> None:
    x, y = METRICS[across.metric], METRICS[up.metric]
    axes.errorbar(
        x.factor * across.value.mean,
        y.factor * up.value.mean,
        xerr=None if np.isnan(across.value.half) else x.factor * across.value.half,
        yerr=None if np.isnan(up.value.half) else y.factor * up.value.half,
        fmt=style.markers[index % len(style.markers)],
        color=style.line_color if across.difference is None else f"C{index % 10}",
        markersize=style.marker_size,
        elinewidth=0.6,
        label=label,
    )


def _label(study: Study, contrast: Contrast) -> str:
    several = [name for name in ("estimator", "variant") if len(_of(study, name)) > 1]
    return _brief(study, ", ".join(getattr(contrast, name) for name in several) or contrast.name)
