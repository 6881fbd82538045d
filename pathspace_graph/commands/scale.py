"""`scale`: the time of an update against the size of the map, its readings and the laps."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from rich.console import Console
from tyro.conf import arg

from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import ONLINE, check_online
from pathspace_graph.eval.scaling.output import MARKER, scaling_table, stops, write_scaling
from pathspace_graph.eval.scaling.roads import make_drives
from pathspace_graph.eval.scaling.scaling import measure_scaling
from pathspace_graph.eval.scaling.settings import QUICK, ScalingSettings
from pathspace_graph.io.files import check_target
from pathspace_graph.progress import progress
from pathspace_graph.settings.mapper import MapperSettings

FILE_WIDTH: Final = 160
"""Characters in a line of a table that doesn't go to a terminal."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Time every online estimator on ever larger maps and ever more readings; fit and draw the slopes.

    All run in this one process, cycle for cycle in turn, so that whatever else the machine does slows all
    alike. An estimator that takes longer than the budget is stopped there, and the table says so. Memory is
    what tracemalloc sees, Python and numpy, while the first lap of the closed road is mapped.
    """

    out: Path
    """Folder for points, slopes and figures; an earlier one there is kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the online estimators; all where none is named."""
    quick: bool = False
    """Less than a minute, to see that everything works: small maps, few laps. Takes no other `scaling`."""
    scaling: ScalingSettings = field(default_factory=ScalingSettings)
    """What is measured."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Of every estimator."""

    def run(self) -> None:
        """Check everything, simulate, time, write, and say what came out."""
        names = tuple(dict.fromkeys(self.estimators or ONLINE))
        for name in names:
            check_online(name)
        if self.quick and self.scaling != ScalingSettings():
            raise SettingsError("--quick: expected no other --scaling options with it, found some")
        check_target(self.out, MARKER)
        measured = QUICK if self.quick else self.scaling
        with progress("simulating"):
            drives = make_drives(measured)
        with progress("timing", drives.cycles) as advance:
            scaling = measure_scaling(names, drives, measured, self.settings, advance)
        write_scaling(self.out, scaling)
        console = Console()
        if not console.is_terminal:
            console = Console(width=FILE_WIDTH)
        console.print(scaling_table(scaling).rich())
        for line in (*stops(scaling), f"written to {self.out}"):
            console.print(line, highlight=False, soft_wrap=True, markup=False)
