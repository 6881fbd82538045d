"""The tutorial, as a new user types it."""

from __future__ import annotations

import csv
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import read_trajectory

from .scenes.paths import ROOT

pytest.importorskip("rosbags")
pytest.importorskip("rerun")

BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)


def size_left(file: Path) -> NDArray[np.float64]:
    """Control points of the left boundary in each cycle."""
    with file.open(newline="") as rows:
        return np.array([float(row["size_left"]) for row in csv.DictReader(rows)])


def commands() -> list[list[str]]:
    """Every line of the page's shell blocks, and each Python block, as what the interpreter is to run."""
    found: list[list[str]] = []
    for language, text in BLOCK.findall((ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")):
        if language == "python":
            found.append(["-c", text])
            continue
        for line in text.strip().splitlines():
            program, *arguments = shlex.split(line)
            if program == "python":
                found.append([str(ROOT / arguments[0]), *arguments[1:]])
            else:
                assert program == "pathspace-graph"
                found.append(["-m", "pathspace_graph", *arguments])
    return found


def test_the_tutorial(tmp_path: Path) -> None:
    said = []
    for command in commands():
        run = subprocess.run(
            [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert run.returncode == 0, f"{command}: {run.stderr}"
        said.append(run.stdout)
    online, reference = (read_map(tmp_path / name) for name in ("map", "reference"))
    assert online.closed
    assert reference.closed
    with_truth = tmp_path / "comparison" / "fixed-lag"
    truth = read_map(with_truth)
    assert abs(online.size - truth.size) < 10  # the bag lost nothing that matters
    poses = [read_trajectory(at / "trajectory.tum")[1] for at in (tmp_path / "map", with_truth)]
    left = [size_left(at / "cycles.csv") for at in (tmp_path / "map", with_truth)]
    alike = np.abs(left[0] - left[1]) < 0.25 * online.size  # a curve becomes smaller where the loop closes
    assert (~alike).sum() <= 2
    assert np.hypot(*(poses[0] - poses[1])[alike, :2].T).max() < 1.5
    assert (tmp_path / "drive.rrd").stat().st_size > 0
    assert (tmp_path / "comparison" / "table.md").exists()
    rows = np.loadtxt(tmp_path / "centerline.csv", delimiter=",")
    assert 1.0 < rows[:, 2:].mean() < 3.0
    assert "a lap of" in said[-2]
