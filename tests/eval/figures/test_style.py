"""How figures look: legends, bands, ellipses and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.style import (
    check_plot_file,
    curve_parameters,
    draw_band,
    ellipse_outlines,
    figure_context,
    save_figures,
    save_plot,
    shared_legend,
    uncertainty_band,
)
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.spline.bspline import BSpline

from ...scenes.rings import SHIFT, shifted_ring


def two_panels(first: list[str], second: list[str]) -> Figure:
    """Two panels with a line for each label."""
    figure = Figure((7.0, 6.0), layout="compressed")
    for axes, labels in zip(figure.subplots(1, 2), (first, second), strict=True):
        for label in labels:
            axes.plot([0.0, 1.0], [0.0, 1.0], label=label)
    return figure


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_shared_legend_names_each_thing_once_a_boundary_after_the_other() -> None:
    figure = two_panels(["start", "right band", "left band"], ["left band", "left boundary"])
    shared_legend(figure)
    assert texts(figure) == ["left band", "left boundary", "right band", "start"]


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


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_the_band_is_two_sigma_to_either_side_along_the_normal(scale: float) -> None:
    ring = shifted_ring(18.0)
    u = curve_parameters(ring.spline, 7)
    left, right = uncertainty_band(ring, u, scale)
    centre = ring.spline.evaluate(u)
    np.testing.assert_allclose(np.linalg.norm(left - centre, axis=1), 2 * SHIFT * scale, rtol=1e-9)
    np.testing.assert_allclose(left + right, 2 * centre, atol=1e-12)
    wide = uncertainty_band(SplineBoundary(ring.spline, 1e4 * ring.covariance), u, scale)[0]
    np.testing.assert_allclose(np.linalg.norm(wide - centre, axis=1), 3.0 * scale, rtol=1e-9)  # it is cut
    # left of the direction of travel is inside of an anticlockwise ring
    middle = np.array([0.0, 20.0])
    assert (np.linalg.norm(left - middle, axis=1) < np.linalg.norm(right - middle, axis=1)).all()


def drawn_band(boundary: SplineBoundary) -> PathPatch:
    axes = Figure().subplots()
    draw_band(axes, boundary, "black", "band")
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
    band, curve = drawn_band(ring), ring.spline.evaluate(curve_parameters(ring.spline))
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
    u = curve_parameters(spline, 4)
    assert (u[0], u[-1], len(u)) == (0.0, 9.0, 13)
    assert set(spline.breaks) <= set(u)


def test_an_outline_of_an_ellipse_is_two_sigma_away_in_every_direction() -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    joint = np.block([[np.eye(2), 0.1 * np.eye(2)], [0.1 * np.eye(2), covariance]])
    first, second = ellipse_outlines(points, joint)
    assert first.shape == (33, 2)
    np.testing.assert_allclose(np.linalg.norm(first - points[0], axis=1), 2.0, rtol=1e-12)
    offset = second - points[1]
    squares = np.einsum("ci,ij,cj->c", offset, np.linalg.inv(covariance), offset)
    np.testing.assert_allclose(squares, 4.0, rtol=1e-12)
    np.testing.assert_allclose(second[0], second[-1], atol=1e-12)
    wider, _ = ellipse_outlines(points, joint, 3.0)
    np.testing.assert_allclose(wider - points[0], 3.0 * (first - points[0]), atol=1e-12)


def line(height: float = 1.0) -> Figure:
    figure = Figure((1.0, height))
    figure.subplots().plot([0.0, 1.0], [0.0, 1.0], label="any")
    return figure


@pytest.mark.parametrize(("suffix", "magic"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".SVG", b"<?xml")])
def test_files_are_what_their_suffix_says_and_the_same_each_time(
    tmp_path: Path, suffix: str, magic: bytes
) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for file in files:
        save_plot(line(), file)
    first, second = (file.read_bytes() for file in files)
    assert first.startswith(magic)
    assert first == second
    assert sorted(tmp_path.iterdir()) == files


def test_several_figures_are_pictures_and_vectors(tmp_path: Path) -> None:
    save_figures(tmp_path, {"low": line(), "high": line(2.0)})
    assert {file.name for file in tmp_path.iterdir()} == {"low.png", "low.pdf", "high.png", "high.pdf"}


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"\.png, \.pdf, \.svg"):
        save_plot(line(), tmp_path / "map.docx")
    with pytest.raises(SettingsError):
        check_plot_file("map")
    assert list(tmp_path.iterdir()) == []
