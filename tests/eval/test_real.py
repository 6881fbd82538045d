"""Logs of a real car: their maps, their last poses, and their tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.eval.real import map_real_log, maps_table, measured_table, runs_table

from ..convert.recorded import camera_drive, write_recorded

CONVERT = ["--from", "csv", "--columns", "label=colour", "--labels", "left=1", "right=0", "--y", "right"]


def test_real_logs_are_mapped_and_held_against_each_other(tmp_path: Path) -> None:
    drives = []
    for name in ("first", "second"):
        recorded = write_recorded(camera_drive(), tmp_path / "recorded" / name)
        assert main(["-q", "convert", str(recorded), *CONVERT, "--out", str(tmp_path / name)]) == 0
        drives.append(map_real_log(tmp_path / name, tmp_path / "out"))
    assert (tmp_path / "out" / "second" / "batch" / "map.json").exists()
    header, rows = runs_table(drives)
    label, online = rows[0]
    assert label == "first, online"
    found = dict(zip(header[1:], (figure.value for figure in online), strict=True))
    assert found["closed [%]"] == 100.0 and found["lost [%]"] == 0.0
    assert found["end off by [m]"] is not None and found["end off by [m]"] < 1.0
    assert [figure.value for figure in maps_table(drives)[1][0][1][:2]] == pytest.approx([0.0, 0.0], abs=1e-9)
    header, rows = measured_table(drives)
    assert [label for label, _ in rows] == ["first", "second", "all drives"]
    assert all(len(figures) == len(header) - 1 for _, figures in rows)
    assert rows[2][1][-1].value == rows[0][1][-1].value


def test_a_report_of_real_logs_needs_some(tmp_path: Path, capsys: object) -> None:
    assert main(["report", "--out", str(tmp_path), "--only", "real"]) == 2
