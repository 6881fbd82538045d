"""Films: every frame comes back from the file, and a film that fails leaves nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from matplotlib.figure import Figure
from PIL import Image, ImageSequence

from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.eval.view.animation import Pixels, check_film_file, film, pixels_of

FFMPEG = """#!{python}
import sys
from pathlib import Path
frames = sys.stdin.buffer.read()
Path(sys.argv[-1]).write_bytes(frames)
sys.exit({code})
"""
"""This stands for ffmpeg: it writes the pixels as they come."""


def blank(colour: str = "white") -> Figure:
    return Figure(figsize=(1.2, 0.8), dpi=100.0, facecolor=colour)


def with_line(x: float) -> Figure:
    figure = blank()
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, 1.0)
    axes.axvline(x, color="#0067A9", linewidth=2.0)
    return figure


def frames(file: Path) -> tuple[list[Pixels], list[float]]:
    """The pictures of a .gif, and the time (s) that each is shown."""
    with Image.open(file) as gif:
        shown = [
            (np.asarray(one.convert("RGB")), one.info["duration"]) for one in ImageSequence.Iterator(gif)
        ]
    return [pixels for pixels, _ in shown], [duration / 1e3 for _, duration in shown]


def test_every_frame_of_a_gif_comes_back(tmp_path: Path) -> None:
    figures = [blank(), with_line(0.2), with_line(0.8), blank("#CC0000")]
    with film(tmp_path / "a.gif", 12.0) as reel:
        for figure in figures:
            reel(figure, 0.1)
    pictures, durations = frames(tmp_path / "a.gif")
    assert len(pictures) == len(figures)
    for picture, figure in zip(pictures, figures, strict=True):
        difference = picture.astype(int) - pixels_of(figure)
        assert np.abs(difference).max() <= 16  # of few colours
    assert durations == pytest.approx([0.1] * len(figures))


def test_the_times_of_frames_do_not_add_up_rounding(tmp_path: Path) -> None:
    with film(tmp_path / "a.gif", 30.0) as reel:
        for x in np.linspace(0.1, 0.9, 30):
            reel(with_line(x), 1.0 / 30.0)
    _, durations = frames(tmp_path / "a.gif")
    assert set(durations) == {0.03, 0.04}
    assert sum(durations) == pytest.approx(1.0)


def test_only_what_has_changed_is_written(tmp_path: Path) -> None:
    for count in (1, 11):
        with film(tmp_path / f"{count}.gif", 10.0) as reel:
            for k in range(count):
                reel(with_line(0.5 if k % 2 else 0.6), 0.1)
    one, eleven = ((tmp_path / f"{count}.gif").stat().st_size for count in (1, 11))
    assert eleven < 11 * one


def test_a_film_without_a_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="at least one frame"), film(tmp_path / "a.gif", 10.0):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_fails_leaves_nothing_and_an_earlier_one_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "a.gif"
    with pytest.raises(ZeroDivisionError), film(file, 10.0) as reel:
        reel(blank(), 0.1)
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    for _ in range(2):
        with film(file, 10.0) as reel:
            reel(blank(), 0.1)
    assert {path.name for path in tmp_path.iterdir()} == {"a.gif", "a.gif.~1~"}


def test_a_wrong_name_and_a_missing_program_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match=r"a\.avi: expected a film's name that ends in \.gif or \.mp4"):
        check_film_file(tmp_path / "a.avi")
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda _: False))
    with pytest.raises(SettingsError, match=r"a\.mp4: expected the program ffmpeg for \.mp4, found none"):
        check_film_file(tmp_path / "a.mp4")


@pytest.mark.skipif(sys.platform == "win32", reason="a script is no program there")
def test_ffmpeg_is_given_every_frame_as_often_as_it_is_shown(tmp_path: Path) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(FFMPEG.format(python=sys.executable, code=0))
    program.chmod(0o700)
    with (
        mpl.rc_context({"animation.ffmpeg_path": str(program)}),
        film(tmp_path / "a.mp4", 10.0) as reel,
    ):
        reel(blank(), 0.1)
        reel(with_line(0.5), 0.3)
    pixels = np.frombuffer((tmp_path / "a.mp4").read_bytes(), np.uint8).reshape(4, 80, 120, 4)
    assert (pixels[0] == 255).all()
    np.testing.assert_array_equal(pixels[3, :, :, :3], pixels_of(with_line(0.5)))


@pytest.mark.skipif(sys.platform == "win32", reason="a script is no program there")
def test_ffmpeg_that_fails_is_an_output_error(tmp_path: Path) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(FFMPEG.format(python=sys.executable, code=1))
    program.chmod(0o700)
    written = film(tmp_path / "a.mp4", 10.0)
    with (
        mpl.rc_context({"animation.ffmpeg_path": str(program)}),
        pytest.raises(OutputError, match="ffmpeg could not write the film"),
        written as reel,
    ):
        reel(blank(), 0.1)
    assert {path.name for path in tmp_path.iterdir()} == {"ffmpeg"}
