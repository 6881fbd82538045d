"""Pictures: legends, bands, ellipses and files; of a map everything is in sight, and the legend names it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures import drawing
from pathspace_graph.eval.figures.drawing import plot_map, save_plot
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from ...scenes.rings import SHIFT, shifted_ring


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_shared_legend_names_each_thing_once_a_boundary_after_the_other() -> None:
    figure = Figure((7.0, 6.0), layout="compressed")
    panels = ["start", "right band", "left band"], ["left band", "left boundary"]
    for axes, labels in zip(figure.subplots(1, 2), panels, strict=True):
        for label in labels:
            axes.plot([0.0, 1.0], [0.0, 1.0], label=label)
    drawing.shared_legend(figure)
    assert legend(figure) == ["left band", "left boundary", "right band", "start"]


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_the_band_is_two_sigma_to_either_side_along_the_normal(scale: float) -> None:
    ring = shifted_ring(18.0)
    u = drawing.curve_parameters(ring.spline, 7)
    left, right = drawing.uncertainty_band(ring, u, scale)
    centre = ring.spline.evaluate(u)
    np.testing.assert_allclose(np.linalg.norm(left - centre, axis=1), 2 * SHIFT * scale, rtol=1e-9)
    np.testing.assert_allclose(left + right, 2 * centre, atol=1e-12)
    wide = drawing.uncertainty_band(SplineBoundary(ring.spline, 1e4 * ring.covariance), u, scale)[0]
    np.testing.assert_allclose(np.linalg.norm(wide - centre, axis=1), 3.0 * scale, rtol=1e-9)  # it is cut
    # left of the direction of travel is inside of an anticlockwise ring
    middle = np.array([0.0, 20.0])
    assert (np.linalg.norm(left - middle, axis=1) < np.linalg.norm(right - middle, axis=1)).all()


def drawn_band(boundary: SplineBoundary) -> PathPatch:
    axes = Figure().subplots()
    drawing.draw_boundary(axes, boundary, LEFT)
    (band,) = axes.patches
    assert isinstance(band, PathPatch)
    return band


def area(band: PathPatch) -> float:
    """The area of its polygons, those that run clockwise taken as negative."""
    return sum(
        0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        for x, y in (np.asarray(polygon).T for polygon in band.get_path().to_polygons())
    )


def test_the_band_of_a_closed_curve_is_a_ring_and_reaches_as_far() -> None:
    ring = shifted_ring(22.0)
    band, curve = drawn_band(ring), ring.spline.evaluate(drawing.curve_parameters(ring.spline))
    extents = band.get_path().get_extents()
    assert extents.x1 == pytest.approx(curve[:, 0].max() + 2 * SHIFT, abs=1e-3)
    assert extents.y0 == pytest.approx(curve[:, 1].min() - 2 * SHIFT, abs=1e-3)
    # the inner edge runs the other way, so the areas subtract
    assert abs(area(band)) == pytest.approx(4 * SHIFT * ring.spline.length(), rel=1e-3)


def test_the_band_of_an_open_curve_is_one_polygon() -> None:
    """A straight of 6 m whose control points have 0.1 m each, all of them moving as one: 6 m by 0.4 m."""
    points = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [6.0, 0.0]])
    straight = BSpline.clamped_from(np.array([0.0, 6.0]), points)
    together = np.tile(np.eye(2), (4, 1))
    band = drawn_band(SplineBoundary(straight, 0.01 * together @ together.T))
    assert len(band.get_path().to_polygons()) == 1
    assert abs(area(band)) == pytest.approx(6.0 * 0.4)


def test_every_span_is_sampled_from_end_to_end() -> None:
    spline = BSpline.clamped_from(np.array([0.0, 1.0, 1.5, 9.0]), np.zeros((6, 2)))
    u = drawing.curve_parameters(spline, 4)
    assert (u[0], u[-1], len(u)) == (0.0, 9.0, 13)
    assert set(spline.breaks) <= set(u)


def test_both_parts_of_a_curve_meet_where_it_is_confirmed_to() -> None:
    x = np.linspace(0.0, 9.0, 12)
    spline = BSpline.clamped_from(np.linspace(0.0, 9.0, 10), np.column_stack([x, 0.0 * x]))
    boundary = SplineBoundary(spline, np.zeros((0, 0)), 4.05)
    confirmed, tentative = drawing.curve_parts(boundary, 2)
    np.testing.assert_array_equal(confirmed[-1], spline.evaluate(np.array([4.05]))[0])
    np.testing.assert_array_equal(confirmed[-1], tentative[0])
    assert (np.diff(np.concatenate([confirmed, tentative[1:]])[:, 0]) > 0.0).all()
    whole, nothing = drawing.curve_parts(SplineBoundary(spline, np.zeros((0, 0))), 2)
    assert len(whole) == len(confirmed) + len(tentative) - 2 and len(nothing) == 0


def test_an_outline_of_an_ellipse_is_two_sigma_away_in_every_direction() -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    joint = np.block([[np.eye(2), 0.1 * np.eye(2)], [0.1 * np.eye(2), covariance]])
    first, second = drawing.ellipse_outlines(points, joint)
    assert first.shape == (33, 2)
    np.testing.assert_allclose(np.linalg.norm(first - points[0], axis=1), 2.0, rtol=1e-12)
    offset = second - points[1]
    squares = np.einsum("ci,ij,cj->c", offset, np.linalg.inv(covariance), offset)
    np.testing.assert_allclose(squares, 4.0, rtol=1e-12)
    np.testing.assert_allclose(second[0], second[-1], atol=1e-12)
    wider, _ = drawing.ellipse_outlines(points, joint, 3.0)
    np.testing.assert_allclose(wider - points[0], 3.0 * (first - points[0]), atol=1e-12)


# --- files -----------------------------------------------------------------------------------------------


def line() -> Figure:
    figure = Figure((1.0, 1.0))
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0], label="any")
    return figure


@pytest.mark.parametrize(("suffix", "magic"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".SVG", b"<?xml")])
def test_files_are_what_their_suffix_says_and_the_same_each_time(
    tmp_path: Path, suffix: str, magic: bytes
) -> None:
    for name in "ab":
        save_plot(line(), tmp_path / f"{name}{suffix}")
    first, second = (file.read_bytes() for file in sorted(tmp_path.iterdir()))
    assert first.startswith(magic) and first == second


def test_a_stream_is_a_png_several_figures_are_vectors_too_and_any_other_suffix_is_refused(
    tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    save_plot(line(), "-")
    assert (
        capfdbinary.readouterr().out.startswith(b"\x89PNG") and drawing.check_plot_file("/dev/null") == ".png"
    )
    for name in ("map.docx", "map"):
        with pytest.raises(SettingsError, match=r"ends in \.png, \.pdf, \.svg"):
            save_plot(line(), tmp_path / name)
    drawing.save_figures(tmp_path, {"low": line(), "high": line()})
    assert {file.name for file in tmp_path.iterdir()} == {"low.png", "low.pdf", "high.png", "high.pdf"}


# --- maps ------------------------------------------------------------------------------------------------


def ring_map() -> Map:
    return Map(True, {LEFT: shifted_ring(18.0), RIGHT: shifted_ring(22.0)})


def ring_log() -> Log:
    t = np.linspace(0.0, 2 * np.pi, 50)
    poses = np.stack([20.0 * np.sin(t), 20.0 * (1 - np.cos(t)), t], axis=1)
    truth = Truth(t, poses, np.array([[0.0, 2.0], [0.0, -2.0]]), np.array([LEFT, RIGHT]))
    return Log(Odometry(t, np.zeros((50, 3))), (), np.ones(3), truth=truth)


def lines(figure: Figure) -> dict[str, Any]:
    return {line.get_label(): line for line in figure.axes[0].get_lines()}


def test_a_boundary_and_its_band_have_the_colour_of_its_cones() -> None:
    figure = plot_map(ring_map())
    for side, color in (("left", drawing.BLUE), ("right", drawing.ORANGE)):
        (band,) = (one for one in figure.axes[0].patches if str(one.get_label()).startswith(side))
        assert to_hex(band.get_facecolor()).upper() == lines(figure)[f"{side} boundary"].get_color() == color


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
    drawn_as = lines(figure)
    drawn = drawn_as["lost"].get_xydata()
    np.testing.assert_array_equal(drawn[1:3], trajectory[1:3, :2])
    assert np.isnan(drawn[[0, 3]]).all() and "degraded" not in drawn_as
    assert "lost" not in legend(plot_map(ring_map(), trajectory=trajectory, health=[]))


def test_a_smoothed_trajectory_is_drawn_over_the_poses_of_their_time() -> None:
    trajectory, smoothed = np.arange(12.0).reshape(4, 3), np.ones((4, 3))
    figure = plot_map(ring_map(), trajectory=trajectory, smoothed=smoothed, health=["lost"] * 4)
    drawn_as = lines(figure)
    thin, drawn = drawn_as["poses as estimated at their time"], drawn_as["trajectory"]
    np.testing.assert_array_equal(thin.get_xydata(), trajectory[:, :2])
    np.testing.assert_array_equal(drawn.get_xydata(), smoothed[:, :2])
    np.testing.assert_array_equal(drawn_as["lost"].get_xydata(), smoothed[:, :2])
    assert thin.get_linewidth() < drawn.get_linewidth()


def test_a_tentative_stretch_is_dashed() -> None:
    ring = shifted_ring(18.0)
    ring = replace(ring, confirmed_until=0.5 * sum(ring.spline.domain))
    figure = plot_map(Map(False, {LEFT: ring, RIGHT: shifted_ring(22.0)}))
    assert "left tentative" in legend(figure)
    assert "right tentative" not in legend(figure)
    drawn_as = lines(figure)
    confirmed, tentative = drawn_as["left boundary"], drawn_as["left tentative"]
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
