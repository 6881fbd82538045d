"""Films on disk, written frame by frame, so that the memory does not grow with their length."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, Protocol, cast

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from PIL.GifImagePlugin import getdata

from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.io.files import atomic_file, check_file_target

Pixels = NDArray[np.uint8]

SUFFIXES: Final = (".gif", ".mp4")
"""A film can be written under these suffixes."""

_COLORS: Final = 127
"""A .gif has this number of colours; one index more stands for what did not change."""
_UNCHANGED: Final = _COLORS
"""Pixels that did not change since the frame before have this index."""
_SHADES: Final = 9
"""Between two colours a .gif has about this number of shades, which the edges of lines need."""
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
def film(file: Path | str, frames_per_second: float, colors: Sequence[str]) -> Iterator[Film]:
    """Yields a film that is at `file` on success; an earlier one is kept as a numbered backup.

    A .gif has these `colors` on white, and what lies between them.
    """
    check_film_file(file)
    with atomic_file(file) as temporary:
        if Path(file).suffix.lower() == ".gif":
            with temporary.open("wb") as out:
                writer = GifFilm(out, colors)
                yield writer
                writer.finish()
        else:
            with _encoding(temporary, frames_per_second) as encoder:
                yield encoder


# --- gif -------------------------------------------------------------------------------------------------


class GifFilm:
    """Writes a .gif that is repeated for ever; of each frame it writes only what has changed."""

    def __init__(self, out: BinaryIO, colors: Sequence[str]) -> None:
        self._out = out
        self._palette = palette(colors)
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
        for block in getdata(image, corner, duration=duration, transparency=_UNCHANGED, disposal=_KEEP):
            self._out.write(block)
        self._shown, self._written = pixels, until

    def finish(self) -> None:
        """Writes the end of the file."""
        self._out.write(b";")

    def _difference(self, pixels: Pixels) -> tuple[tuple[int, int], Image.Image]:
        """Returns the corner (x, y) of the rectangle that has changed, and its picture in few colours."""
        if self._shown is None:
            height, width, _ = pixels.shape
            self._out.write(_gif_header(width, height, self._palette))
            return (0, 0), self._indexed(pixels, np.ones((height, width), bool))
        changed = (pixels != self._shown).any(axis=2)
        rows, columns = (_extent(changed.any(axis=axis)) for axis in (1, 0))
        return (columns.start, rows.start), self._indexed(pixels[rows, columns], changed[rows, columns])

    def _indexed(self, pixels: Pixels, changed: NDArray[np.bool_]) -> Image.Image:
        """Returns a picture by the nearest colours, in which unchanged pixels are transparent."""
        near = np.asarray(Image.fromarray(pixels).quantize(palette=self._palette, dither=Image.Dither.NONE))
        near = np.where(near < _COLORS, near, 0)  # the rest of the palette repeats its first colour
        return Image.fromarray(np.where(changed, near, _UNCHANGED).astype(np.uint8), mode="P")


def palette(colors: Sequence[str]) -> Image.Image:
    """Returns a picture with the palette of a .gif: white, the colours, and shades between any two.

    The shades towards white are exact, since pale areas are large. The others share what is left.
    """
    own = np.array([(1.0, 1.0, 1.0), *(to_rgb(color) for color in colors)])
    share = np.linspace(0.0, 1.0, _SHADES)[:, None, None, None]
    shades = np.round(255.0 * ((1.0 - share) * own + share * own[:, None])).astype(np.uint8)
    pale = np.unique(shades[:, 0].reshape(-1, 3), axis=0)[::-1].ravel().tolist()
    chart = Image.fromarray(np.unique(shades.reshape(-1, 3), axis=0)[None])
    left = _COLORS - len(pale) // 3
    few = chart.quantize(left, dither=Image.Dither.NONE).getpalette() or [] if left > 0 else []
    found = Image.new("P", (1, 1))
    # what is left of the palette repeats its first colour, which is white
    found.putpalette((pale + few + pale[:3] * 256)[: 3 * 256])
    return found


def pixels_of(figure: Figure) -> Pixels:
    """Returns a figure as pixels (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba(), np.uint8)[:, :, :3]


def _gif_header(width: int, height: int, palette: Image.Image) -> bytes:
    """Returns the beginning of a .gif, with its colours, that is repeated for ever."""
    size = width.to_bytes(2, "little") + height.to_bytes(2, "little")
    count = _COLORS + 1
    table = 0x80 | count.bit_length() - 2  # the flag of a table, and the power of two of its length, less one
    colors = bytes((palette.getpalette() or [])[: 3 * count])
    return b"GIF89a" + size + bytes([table, 0, 0]) + colors + b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def _extent(flags: NDArray[np.bool_]) -> slice:
    """Returns the stretch of the flags that are set; a picture has at least one pixel."""
    (found,) = np.nonzero(flags)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1)


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
