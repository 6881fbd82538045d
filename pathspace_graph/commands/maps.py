"""`compare` of two maps: align one with the other; print, write and draw their distances."""

from pathlib import Path
from typing import Final

import numpy as np
from rich.table import Table
from rich.text import Text

from pathspace_graph.console import output, say
from pathspace_graph.eval.figures.map_plot import plot_apart
from pathspace_graph.eval.figures.style import save_plot
from pathspace_graph.eval.metrics.alignment import maps_apart
from pathspace_graph.io.files import atomic_folder, check_target, write_json
from pathspace_graph.io.map import read_map

from .outcome import Outcome

APART_FILE: Final = "apart.json"  # by which the folder is recognized
PICTURE: Final = "apart.png"
STATISTICS: Final = ("mean", "rms", "p95", "max")


def compare_maps(first: Path, second: Path, out: Path, *, force: bool) -> Outcome:
    """Align the first map with the second, print and write their distances, and draw both."""
    check_target(out, APART_FILE, force=force)
    tracks = read_map(first), read_map(second)
    apart = maps_apart(*tracks)
    content = {"maps": [str(first), str(second)], **apart.to_json()}
    with atomic_folder(out, APART_FILE, force=force) as folder:
        write_json(folder / APART_FILE, content)
        save_plot(plot_apart(*tracks, apart), folder / PICTURE)
    table = Table()
    table.add_column("boundary")
    for name in STATISTICS:
        table.add_column(Text(f"{name} [m]"), justify="right")  # a plain text would be markup
    for name, own in apart.statistics().items():
        table.add_row(name, *(f"{own[key]:.3f}" for key in STATISTICS))
    output().print(table)
    x, y, turn = apart.motion.tolist()
    where = f"({x:.3f}, {y:.3f}) m, turned by {np.rad2deg(turn):.3f}°"
    say(f"the frame of {first} is at {where} in that of {second}")
    return Outcome([out], content)
