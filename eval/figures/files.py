"""Figures on disk: whole or not at all, and the same bytes for the same figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import matplotlib as mpl
from matplotlib.figure import Figure

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import atomic_file

FORMATS: Final = (".png", ".pdf", ".svg")
"""A figure can be saved under these suffixes."""
SUFFIXES: Final = (".png", ".pdf")
"""A command that writes several figures writes each in these formats, to look at and to print."""
DPI: Final = 200.0
"""A png has this resolution (dots per inch)."""

_METADATA: Final = {".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
"""Metadata that would differ from one run to the next is left out."""
_RC: Final = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pathspace"}
"""Text stays text in vector formats, and identifiers don't change from run to run."""


def check_plot_file(file: Path | str) -> None:
    """Raises SettingsError where a figure can't be saved under the suffix of `file`."""
    if Path(file).suffix.lower() not in FORMATS:
        raise SettingsError(f"{file}: expected a file name that ends in {', '.join(FORMATS)}")


def save_plot(figure: Figure, file: Path | str, dpi: float = DPI) -> None:
    """Writes a .png, .pdf or .svg, whole or not at all. Raises SettingsError for any other suffix."""
    check_plot_file(file)
    with atomic_file(Path(file)) as temporary:
        render(figure, temporary, Path(file).suffix.lower(), dpi)


def save_figures(folder: Path, figures: Mapping[str, Figure]) -> None:
    """Writes every figure under its name in `folder`, as a picture to look at and as vectors to print."""
    for name, figure in figures.items():
        for suffix in SUFFIXES:
            save_plot(figure, folder / f"{name}{suffix}")


def render(figure: Figure, file: Path, suffix: str, dpi: float = DPI) -> None:
    """Writes a figure to `file`, whatever that is called, in the format of `suffix`."""
    with mpl.rc_context(_RC):
        figure.savefig(file, dpi=dpi, format=suffix[1:], metadata=_METADATA[suffix])
