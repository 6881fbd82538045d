"""A cell as it runs: what is measured of it, and what is left of one that fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment import run
from pathspace_graph.eval.experiment.compare import plan_of

from ...scenes.rings import register, write_logs


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    register(monkeypatch)
    return write_logs(tmp_path / "round") / "a"


def test_a_run_is_measured_and_its_files_are_kept(log: Path) -> None:
    found = plan_of(log, ("rings",)).cells[0].record()
    assert found["cell"]["track"] == "a" and found["cell"]["estimator"] == "rings"
    assert [row["lap"] for row in found["rows"]] == [1, 2, None]
    assert found["rows"][-1]["seconds"] > 0.0 and found["rows"][-1]["seconds_processor"] > 0.0
    assert {"map.json", "trajectory.tum", "cycles.csv", "summary.json"} <= set(found["files"])
    assert found["failure"] == found["traceback"] == ""


def test_a_failure_of_the_run_and_of_the_measure_are_results(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(*_: object, **__: object) -> None:
        raise SettingsError("two\n  lines")

    broken, rings = plan_of(log, ("broken", "rings")).cells
    assert broken.record()["failure"] == "ValueError: lost the way"
    monkeypatch.setattr(run, "measure", measure)
    found = rings.record()
    assert found["rows"] == [] and "files" not in found
    assert found["failure"] == "SettingsError: two lines"
    assert "in measure" in found["traceback"]
