"""The gap of every run to the batch optimum over the same log, where a comparison holds one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pathspace_graph import estimators as registry
from pathspace_graph.eval.metrics.gap import gap
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import RunResult

from .comparison import Comparison, Outcome, Row


def with_gaps(comparison: Comparison) -> Comparison:
    """With `gap_curves` and `gap_trajectory` in the rows of whole logs, where `spline` ran as well."""
    found: list[Outcome] = []
    for named in comparison.logs:
        outcomes = comparison.of(named.name)
        batch = next((o.result for o in outcomes if o.estimator == registry.DEFAULT_BATCH), None)
        found += outcomes if batch is None else [_held_against(outcome, batch) for outcome in outcomes]
    return replace(comparison, outcomes=tuple(found))


def _held_against(outcome: Outcome, batch: RunResult) -> Outcome:
    if outcome.result is None or outcome.estimator == registry.DEFAULT_BATCH:
        return outcome
    columns = gap_columns(outcome.result, batch)
    rows = tuple(row | columns if row["scope"] == "log" else row for row in outcome.rows)
    return replace(outcome, rows=rows)


def gap_columns(result: RunResult, batch: RunResult) -> Row:
    """Mean distance of the curves both ways, of both boundaries (m), and rms distance of the poses (m).

    Landmarks are no curves: of a landmark map the trajectory alone.
    """
    found = gap(result, batch)
    row: Row = {"gap_trajectory": float(np.hypot(found.along, found.across))}
    if found.curves and _has_curves(result.map):
        row["gap_curves"] = float(np.mean(list(found.curves.values())))
    return row


def _has_curves(track: Map) -> bool:
    return all(isinstance(boundary, SplineBoundary) for boundary in track.boundaries.values())
