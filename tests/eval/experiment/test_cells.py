"""A cell as it runs: what is measured of it, and what is left of one that fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment import cells
from pathspace_graph.eval.experiment.cells import Cell, run_cell
from pathspace_graph.eval.experiment.drives import NamedLog
from pathspace_graph.io.log import Log, read_log
from pathspace_graph.io.results import RunResult
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.rings import register, write_logs


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Log:
    register(monkeypatch)
    return read_log(write_logs(tmp_path / "round") / "a")


def cell(estimator: str, log: Log) -> Cell[NamedLog]:
    return Cell(NamedLog("a", log), estimator, MapperSettings())


def test_a_run_is_measured(log: Log) -> None:
    found = run_cell(cell("rings", log))
    assert found.names == {"log": "a", "estimator": "rings"}
    assert [row.lap for row in found.rows] == [1, 2, None]
    assert found.rows[-1].values["seconds"] > 0.0
    assert found.result is not None and found.result.estimator == "rings"
    assert found.failure == found.trace == ""


def test_a_failure_of_the_run_and_of_the_measure_are_results(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(result: RunResult, log: Log, seconds: float) -> None:
        raise SettingsError("two\n  lines")

    assert run_cell(cell("broken", log)).failure == "ValueError: lost the way"
    monkeypatch.setattr(cells, "measure", measure)
    found = run_cell(cell("rings", log))
    assert found.result is None and not found.rows
    assert found.failure == "SettingsError: two lines"
    assert "in measure" in found.trace
