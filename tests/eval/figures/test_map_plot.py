"""The picture of a map: everything is in sight, and the legend names it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import LEFT, RIGHT

from ...scenes.rings import shifted_ring


def ring_map() -> Map:
    return Map(True, {LEFT: shifted_ring(18.0), RIGHT: shifted_ring(22.0)})


def ring_log() -> Log:
    t = np.linspace(0.0, 2 * np.pi, 50)
    poses = np.stack([20.0 * np.sin(t), 20.0 * (1 - np.cos(t)), t], axis=1)
    truth = Truth(t, poses, np.array([[0.0, 2.0], [0.0, -2.0]]), np.array([LEFT, RIGHT]))
    return Log(Odometry(t, np.zeros((50, 3))), (), np.ones(3), truth=truth)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_legend_names_what_is_there_and_an_exaggerated_band() -> None:
    full = legend(plot_map(ring_map(), log=ring_log(), trajectory=np.zeros((4, 3))))
    assert {"left boundary", "right boundary", "true cones", "true path", "trajectory"} <= set(full)
    assert "left 2σ band" in full
    bare = legend(plot_map(ring_map(), band_scale=4.0))
    assert any("drawn 4× as wide" in text for text in bare)
    assert not {"true cones", "true path", "trajectory"} & set(bare)


def test_the_trajectory_has_other_colours_where_it_is_not_good() -> None:
    trajectory, health = np.arange(12.0).reshape(4, 3), ["good", "lost", "lost", "good"]
    figure = plot_map(ring_map(), trajectory=trajectory, health=health)
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    drawn = lines["lost"].get_xydata()
    np.testing.assert_array_equal(drawn[1:3], trajectory[1:3, :2])
    assert np.isnan(drawn[[0, 3]]).all() and "degraded" not in lines
    assert "lost" not in legend(plot_map(ring_map(), trajectory=trajectory, health=[]))


def test_a_smoothed_trajectory_is_drawn_over_the_poses_of_their_time() -> None:
    trajectory, smoothed = np.arange(12.0).reshape(4, 3), np.ones((4, 3))
    figure = plot_map(ring_map(), trajectory=trajectory, smoothed=smoothed, health=["lost"] * 4)
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    thin, drawn = lines["poses as estimated at their time"], lines["trajectory"]
    np.testing.assert_array_equal(thin.get_xydata(), trajectory[:, :2])
    np.testing.assert_array_equal(drawn.get_xydata(), smoothed[:, :2])
    np.testing.assert_array_equal(lines["lost"].get_xydata(), smoothed[:, :2])
    assert thin.get_linewidth() < drawn.get_linewidth()


def test_a_tentative_stretch_is_dashed() -> None:
    ring = shifted_ring(18.0)
    ring = replace(ring, confirmed_until=0.5 * sum(ring.spline.domain))
    figure = plot_map(Map(False, {LEFT: ring, RIGHT: shifted_ring(22.0)}))
    assert "left tentative" in legend(figure)
    assert "right tentative" not in legend(figure)
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    confirmed, tentative = lines["left boundary"], lines["left tentative"]
    assert (confirmed.get_linestyle(), tentative.get_linestyle()) == ("-", "--")
    np.testing.assert_allclose(confirmed.get_xydata()[-1], tentative.get_xydata()[0])


def test_equal_scales_and_everything_in_sight() -> None:
    figure = plot_map(ring_map(), log=ring_log(), title="ring")
    axes = figure.axes[0]
    assert axes.get_aspect() == 1.0
    assert axes.get_title("left") == "ring"
    assert axes.get_xlim()[0] < -22.4 and axes.get_xlim()[1] > 22.4
    assert axes.get_ylim()[0] < -2.4 and axes.get_ylim()[1] > 42.4


def test_maps_of_points_and_empty_maps_are_drawn() -> None:
    points = PointBoundary(np.array([[0.0, 1.0], [5.0, 1.0]]), np.diag([0.04, 0.01, 0.04, 0.01]))
    figure = plot_map(Map(False, {LEFT: points, RIGHT: PointBoundary(np.zeros((0, 2)), np.zeros((0, 0)))}))
    assert {"left 2σ ellipses", "left landmarks"} <= set(legend(figure))
    figure.draw_without_rendering()
    plot_map(Map(False, {})).draw_without_rendering()


def test_a_scale_must_be_positive() -> None:
    with pytest.raises(SettingsError, match="band_scale"):
        plot_map(ring_map(), band_scale=0.0)
