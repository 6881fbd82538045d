"""evo reads what is written: the error of a trajectory is the same by `evo_ape` and by `summary.json`."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import write_log

from ..scenes.drives import short_drive


def evo_ape(reference: Path, estimate: Path, home: Path) -> str:
    """Prints of `evo_ape tum` as a user calls it, with its settings in a home of its own."""
    home.mkdir()
    command = [str(Path(sys.executable).parent / "evo_ape"), "tum", str(reference), str(estimate)]
    environment = os.environ | {"HOME": str(home)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_evo_finds_the_same_error(tmp_path: Path) -> None:
    log = short_drive()
    assert log.truth is not None
    truth = replace(log.truth, associations=None)
    short = Log(log.odometry, log.cycles[:120], log.odometry_sigma, truth=truth)
    write_log(short, tmp_path / "log")
    assert main(["online", str(tmp_path / "log"), "--out", str(tmp_path / "map")]) == 0
    path = tmp_path / "truth.tum"
    assert main(["export", str(tmp_path / "log"), "--as", "tum", "--out", str(path)]) == 0
    printed = evo_ape(path, tmp_path / "map" / "trajectory.tum", tmp_path / "home")
    assert "(not aligned)" in printed
    rmse = re.search(r"rmse\s+([\d.]+)", printed)
    assert rmse is not None
    ate = json.loads((tmp_path / "map" / "summary.json").read_text())["ate"]
    assert float(rmse[1]) == pytest.approx(ate, abs=2e-6)


def test_a_log_without_a_true_path_has_none_to_export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = short_drive()
    write_log(Log(log.odometry, log.cycles[:9], log.odometry_sigma), tmp_path / "log")
    out = tmp_path / "truth.tum"
    assert main(["export", str(tmp_path / "log"), "--as", "tum", "--out", str(out)]) == 2
    assert "expected a log with truth_poses.csv, or a map, found neither" in capsys.readouterr().err
    assert not out.exists()
