"""The table of the suite: a row for each fault and strength, with what it costs and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from pathspace_graph.eval.metrics.measures import UNKNOWN
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.eval.study.study import Study

from .outcome import Outcome

HEADER: Final = (
    "fault",
    "strength",
    "rmse by clean",
    "range",
    "size by clean",
    "missed [%]",
    "closed",
    "lost at the end",
    "largest error [m]",
    "over 1 m off after closing [s, m]",
    "calibration by its prior's sigma",
    "called degraded, lost [% of cycles]",
    "said",
)
NOTHING: Final = "nothing"
"""The table says this where no run said anything."""
_SAID_LENGTH: Final = 60
"""A notice is shortened to this number of characters; the JSON file has the whole of it."""


def fault_table(study: Study, outcomes: Sequence[Outcome]) -> TextTable:
    """Returns the table, without columns that no run knows anything of."""
    rows = [_row(outcome) for outcome in outcomes]
    known = [k for k in range(len(HEADER)) if any(row[k] not in ("", UNKNOWN) for row in rows)]
    title = (
        f"{study.name}: {study.question} {len(study.tracks)} tracks, {len(study.seeds)} seeds, "
        f"{study.laps} laps, {', '.join(study.estimators)}. The rmse is the map's at the end by that "
        "of the clean run on the same track and with the same seed, as its mean and its range. "
        "Lost means more than 5 m off in the last second."
    )
    return TextTable(
        title,
        tuple(HEADER[k] for k in known),
        tuple(tuple(row[k] for k in known) for row in rows),
        groups=_groups(outcomes),
        names=2,
    )


def _groups(outcomes: Sequence[Outcome]) -> tuple[int, ...]:
    """Returns the row numbers at which another kind of fault begins."""
    kinds = [outcome.fault.kind for outcome in outcomes]
    return tuple(k for k in range(1, len(kinds)) if kinds[k] != kinds[k - 1])


def _row(outcome: Outcome) -> tuple[str, ...]:
    values, runs = outcome.values(), len(outcome.runs)
    failed = f", {outcome.failed} failed" if outcome.failed else ""
    return (
        outcome.fault.kind,
        outcome.fault.strength,
        _ratio(values, runs),
        _range(values),
        _number(values["size_ratio"], 2),
        _number(100.0 * values["missed"], 1),
        f"{values['closed']} of {runs}{failed}",
        f"{values['lost']} of {runs}",
        _number(values["error_max"], 1),
        _pair(values["astray_time"], values["astray_way"]),
        ", ".join(f"{name} {value:+.1f}" for name, value in values["calibration"].items()),
        _health(values),
        "; ".join(f"{n} of {runs}: {_short(text)}" for text, n in values["said"].items()) or NOTHING,
    )


def _ratio(values: dict[str, Any], runs: int) -> str:
    mean, with_map = values["ratio_mean"], values["with_map"]
    if np.isnan(mean):
        return "no map"
    return f"{mean:.2f}" if with_map == runs else f"{mean:.2f} ({with_map} of {runs})"


def _range(values: dict[str, Any]) -> str:
    low, high = values["ratio_min"], values["ratio_max"]
    return UNKNOWN if np.isnan(low) else f"{low:.1f} to {high:.1f}"


def _health(values: dict[str, Any]) -> str:
    return _pair(*(100.0 * values[name] for name in ("told_degraded", "told_lost")))


def _pair(one: float, other: float) -> str:
    return UNKNOWN if np.isnan(one) else f"{one:.1f}, {other:.1f}"


def _number(value: float, digits: int) -> str:
    return UNKNOWN if np.isnan(value) else f"{value:.{digits}f}"


def _short(text: str) -> str:
    return text if len(text) <= _SAID_LENGTH else f"{text[:_SAID_LENGTH].rstrip()} …"
