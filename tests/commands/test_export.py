"""`export` on map folders, and what it refuses."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import Map, map_to_json
from pathspace_graph.io.results import write_trajectory

from ..scenes.drives import short_drive
from ..scenes.maps import open_map, ring_map

WITHIN = 20.0  # radius of a drive between the boundaries of the ring (m)
ORIGIN = ["--origin", "-33.9", "-151.2", "-30"]


def folder(path: Path, track: Map) -> Path:
    path.mkdir()
    (path / "map.json").write_text(json.dumps(map_to_json(track)))
    write_trajectory(path / "trajectory.tum", [0.0, 0.1], np.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.2]]))
    return path


@pytest.mark.parametrize("kind", ["centerline", "tum", "geojson", "points", "lanelet2"])
def test_each_format_is_written(kind: str, tmp_path: Path) -> None:
    for name, track in (("ring", ring_map()), ("open", open_map())):
        source, out = folder(tmp_path / name, track), tmp_path / f"{name}.{kind}"
        assert main(["export", str(source), "--as", kind, "--out", str(out), "--step", "2", *ORIGIN]) == 0
        assert out.stat().st_size > 0


def test_the_trajectory_is_copied_to_the_byte_over_an_earlier_file(tmp_path: Path) -> None:
    source, out = folder(tmp_path / "map", ring_map()), tmp_path / "out.tum"
    out.write_text("earlier")
    assert main(["export", str(source), "--as", "tum", "--out", str(out)]) == 0
    assert out.read_bytes() == (source / "trajectory.tum").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"map", "out.tum"}


@pytest.mark.parametrize("kind", ["centerline", "profile", "geojson", "lanelet2"])
def test_no_way_is_exported_where_the_drive_crosses_a_boundary(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The vehicle drives from inside of the ring across its left boundary to the right one."""
    source, out = folder(tmp_path / "map", ring_map()), tmp_path / "out"
    angles = np.linspace(0.0, 2.0 * np.pi, 200)
    radius = WITHIN + np.where((angles > 2.0) & (angles < 3.0), -4.0, 0.0)
    path = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), angles])
    write_trajectory(source / "smoothed.tum", angles, path)
    assert main(["export", str(source), "--as", kind, "--out", str(out), *ORIGIN]) == 2
    error = capsys.readouterr().err
    assert f"{source / 'map.json'}: expected the map of the drive in smoothed.tum: the left" in error
    x, y = (float(word) for word in re.findall(r"[xy] = (\S+) m", error))
    assert np.arctan2(y, x) == pytest.approx(2.0, abs=0.1)
    assert not out.exists()
    assert main(["export", str(source), "--as", "points", "--out", str(out)]) == 0
    path[:, :2] *= WITHIN / radius[:, None]
    write_trajectory(source / "smoothed.tum", angles, path)
    assert main(["export", str(source), "--as", kind, "--out", str(tmp_path / "good"), *ORIGIN]) == 0


# --- evo reads what is written ---------------------------------------------------------------------------


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
