"""An attempt: what is measured of a run, and what is left of one that fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.harness.attempts import Attempt, attempt
from pathspace_graph.io.log import Log, read_log
from pathspace_graph.io.results import RunResult
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.rings import register, write_logs


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Log:
    register(monkeypatch)
    return read_log(write_logs(tmp_path / "round") / "a")


def test_a_run_is_measured(log: Log) -> None:
    def measure(result: RunResult, measured: Log, seconds: float) -> tuple[str, bool]:
        return result.estimator, measured is log and seconds > 0.0

    found = attempt("rings", MapperSettings(), log, measure)
    assert found.measured == ("rings", True)
    assert found.result is not None
    assert found.failure == found.trace == ""


def test_a_failure_of_the_run_and_of_the_measure_are_results(log: Log) -> None:
    def measure(result: RunResult, log: Log, seconds: float) -> None:
        raise SettingsError("two\n  lines")

    found: Attempt[None] = attempt("rings", MapperSettings(), log, measure)
    assert found.result is None
    assert found.failure == "SettingsError: two lines"
    assert "in measure" in found.trace
    assert attempt("broken", MapperSettings(), log, measure).failure
