"""Films on disk: .gif by Pillow, and .mp4 by ffmpeg."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol, cast

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.io.files import atomic_file, check_file_target

Pixels = NDArray[np.uint8]

SUFFIXES: Final = (".gif", ".mp4")
_COLORS: Final = 255
"""Number of colours of a frame of a .gif; one index of its palette is left for what does not change."""


class Film(Protocol):
    """Film that takes its frames one after the other."""

    def add(self, figure: Figure, seconds: float) -> None:
        """Add a figure as a frame that is shown for a time (s)."""


def check_film_file(file: Path | str) -> None:
    """Raise where no film can be written to `file`, before anything is drawn."""
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
    """Yield a film that is at `file` on success; an earlier one is kept as a numbered backup."""
    check_film_file(file)
    with atomic_file(file) as temporary:
        if Path(file).suffix.lower() == ".gif":
            frames = GifFilm()
            yield frames
            frames.write(temporary)
            return
        encoder = _FfmpegFilm(temporary, frames_per_second)
        try:
            yield encoder
            encoder.writer.finish()
        except (subprocess.CalledProcessError, BrokenPipeError) as error:
            raise OutputError(f"{temporary.name}: ffmpeg could not write the film: {error}") from error


class GifFilm:
    """Collects the frames of a .gif, each in colours of its own, for Pillow's writer."""

    def __init__(self) -> None:
        self._frames: list[Image.Image] = []
        self._durations: list[int] = []
        self._time = 0.0

    def add(self, figure: Figure, seconds: float) -> None:
        """Add a figure, of the same size as those before, as a frame that is shown for a time (s).

        The format counts in hundredths of a second, whose rounding must not add up.
        """
        picture = Image.fromarray(pixels_of(figure))
        self._frames.append(picture.quantize(_COLORS, dither=Image.Dither.NONE))
        before, self._time = self._time, self._time + seconds
        self._durations.append(10 * (round(100.0 * self._time) - round(100.0 * before)))

    def write(self, file: Path) -> None:
        """Write a film that is repeated for ever."""
        if not self._frames:
            raise OutputError(f"{file.name}: expected a film of at least one frame, found none")
        first, *others = self._frames
        first.save(file, format="GIF", save_all=True, append_images=others, duration=self._durations, loop=0)


def pixels_of(figure: Figure) -> Pixels:
    """Return a figure as pixels (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba(), np.uint8)[:, :, :3]


class _FfmpegFilm:
    """Hands frames to ffmpeg by matplotlib's writer."""

    def __init__(self, file: Path, frames_per_second: float) -> None:
        self.writer = FFMpegWriter(fps=cast(int, frames_per_second))  # ffmpeg takes any number
        self._file, self._begun = file, False

    def add(self, figure: Figure, seconds: float) -> None:
        if not self._begun:
            self.writer.setup(figure, str(self._file), figure.dpi)
            self._begun = True
        self.writer.fig = figure
        for _ in range(max(1, round(seconds * self.writer.fps))):
            self.writer.grab_frame()
