"""`scale`: the time of an update against the size of the map, its detections and the laps."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from rich.console import Console
from tyro.conf import arg

from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import ONLINE, check_online
from pathspace_graph.eval.benchmark.roads import QUICK, ScalingSettings, make_drives
from pathspace_graph.eval.benchmark.scaling import measure_scaling
from pathspace_graph.eval.benchmark.scaling_output import MARKER, scaling_table, stops, write_scaling
from pathspace_graph.io.files import check_target
from pathspace_graph.progress import progress
from pathspace_graph.settings.mapper import MapperSettings

FILE_WIDTH: Final = 160
"""Characters in a line of a table that is not printed on a terminal."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Time every online estimator on ever larger maps and ever more detections, and fit and draw the slopes.

    All run in this one process, cycle for cycle in turn, so that other work of the machine slows all of them
    alike. An estimator that takes longer than the budget is stopped there, and the table says so. Memory is
    measured by tracemalloc, for Python and numpy, while the first lap of the closed road is mapped.
    """

    out: Path
    """Folder for points, slopes and figures; earlier ones there are kept as a numbered backup."""
    estimators: tuple[str, ...] = ()
    """Names of the online estimators; by default all."""
    quick: bool = False
    """Take less than a minute, with small maps and few laps, to see that everything works. It goes with no
    other `scaling` option."""
    scaling: ScalingSettings = field(default_factory=ScalingSettings)
    """What is measured."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of every estimator."""

    def run(self) -> None:
        """Check, simulate, time, write and report."""
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
