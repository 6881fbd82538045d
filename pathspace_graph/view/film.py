"""Films on disk, written frame by frame, so that the memory does not grow with their length."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, Protocol, cast

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from PIL.GifImagePlugin import getdata

from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.io.files import atomic_file, check_file_target

Pixels = NDArray[np.uint8]

SUFFIXES: Final = (".gif", ".mp4")
"""A film can be written under these suffixes."""

_COLORS: Final = 63
"""Each frame of a .gif has at most this number of colours; one index more stands for what did not change."""
_UNCHANGED: Final = _COLORS
"""Pixels that did not change since the frame before have this index."""
_KEEP: Final = 1
"""A frame of a .gif stays under the next one; this is the disposal method of the format."""
_CENTISECONDS: Final = 100
"""A .gif counts time in this number of units per second."""


class Film(Protocol):
    """Takes the frames of a film, one after the other."""

    def add(self, figure: Figure, seconds: float) -> None:
        """Adds a figure as a frame that is shown for a time (s)."""


def check_film_file(file: Path | str) -> None:
    """Raises where no film can be written to `file`, before anything is drawn."""
    suffix = Path(file).suffix.lower()
    if suffix not in SUFFIXES:
        raise SettingsError(f"{file}: expected a film's name that ends in {' or '.join(SUFFIXES)}")
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise SettingsError(
            f"{file}: expected the program ffmpeg for .mp4, found none; a .gif needs no program"
        )
    check_file_target(file)


@contextmanager
def film(file: Path | str, frames_per_second: float) -> Iterator[Film]:
    """Yields a film that is at `file` on success; an earlier one is kept as a numbered backup."""
    check_film_file(file)
    with atomic_file(file) as temporary:
        if Path(file).suffix.lower() == ".gif":
            with temporary.open("wb") as out:
                writer = GifFilm(out)
                yield writer
                writer.finish()
        else:
            with _encoding(temporary, frames_per_second) as encoder:
                yield encoder


# --- gif -------------------------------------------------------------------------------------------------


class GifFilm:
    """Writes a .gif that is repeated for ever; of each frame it writes only what has changed."""

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._shown: Pixels | None = None
        self._time = 0.0
        self._written = 0

    def add(self, figure: Figure, seconds: float) -> None:
        """Adds a figure, of the same size as those before, as a frame that is shown for a time (s)."""
        pixels = pixels_of(figure)
        self._time += seconds
        until = round(_CENTISECONDS * self._time)
        corner, image = self._difference(pixels)
        # Pillow takes milliseconds, and counts in whole hundredths of a second as the format does
        duration = 1000 // _CENTISECONDS * (until - self._written)
        options = {"transparency": _UNCHANGED, "disposal": _KEEP, "include_color_table": True}
        for block in getdata(image, corner, duration=duration, **options):
            self._out.write(block)
        self._shown, self._written = pixels, until

    def finish(self) -> None:
        """Writes the end of the file."""
        self._out.write(b";")

    def _difference(self, pixels: Pixels) -> tuple[tuple[int, int], Image.Image]:
        """Returns the corner (x, y) of the rectangle that has changed, and its picture in few colours."""
        if self._shown is None:
            height, width, _ = pixels.shape
            self._out.write(_gif_header(width, height))
            return (0, 0), _in_few_colors(pixels, np.ones((height, width), bool))
        changed = (pixels != self._shown).any(axis=2)
        rows, columns = (_extent(changed.any(axis=axis)) for axis in (1, 0))
        return (columns.start, rows.start), _in_few_colors(pixels[rows, columns], changed[rows, columns])


def pixels_of(figure: Figure) -> Pixels:
    """Returns a figure as pixels (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba(), np.uint8)[:, :, :3]


def _gif_header(width: int, height: int) -> bytes:
    """Returns the beginning of a .gif without colours of its own, which is repeated for ever."""
    size = width.to_bytes(2, "little") + height.to_bytes(2, "little")
    return b"GIF89a" + size + b"\x00\x00\x00" + b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _extent(flags: NDArray[np.bool_]) -> slice:
    """Returns the stretch of the flags that are set; a picture has at least one pixel."""
    (found,) = np.nonzero(flags)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1)


def _in_few_colors(pixels: Pixels, changed: NDArray[np.bool_]) -> Image.Image:
    """Returns a picture with a palette, in which unchanged pixels are transparent."""
    image = Image.fromarray(pixels).quantize(_COLORS, dither=Image.Dither.NONE)
    palette = image.getpalette() or []
    index = np.where(changed, np.asarray(image), _UNCHANGED).astype(np.uint8)
    few = Image.fromarray(index, mode="P")
    few.putpalette(palette[: 3 * _COLORS] + [0] * (3 * (_COLORS + 1) - len(palette[: 3 * _COLORS])))
    return few


# --- mp4 -------------------------------------------------------------------------------------------------


@contextmanager
def _encoding(file: Path, frames_per_second: float) -> Iterator[Film]:
    """Yields a film that ffmpeg writes to `file`; an OutputError where it fails."""
    encoder = _FfmpegFilm(file, frames_per_second)
    try:
        yield encoder
        encoder.writer.finish()
    except (subprocess.CalledProcessError, BrokenPipeError) as error:
        raise OutputError(f"{file.name}: ffmpeg could not write the film: {error}") from error


class _FfmpegFilm:
    """Hands frames to ffmpeg by matplotlib's writer."""

    def __init__(self, file: Path, frames_per_second: float) -> None:
        self.writer = FFMpegWriter(fps=cast(int, frames_per_second))  # ffmpeg takes any number
        self._file, self._begun = file, False

    def add(self, figure: Figure, seconds: float) -> None:
        """Adds a figure as often as it is to be shown, at least once."""
        if not self._begun:
            self.writer.setup(figure, str(self._file), figure.dpi)
            self._begun = True
        self.writer.fig = figure
        for _ in range(max(1, round(seconds * self.writer.fps))):
            self.writer.grab_frame()
