"""Legends name each thing once, in columns of a boundary each; a figure is cut to what is drawn on it."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.style import (
    check_plot_file,
    figure_context,
    fit_height,
    grouped_legend,
    save_plot,
    set_frame,
    shared_legend,
)


def two_panels(first: list[str], second: list[str]) -> Figure:
    """Two panels with a line for each label."""
    figure = Figure((7.0, 6.0), layout="compressed")
    for axes, labels in zip(figure.subplots(1, 2), (first, second), strict=True):
        for label in labels:
            axes.plot([0.0, 1.0], [0.0, 1.0], label=label)
    return figure


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_shared_legend_names_each_thing_once() -> None:
    figure = two_panels(["spline", "truth"], ["truth", "landmarks"])
    shared_legend(figure, 3)
    assert texts(figure) == ["spline", "truth", "landmarks"]


def test_a_grouped_legend_has_a_column_for_each_boundary_and_then_the_rest() -> None:
    """Columns have three rows, as the left boundary has; blanks fill the column of the right one."""
    figure = two_panels(["left band", "right band", "left boundary", "cones"], ["left points", "start"])
    grouped_legend(figure)
    assert texts(figure) == [
        *("left band", "left boundary", "left points"),
        *("right band", "", ""),
        *("cones", "start", ""),
    ]


def test_a_grouped_legend_needs_no_boundary() -> None:
    figure = two_panels(["start"], [])
    grouped_legend(figure)
    assert texts(figure) == ["start"]


def test_a_figure_is_as_high_as_what_is_drawn_and_a_margin() -> None:
    """Two square panels beside each other leave more than half of the height free."""
    figure = two_panels(["a"], ["b"])
    for axes in figure.axes:
        set_frame(axes, np.array([0.0, 0.0]), np.array([2.0, 2.0]))
    shared_legend(figure)
    fit_height(figure)
    figure.draw_without_rendering()
    width, height = figure.get_size_inches()
    drawn = figure.get_tightbbox().height
    assert width == 7.0
    assert drawn + 0.1 <= height < drawn + 0.2 < 4.5


def test_a_frame_has_equal_scales() -> None:
    axes = Figure().subplots()
    set_frame(axes, np.array([-1.0, 2.0]), np.array([3.0, 4.0]))
    assert axes.get_aspect() == 1.0
    assert (axes.get_xlim(), axes.get_ylim()) == ((-1.0, 3.0), (2.0, 4.0))


def test_the_context_is_left_as_it_was() -> None:
    before = Figure().subplots().title.get_fontsize()
    with figure_context():
        assert Figure().subplots().title.get_fontsize() == 8.0
    assert Figure().subplots().title.get_fontsize() == before


def test_a_picture_without_a_suffix_is_a_png_where_it_goes_to_a_stream(
    capfdbinary: pytest.CaptureFixture[bytes],
) -> None:
    save_plot(Figure((1.0, 1.0)), "-")
    assert capfdbinary.readouterr().out.startswith(b"\x89PNG")
    assert check_plot_file("/dev/null") == ".png"
    with pytest.raises(SettingsError, match=r"ends in \.png"):
        check_plot_file("picture")
