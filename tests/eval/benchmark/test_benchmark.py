"""The command's exit codes, and the file of figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pathspace_graph.eval.benchmark import __main__ as benchmark
from pathspace_graph.eval.benchmark.measurement import metrics

from .timing import steady_run


@pytest.mark.parametrize(("times", "code"), [(1.0, None), (2.0, 1)])
def test_the_script_ends_with_1_where_it_got_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: float, code: int | None
) -> None:
    def run(factor: float, *options: str) -> None:
        monkeypatch.setattr(benchmark.measurement, "measure_drive", lambda *_: steady_run(0.002 * factor))
        monkeypatch.setattr("sys.argv", ["benchmark", "--baseline", str(tmp_path / "b.json"), *options])
        benchmark.main()

    with pytest.raises(SystemExit) as missing:
        run(1.0, "--compare")
    assert missing.value.code == benchmark.BAD_INPUT
    run(1.0, "--write-baseline")
    if code is None:
        run(times, "--compare")
        return
    with pytest.raises(SystemExit) as end:
        run(times, "--compare")
    assert end.value.code == code


def test_the_file_has_an_object_for_each_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_loop = steady_run(closing=300)
    monkeypatch.setattr(benchmark.measurement, "measure_drive", lambda *_: open_loop)
    monkeypatch.setattr("sys.argv", ["benchmark", "--json", str(tmp_path / "figures.json")])
    benchmark.main()
    rows = json.loads((tmp_path / "figures.json").read_text())
    assert [row["key"] for row in rows] == [metric.key for metric in metrics(steady_run())]
    assert rows[0] == {
        "key": "mean_by_landmark",
        "value": pytest.approx(0.2),
        "unit": "",
        "bound": None,
        "tolerance": 0.2,
    }
    assert {row["key"] for row in rows if row["value"] is None} == {"closing", "closing_by_mean"}
