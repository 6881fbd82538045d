"""The benchmark's committed baseline of ratios (times depend on the machine), and what is worse than it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.table import Table

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.files import atomic_file, write_json
from pathspace_graph.io.parsing import read_json

from .metric import Metric

FORMAT: Final = "pathspace-benchmark-baseline/1"
BASELINE: Final = Path(__file__).with_name("baseline.json")
"""This baseline comes with the package."""


@dataclass(frozen=True)
class BaselineComparison:
    """Holds a figure of this run beside that of the baseline; either may be missing."""

    key: str
    """The figure has this name."""
    value: float
    """This is the value of this run; it is NaN where the run has none."""
    baseline: float | None
    """This is the value of the baseline; it is None where the baseline has none."""
    tolerance: float
    """The figure may be worse than the baseline by this share."""
    worse: bool
    """This says whether the figure is worse by more than that, or missing in this run."""


def ratios(figures: Iterable[Metric]) -> list[Metric]:
    """Returns the figures that have a baseline: ratios with a tolerance."""
    return [metric for metric in figures if not metric.unit and metric.tolerance is not None]


def compare(figures: Iterable[Metric], baseline: Mapping[str, float]) -> tuple[BaselineComparison, ...]:
    """Compares every figure that has a baseline or should; one that the run lacks is worse."""
    known = {metric.key: metric for metric in ratios(figures)}
    found = []
    for key in dict.fromkeys([*known, *baseline]):
        metric = known.get(key, Metric(key, math.nan, "", tolerance=0.0))
        before = baseline.get(key)
        worse = before is not None and metric.worse_than(before)
        found.append(BaselineComparison(key, metric.value, before, metric.tolerance or 0.0, worse))
    return tuple(found)


def write_baseline(file: Path, figures: Iterable[Metric]) -> None:
    """Writes this run's ratios; raises SettingsError where one isn't known because the run is too short."""
    chosen = ratios(figures)
    for metric in chosen:
        if not math.isfinite(metric.value):
            raise SettingsError(f"--write-baseline: expected a figure for {metric.key}, found none")
    content = {
        "format": FORMAT,
        "versions": versions(),
        "ratios": {metric.key: round(metric.value, 4) for metric in chosen},
    }
    with atomic_file(file) as temporary:
        write_json(temporary, content)


def read_baseline(file: Path) -> dict[str, float]:
    """Returns the ratios by name; raises InputError where the file isn't a baseline."""
    content = read_json(file, "a baseline (--write-baseline makes one)")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(file, f'expected "format": "{FORMAT}"')
    entries = content.get("ratios")
    if not isinstance(entries, dict) or not all(_is_number(value) for value in entries.values()):
        raise InputError(file, 'expected "ratios": an object of finite numbers')
    return {key: float(value) for key, value in entries.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def baseline_table(comparisons: Sequence[BaselineComparison]) -> Table:
    """Returns a table for a terminal, where figures that are worse are marked in words and in red."""
    table = Table("ratio", title="against the baseline", title_justify="left")
    for name in ("baseline", "now", "change", "tolerance", ""):
        table.add_column(name, justify="right")
    for found in comparisons:
        style = "red" if found.worse else None
        tolerance = f"{100 * found.tolerance:.0f} %"
        verdict = "WORSE" if found.worse else ("new" if found.baseline is None else "ok")
        before = "-" if found.baseline is None else f"{found.baseline:.3g}"
        table.add_row(
            found.key, before, f"{found.value:.3g}", _change(found), tolerance, verdict, style=style
        )
    return table


def _change(found: BaselineComparison) -> str:
    if not found.baseline or not math.isfinite(found.value):
        return "-"
    return f"{100 * (found.value / found.baseline - 1.0):+.0f} %"
