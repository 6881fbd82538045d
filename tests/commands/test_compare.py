"""`compare` end to end with estimators whose maps are known: what it writes, says and refuses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import read_map

from ..scenes.rings import register, write_logs

NAMES = ("rings", "gaps", "rings-batch")


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_logs(tmp_path_factory.mktemp("drives") / "round")


def without_truth(folder: Path, out: Path) -> Path:
    write_log(replace(read_log(folder), truth=None), out)
    return out


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def test_the_command_writes_tables_figures_and_maps(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(folder / "a"), "--out", str(out), "--estimators", *NAMES]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "rmse [m]" in printed.out and "ghost curve [m]" not in printed.out
    assert "ghost curve [m]" in (out / "metrics.md").read_text()
    *told, unsettled = printed.err.splitlines()
    assert unsettled == "rings-batch on a: not converged"
    assert [line.split(",")[0] for line in told] == [f"comparing: {done} of 3" for done in range(4)]
    files = {f"{name}.{suffix}" for name in ("table", "metrics") for suffix in ("csv", "md", "tex")}
    figures = {f"{name}.{suffix}" for name in ("maps",) for suffix in ("png", "pdf")}
    assert {path.name for path in out.iterdir()} == files | figures | {
        "times.csv",
        "comparison.json",
        *NAMES,
    }
    assert read_map(out / "gaps").size == 36
    assert json.loads((out / "rings" / "summary.json").read_text())["laps"][1]["size"] == 32
    table = rows(out / "table.csv")
    assert [row["lap"] for row in table] == ["1", "2", "1", "2", "2"]
    assert {"log", "estimator", "scope", "lap", "rmse", "missed_1m"} <= set(rows(out / "metrics.csv")[0])
    assert json.loads((out / "comparison.json").read_text())["failures"] == []


@pytest.mark.slow
def test_a_second_comparison_needs_force_and_a_failure_ends_in_3(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], png_only: None
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(folder / "a"), "--out", str(out), "--estimators", "broken", "rings"]
    assert main(command) == 3
    assert "broken on a: failed, ValueError: lost the way" in capsys.readouterr().err
    assert (out / "rings" / "map.json").exists() and not (out / "broken").exists()
    assert main(command) == 2
    assert "(--force replaces it)" in capsys.readouterr().err
    (out / "table.md").unlink()
    assert main([*command, "--force"]) == 3
    assert (out / "table.md").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"out"}, "nothing unfinished is left"


def test_where_all_fail_the_tables_say_so(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["compare", str(folder), "--out", str(out), "--estimators", "broken"]) == 3
    printed = capsys.readouterr()
    assert "failed" in printed.out and "no true cones" not in printed.out
    assert printed.err.count("lost the way") == 2
    assert (out / "table.tex").exists() and not list(out.rglob("*.png"))


def test_without_truth_the_command_says_so_and_draws_the_maps(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], png_only: None
) -> None:
    log, out = without_truth(folder / "a", tmp_path / "bare"), tmp_path / "out"
    assert main(["compare", str(log), "--out", str(out), "--estimators", "rings", "gaps"]) == 0
    assert "no true cones" in capsys.readouterr().out
    assert (out / "maps.png").exists()


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["compare", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert "found neither" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"empty"}


# --- two maps --------------------------------------------------------------------------------------------


def test_two_maps_are_laid_on_each_other(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rings have 2 and 6 m more radius than the way; a map lies on itself."""
    maps, out = tmp_path / "maps", tmp_path / "apart"
    main(["compare", str(folder / "a"), "--out", str(maps), "--estimators", "rings", "gaps"])
    capsys.readouterr()
    assert main(["compare", str(maps / "rings"), str(maps / "rings"), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "mean [m]" in printed and f"written to {out}" in printed
    found = json.loads((out / "apart.json").read_text())
    assert found["distances"]["left"]["max"] < 1e-6
    np.testing.assert_allclose(found["motion"], 0.0, atol=1e-6)
    assert (out / "apart.png").stat().st_size > 10_000
    assert main(["compare", str(maps / "rings"), str(maps / "gaps"), "--out", str(out), "--force"]) == 0
    assert json.loads((out / "apart.json").read_text())["distances"]["both"]["max"] > 0.01


def test_maps_and_logs_are_not_compared(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(folder / "a")
    assert main(["compare", log, log, "--out", str(tmp_path / "apart")]) == 2
    assert "map.json: expected a map, found none" in capsys.readouterr().err
    assert main(["compare", log, log, log, "--out", str(tmp_path / "apart")]) == 2
    assert "LOG: expected one log, or two maps, found 3 folders" in capsys.readouterr().err
    assert not (tmp_path / "apart").exists()
