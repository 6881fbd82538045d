"""`batch` with several logs, and `compare` with two maps: what is written, said and refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.batch.joint import OTHER_TRACK
from pathspace_graph.cli import main
from pathspace_graph.commands.estimate import unique_names
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.tables import read_trajectory

from ..batch.joint.several import lap


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs: two of a track, of which one began elsewhere, and one of another track."""
    home = tmp_path_factory.mktemp("drives")
    for name, log in (("a", lap(0)), ("b", lap(1, 9.0)), ("other", lap(0, 0.0, 5))):
        write_log(log, home / name)
    return home


def test_several_logs_give_one_map_and_a_trajectory_for_each(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "map"
    logs = [str(folder / name) for name in ("a", "b", "other")]
    assert main(["batch", *logs, "--out", str(out)]) == 3
    printed = capsys.readouterr()
    assert printed.err.splitlines()[-1] == f"other is left out: {OTHER_TRACK}"
    assert "b: 1 lap, begins at" in printed.out
    assert read_map(out).closed
    assert sorted(path.name for path in (out / "drives").iterdir()) == ["a", "b"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["left_out"] == {"other": OTHER_TRACK}
    for name, log in (("a", lap(0)), ("b", lap(1, 9.0))):
        t, poses = read_trajectory(out / "drives" / name / "trajectory.tum")
        np.testing.assert_array_equal(t, [cycle.t for cycle in log.cycles])
        drive = summary["drives"][name]
        assert drive["final"]["missed"] == 0.0 and drive["ate"] < 0.35
        np.testing.assert_allclose(poses[0][:2], drive["frame"][:2], atol=0.8)  # at the first cycle
    np.testing.assert_allclose(summary["drives"]["a"]["frame"], 0.0, atol=1e-6)
    assert (out / "trajectory.tum").read_bytes() == (out / "drives/a/trajectory.tum").read_bytes()


def test_logs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [tmp_path / part for part in ("day1/run", "day2/run", "day2/run-2", "day3/run")]
    assert list(unique_names(folders)) == ["run", "run-2", "run-2-2", "run-3"]
