"""The files of the suite: the table in four forms, every value as CSV and JSON, and the figure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.figures.files import SUFFIXES, render
from pathspace_graph.eval.study.output import write_results
from pathspace_graph.eval.study.study import Study
from pathspace_graph.io.files import replacing, write_json, write_text

from .outcome import Outcome, outcomes
from .plot import plot_faults
from .table import fault_table

FORMAT: Final = "pathspace-faults/1"
NAME: Final = "faults"
"""The files of the suite have this name, with a suffix each."""


def write_suite(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Writes the results of every run, and the table, the values and the figure; returns the table's text."""
    found = outcomes(study, frame)
    table = fault_table(study, found)
    text = f"{table.title}\n\n{table.text()}\n"
    write_results(frame, out)
    write_text(out / f"{NAME}.txt", text)
    write_text(out / f"{NAME}.md", table.markdown())
    write_text(out / f"{NAME}.tex", table.latex())
    _write_values(study, found, out)
    figure = plot_faults(found)
    for suffix in SUFFIXES:
        with replacing(out / f"{NAME}{suffix}") as temporary:
            render(figure, temporary, suffix)
    return text


def _write_values(study: Study, found: Sequence[Outcome], out: Path) -> None:
    """Writes `faults.csv`, in which calibration and notices are JSON texts, and `faults.json`."""
    rows = [_without_nan(outcome.values()) for outcome in found]
    content = {
        "format": FORMAT,
        "estimator": study.estimators,
        "seeds": study.seeds,
        "laps": study.laps,
        "faults": rows,
    }
    write_json(out / f"{NAME}.json", content, indent=1)
    flat = [{name: _flat(value) for name, value in row.items()} for row in rows]
    with replacing(out / f"{NAME}.csv") as temporary:
        pd.DataFrame(flat).to_csv(temporary, index=False, lineterminator="\n")


def _without_nan(row: dict[str, Any]) -> dict[str, Any]:
    return {name: None if isinstance(v, float) and np.isnan(v) else v for name, v in row.items()}


def _flat(value: Any) -> Any:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, dict) else value
