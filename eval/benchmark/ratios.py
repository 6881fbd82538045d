"""Figures of a benchmark as data, and the committed baseline of ratios that a run is compared with.

Only ratios are in the baseline, since times depend on the machine.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from rich.table import Table

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.files import atomic_file, write_json
from pathspace_graph.io.parsing import read_json

FORMAT: Final = "pathspace-benchmark-baseline/1"
BASELINE: Final = Path(__file__).with_name("baseline.json")


@dataclass(frozen=True)
class Metric:
    """One figure of a run."""

    key: str
    """Name of the figure, also in a baseline."""
    value: float
    """Value; NaN where the run was too short for the figure."""
    unit: str
    """Unit of the value; empty for a ratio."""
    direction: Literal["lower", "higher"] = "lower"
    bound: float | None = None
    """Worst value allowed, if any value is not."""
    tolerance: float | None = None
    """Share by which the figure may be worse than its baseline, if there is one."""

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; an unknown value keeps none."""
        return self.bound is None or self._reaches(self.bound)

    def worse_than(self, baseline: float) -> bool:
        """Return whether the figure is worse than the baseline by more than its tolerance, or unknown."""
        spare = (self.tolerance or 0.0) * abs(baseline)
        return not self._reaches(baseline + (spare if self.direction == "lower" else -spare))

    def _reaches(self, value: float) -> bool:
        return self.value <= value if self.direction == "lower" else self.value >= value


@dataclass(frozen=True)
class Compared:
    """A figure of this run beside that of the baseline."""

    metric: Metric
    baseline: float | None

    @property
    def worse(self) -> bool:
        """Whether the figure is worse by more than its tolerance, or missing in this run."""
        return self.baseline is not None and self.metric.worse_than(self.baseline)


def ratios(figures: Iterable[Metric]) -> list[Metric]:
    """Return the figures that have a baseline: ratios with a tolerance."""
    return [metric for metric in figures if not metric.unit and metric.tolerance is not None]


def compare(figures: Iterable[Metric], baseline: Mapping[str, float]) -> list[Compared]:
    """Compare every figure that has a baseline or should; one that the run lacks is worse."""
    known = {metric.key: metric for metric in ratios(figures)}
    return [
        Compared(known.get(key, Metric(key, math.nan, "", tolerance=0.0)), baseline.get(key))
        for key in dict.fromkeys([*known, *baseline])
    ]


def write_baseline(file: Path, figures: Iterable[Metric]) -> None:
    """Write this run's ratios; raise SettingsError where one isn't known because the run is too short."""
    chosen = {metric.key: round(metric.value, 4) for metric in ratios(figures)}
    for key, value in chosen.items():
        if not math.isfinite(value):
            raise SettingsError(f"--write-baseline: expected a figure for {key}, found none")
    with atomic_file(file) as temporary:
        write_json(temporary, {"format": FORMAT, "versions": versions(), "ratios": chosen})


def read_baseline(file: Path) -> dict[str, float]:
    """Return the ratios by name; raise InputError where the file isn't a baseline."""
    content = read_json(file, "a baseline (--write-baseline makes one)")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(file, f'expected "format": "{FORMAT}"')
    entries = content.get("ratios")
    if not isinstance(entries, dict) or not all(_is_number(value) for value in entries.values()):
        raise InputError(file, 'expected "ratios": an object of finite numbers')
    return {key: float(value) for key, value in entries.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def metrics_table(figures: Iterable[Metric]) -> Table:
    """Return a table for a terminal: each figure beside its bound."""
    table = _table("figure", "value", "unit", "bound")
    for metric in figures:
        sign = "<=" if metric.direction == "lower" else ">="
        bound = "" if metric.bound is None else f"{sign} {metric.bound:g}"
        style = None if metric.holds else "red"
        table.add_row(metric.key, f"{metric.value:.3g}", metric.unit, bound, style=style)
    return table


def baseline_table(compared: Sequence[Compared]) -> Table:
    """Return a table for a terminal, where figures that are worse are marked in words and in red."""
    table = _table("ratio", "baseline", "now", "change", "tolerance", "", title="against the baseline")
    for found in compared:
        value, before = found.metric.value, found.baseline
        table.add_row(
            found.metric.key,
            "-" if before is None else f"{before:.3g}",
            f"{value:.3g}",
            f"{100 * (value / before - 1.0):+.0f} %" if before and math.isfinite(value) else "-",
            f"{100 * (found.metric.tolerance or 0.0):.0f} %",
            "WORSE" if found.worse else ("new" if before is None else "ok"),
            style="red" if found.worse else None,
        )
    return table


def _table(name: str, *numbers: str, title: str | None = None) -> Table:
    table = Table(name, title=title, title_justify="left")
    for number in numbers:
        table.add_column(number, justify="right")
    return table
