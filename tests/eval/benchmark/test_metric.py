"""A figure keeps its bound or not, and a table says so."""

from __future__ import annotations

import io

from rich.console import Console

from pathspace_graph.eval.benchmark.measurement import Metric, metrics_table


def test_a_bound_is_kept_or_not() -> None:
    assert Metric("a", 2.0, "", bound=2.0).holds
    assert not Metric("a", 2.1, "", bound=2.0).holds
    assert not Metric("a", float("nan"), "", bound=2.0).holds
    assert Metric("a", float("nan"), "").holds


def test_a_table_shows_each_figure_beside_its_bound() -> None:
    figures = [Metric("mean_by_isam2", 1.234, "", bound=2.0), Metric("closing", float("nan"), "ms")]
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(metrics_table(figures).rich())
    lines = console.export_text().splitlines()
    assert any("mean_by_isam2" in line and "1.23" in line and "<= 2" in line for line in lines)
