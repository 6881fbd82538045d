"""The picture of a map: that the band is as wide as it says, and that files appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.files import check_plot_file, save_plot
from pathspace_graph.eval.figures.map_plot import plot_map
from pathspace_graph.eval.figures.marks import curve_parameters, uncertainty_band
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

SIGMA = 0.2
"""m, of the whole boundary moving as one."""


def boundary(radius: float) -> SplineBoundary:
    """A ring around (0, 20) that may be shifted as a whole by SIGMA in x and y alike."""
    angle = 2 * np.pi * np.arange(16) / 16
    points = radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1) + [0.0, 20.0]
    together = np.tile(np.eye(2), (16, 1))
    return SplineBoundary(BSpline.periodic_from(np.arange(17.0), points), SIGMA**2 * together @ together.T)


def ring_map() -> Map:
    return Map(True, {LEFT: boundary(18.0), RIGHT: boundary(22.0)})


def ring_log() -> Log:
    t = np.linspace(0.0, 2 * np.pi, 50)
    poses = np.stack([20.0 * np.sin(t), 20.0 * (1 - np.cos(t)), t], axis=1)
    truth = Truth(t, poses, np.array([[0.0, 2.0], [0.0, -2.0]]), np.array([LEFT, RIGHT]))
    return Log(Odometry(t, np.zeros((50, 3))), (), np.ones(3), truth=truth)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_the_band_is_two_sigma_to_either_side_along_the_normal(scale: float) -> None:
    ring = boundary(18.0)
    u = curve_parameters(ring.spline, 7)
    left, right = uncertainty_band(ring, u, scale)
    centre = ring.spline.evaluate(u)
    np.testing.assert_allclose(np.linalg.norm(left - centre, axis=1), 2 * SIGMA * scale, rtol=1e-9)
    np.testing.assert_allclose(left + right, 2 * centre, atol=1e-12)
    # left of the direction of travel is inside of an anticlockwise ring
    middle = np.array([0.0, 20.0])
    assert (np.linalg.norm(left - middle, axis=1) < np.linalg.norm(right - middle, axis=1)).all()


def test_the_band_that_is_drawn_reaches_as_far() -> None:
    figure = plot_map(Map(True, {RIGHT: boundary(22.0)}))
    (band,) = [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]
    u = curve_parameters(boundary(22.0).spline, 24)
    curve = boundary(22.0).spline.evaluate(u)
    extents = band.get_path().get_extents()
    assert extents.x1 == pytest.approx(curve[:, 0].max() + 2 * SIGMA, abs=1e-3)
    assert extents.y0 == pytest.approx(curve[:, 1].min() - 2 * SIGMA, abs=1e-3)
    # a ring, not a disc: the inner edge runs the other way, so the areas subtract
    area = sum(_signed_area(polygon) for polygon in band.get_path().to_polygons())
    assert abs(area) == pytest.approx(4 * SIGMA * boundary(22.0).spline.length(), rel=1e-3)


def _signed_area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def test_every_span_is_sampled_from_end_to_end() -> None:
    spline = BSpline.clamped_from(np.array([0.0, 1.0, 1.5, 9.0]), np.zeros((6, 2)))
    u = curve_parameters(spline, 4)
    assert (u[0], u[-1], len(u)) == (0.0, 9.0, 13)
    assert set(spline.breaks) <= set(u)


def test_the_legend_names_what_is_there_and_an_exaggerated_band() -> None:
    full = legend(plot_map(ring_map(), log=ring_log(), trajectory=np.zeros((4, 3))))
    assert {"left boundary", "right boundary", "true cones", "true path", "trajectory"} <= set(full)
    assert "left 2σ band" in full
    bare = legend(plot_map(ring_map(), band_scale=4.0))
    assert any("drawn 4× as wide" in text for text in bare)
    assert not {"true cones", "true path", "trajectory"} & set(bare)


def test_equal_aspect_and_everything_in_sight() -> None:
    figure = plot_map(ring_map(), log=ring_log(), title="ring")
    axes = figure.axes[0]
    assert axes.get_aspect() == 1.0
    assert axes.get_title("left") == "ring"
    assert axes.get_xlim()[0] < -22.4 and axes.get_xlim()[1] > 22.4
    assert axes.get_ylim()[0] < -2.4 and axes.get_ylim()[1] > 42.4


def test_maps_of_points_and_empty_maps_are_drawn(tmp_path: Path) -> None:
    points = PointBoundary(np.array([[0.0, 1.0], [5.0, 1.0]]), np.diag([0.04, 0.01, 0.04, 0.01]))
    figure = plot_map(Map(False, {LEFT: points, RIGHT: PointBoundary(np.zeros((0, 2)), np.zeros((0, 0)))}))
    (ellipses,) = [c for c in figure.axes[0].collections if len(c.get_offsets()) == 2]
    widths = sorted([2 * ellipses._widths[0], 2 * ellipses._heights[0]])
    np.testing.assert_allclose(widths, [4 * 0.1, 4 * 0.2])
    save_plot(figure, tmp_path / "points.png")
    save_plot(plot_map(Map(False, {})), tmp_path / "empty.png")


@pytest.mark.parametrize(("suffix", "magic"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".SVG", b"<?xml")])
def test_files_are_what_their_suffix_says_and_the_same_each_time(
    tmp_path: Path, suffix: str, magic: bytes
) -> None:
    files = [tmp_path / f"{name}{suffix}" for name in "ab"]
    for file in files:
        save_plot(plot_map(ring_map(), log=ring_log(), trajectory=np.zeros((4, 3))), file)
    first, second = (file.read_bytes() for file in files)
    assert first.startswith(magic)
    assert first == second
    assert sorted(tmp_path.iterdir()) == files


def test_an_unknown_suffix_is_refused_and_a_scale_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"\.png, \.pdf, \.svg"):
        save_plot(plot_map(ring_map()), tmp_path / "map.docx")
    with pytest.raises(SettingsError):
        check_plot_file("map")
    with pytest.raises(SettingsError, match="band_scale"):
        plot_map(ring_map(), band_scale=0.0)
    assert list(tmp_path.iterdir()) == []
