"""Files appear whole or not at all, are what their suffix says, and are the same each time."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.figures.style import check_plot_file, save_figures, save_plot


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
