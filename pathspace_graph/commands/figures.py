"""`figures`: the paper's isolated tests as figures."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from threadpoolctl import threadpool_limits

from pathspace_graph.eval.figures.isolated import FIGURES, MARKER, write_figures
from pathspace_graph.io.files import check_target
from pathspace_graph.progress import progress


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Draw the paper's isolated tests: uncertainty, expansion, the fit of S_z and simplification."""

    out: Path
    """Folder for the figures and their captions; earlier ones there are kept as a numbered backup."""

    def run(self) -> None:
        check_target(self.out, MARKER)
        with progress("drawing", len(FIGURES)) as advance, threadpool_limits(limits=1):
            write_figures(self.out, advance)
        names = ", ".join(figure.name for figure in FIGURES)
        Console().print(f"{names}: {self.out}", highlight=False, soft_wrap=True, markup=False)
