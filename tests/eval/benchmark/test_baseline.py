"""A figure is worse beyond its tolerance, and only ratios are compared."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.benchmark.measurement import (
    BASELINE,
    Metric,
    baseline_table,
    compare,
    metrics,
    ratios,
    read_baseline,
    write_baseline,
)

from .timing import steady_run


def ratio(value: float, key: str = "a") -> Metric:
    return Metric(key, value, "", tolerance=0.1)


def test_worse_is_beyond_the_tolerance() -> None:
    assert not ratio(2.19).worse_than(2.0)
    assert ratio(2.21).worse_than(2.0)
    assert not ratio(0.5).worse_than(2.0)
    assert ratio(float("nan")).worse_than(2.0)


def test_only_ratios_are_compared() -> None:
    figures = [ratio(2.5), Metric("time", 9.0, "ms", tolerance=0.1), Metric("b", 1.0, "")]
    assert [*ratios(figures)] == ["a"]
    found = compare([*figures, ratio(1.0, "new")], {"a": 2.0, "gone": 1.0})
    worse = {metric.key: metric.worse_than(before) for metric, before in found}
    assert worse == {"a": True, "new": False, "gone": True}
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(baseline_table(found).rich())
    lines = console.export_text().splitlines()
    assert any("a" in line and "+25 %" in line and "WORSE" in line for line in lines)
    assert any("new" in line and "WORSE" not in line for line in lines)


def test_a_baseline_is_read_as_written(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    write_baseline(file, [ratio(1.23456789), Metric("time", 3.0, "ms")])
    assert read_baseline(file) == {"a": 1.2346}
    with pytest.raises(SettingsError, match="found none"):
        write_baseline(file, [ratio(float("nan"))])
    assert read_baseline(file) == {"a": 1.2346}


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"format": "pathspace-benchmark-baseline/1", "ratios": [1]}']
)
def test_what_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(InputError, match="expected"):
        read_baseline(tmp_path / "bad.json")
    with pytest.raises(InputError, match="--write-baseline makes one"):
        read_baseline(tmp_path / "none.json")


def test_the_committed_baseline_is_of_this_benchmark() -> None:
    """The same figures as a run gives, all ratios, and within what is asked of them."""
    figures = ratios(metrics(steady_run()))
    baseline = read_baseline(BASELINE)
    assert set(baseline) == set(figures)
    assert all(replace(figures[key], value=value).holds for key, value in baseline.items())
