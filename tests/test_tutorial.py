"""The tutorial, as a new user types it."""

from __future__ import annotations

import csv
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.cli import main
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


def lines() -> Iterator[str]:
    """Every line of the page's shell blocks, and each Python block."""
    for language, text in BLOCK.findall((ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")):
        yield from [text] if language == "python" else text.strip().splitlines()


def run(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Does in this process what a line of the page does in one of its own."""
    if "\n" in line:
        exec(compile(line, "tutorial.md", "exec"), {"__name__": "__main__"})
        return
    program, *arguments = shlex.split(line)
    if program == "python":
        script = str(ROOT / arguments[0])
        monkeypatch.setattr(sys, "argv", [script, *arguments[1:]])
        runpy.run_path(script, run_name="__main__")
    else:
        assert program == "pathspace-graph"
        assert main(arguments) == 0, line


def test_the_tutorial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    said = []
    for line in lines():
        run(line, monkeypatch)
        said.append(capsys.readouterr().out)
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
