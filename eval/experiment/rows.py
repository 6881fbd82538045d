"""Studies of a function: its rows for each of some arguments, run and kept as the cells of any study."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import numpy as np
import pandas as pd

from pathspace_graph.errors import SolveError

from .provenance import code_from, here
from .runner import Cell, OnCell, Record, run_cells, workers

RowsOf = Callable[..., list[dict[str, Any]]]


@dataclass(frozen=True, eq=False)
class RowsCell(Cell):
    """A function with the arguments that its rows depend on."""

    function: RowsOf
    arguments: Mapping[str, Any]
    others: Mapping[str, Any] = field(default_factory=dict)  # arguments that change no row
    depends: Any = None  # on what its rows depend beside the arguments and its code

    @property
    def module(self) -> str:
        return str(self.function.__module__)

    @property
    def names(self) -> dict[str, Any]:
        return {name: value for name, value in self.arguments.items() if isinstance(value, str | int | float)}

    @cached_property
    def meaning(self) -> str:
        return str(joblib.hash([self.function.__qualname__, dict(self.arguments), self.depends]))

    def run(self) -> Record:
        return {"rows": self.function(**self.arguments, **self.others)}


def rows_of(
    function: RowsOf,
    arguments: list[dict[str, Any]],
    folder: Path | None = None,
    *,
    jobs: int = 1,
    on_cell: OnCell | None = None,
    **more: Any,
) -> pd.DataFrame:
    """Return the rows of a function of a module for each of some arguments; SolveError where one fails.

    With a `folder` they are kept there, so that a study that was killed goes on. `more` is for the cells.
    """
    code, began = code_from(function.__module__), here()
    cells = [RowsCell(function, of, code=code, began=began, **more) for of in arguments]
    with TemporaryDirectory() if folder is None else nullcontext(folder) as place, workers(jobs):
        records = run_cells(cells, Path(place), on_cell=on_cell, retry_failed=True)
    for cell in cells:
        if failure := records[cell.id]["failure"]:
            raise SolveError(f"{', '.join(map(str, cell.names.values()))}: {failure}")
    rows = [row for cell in cells for row in records[cell.id]["rows"]]
    return pd.DataFrame([{k: np.nan if v is None else v for k, v in row.items()} for row in rows])
