"""The folder of a result: the four files of the contract, all or none; and trajectories of TUM."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.frames import read_cycles
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.io.results import CycleRecord, RunResult, write_result, write_trajectory
from pathspace_graph.io.tables import read_table, read_trajectory
from pathspace_graph.labels import LEFT


def result() -> RunResult:
    rng = np.random.default_rng(4)
    return RunResult(
        estimator="fixed-lag",
        settings={},
        laps=1,
        map=Map(False, {LEFT: PointBoundary(np.ones((1, 2)), np.eye(2))}),
        trajectory_t=np.array([0.1, 0.2, 1 / 3]),
        trajectory=np.column_stack([rng.normal(0.0, 10.0, (3, 2)), [0.0, np.pi, -3.0]]),
        cycles=(
            CycleRecord(0, 0.1, 1e-3, 0, 4, 7, 1),
            CycleRecord(1, 0.2, np.float64(2e-3), 9, 7, 12, 2, offered=15, health="lost", reason="no way"),
        ),
    )


def test_the_folder_holds_the_four_files_of_the_contract(tmp_path: Path) -> None:
    original = result()
    summary = {
        "estimator": "fixed-lag",
        "ate": np.float64(np.nan),
        "laps": [{"lap": np.int64(1), "rmse": 0.5}],
    }
    write_result(tmp_path / "map", original, summary)
    assert {file.name for file in (tmp_path / "map").iterdir()} == {
        "map.json",
        "trajectory.tum",
        "cycles.csv",
        "summary.json",
    }
    rows = (tmp_path / "map" / "cycles.csv").read_text().splitlines()
    assert rows[0] == "cycle,t,seconds,size_left,size_right,readings,lap,offered,health,reason,dropped"
    assert rows[1:] == ["0,0.1,0.001,0,4,7,1,0,,,0", "1,0.2,0.002,9,7,12,2,15,lost,no way,0"]
    assert read_cycles(tmp_path / "map")["health"].tolist() == ["", "lost"]
    read = json.loads((tmp_path / "map" / "summary.json").read_text())
    made = read.pop("made")
    assert read == {"estimator": "fixed-lag", "ate": None, "laps": [{"lap": 1, "rmse": 0.5}]}
    assert made["commit"] and made["machine"]
    assert abs((datetime.fromisoformat(made["date"]) - datetime.now(UTC)).total_seconds()) < 600.0


def test_a_trajectory_comes_back_as_it_was_written(tmp_path: Path) -> None:
    t, poses = (
        np.array([0.0, 0.1, 1 / 3]),
        np.array([[0.0, 0.0, 0.0], [1.25, -0.1, np.pi], [1e-9, 7.0, -3.0]]),
    )
    write_trajectory(tmp_path / "t.tum", t, poses)
    assert (tmp_path / "t.tum").read_text().splitlines()[0] == "0.0 0.0 0.0 0.0 0.0 0.0 0.0 1.0"
    read_t, read_poses = read_trajectory(tmp_path / "t.tum")
    np.testing.assert_array_equal(read_t, t)
    np.testing.assert_array_equal(read_poses[:, :2], poses[:, :2])
    np.testing.assert_allclose(read_poses[:, 2], poses[:, 2], atol=1e-15)


def test_a_comment_is_left_out_and_a_wrong_row_is_named(tmp_path: Path) -> None:
    file = tmp_path / "t.tum"
    file.write_text("# t tx ty tz qx qy qz qw\n\n0 1 2 0 0 0 0 1\n")
    np.testing.assert_array_equal(read_trajectory(file)[1], [[1.0, 2.0, 0.0]])
    file.write_text("# t tx ty\n0 1 2 0 0 0 0 1\n\n0.1 inf 2 0 0 0 0 1\n")
    with pytest.raises(InputError, match="row 4: expected a finite number in column 'tx'"):
        read_trajectory(file)
    with pytest.raises(InputError, match=r"none\.tum: expected a trajectory"):
        read_trajectory(tmp_path / "none.tum")


# --- rows that are too long ------------------------------------------------------------------------------


POSE = "0.1 1 2 0 0 0 0 1"


@pytest.mark.parametrize(
    ("text", "row"),
    [
        (f"{POSE} 5\n{POSE}\n", 1),
        (f"{POSE} 5 6\n{POSE}\n", 1),
        (f"{POSE}\n{POSE} 5\n", 2),
        (f"{POSE}\n{POSE} 5 6 7\n", 2),
    ],
)
def test_a_pose_with_more_fields_is_refused_by_its_row(text: str, row: int, tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").write_text(text)
    with pytest.raises(InputError, match=rf"trajectory\.tum, row {row}: expected 8 fields, found"):
        read_trajectory(tmp_path / "trajectory.tum")


def test_a_quote_that_is_not_closed_is_told(tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").write_text(f'{POSE}\n0 0 2 0 0 0 8 " ')
    with pytest.raises(InputError, match=r"trajectory\.tum.*expected a table of texts"):
        read_trajectory(tmp_path / "trajectory.tum")


def test_a_header_quoted_over_lines_with_more_fields_than_its_first_line_is_refused(
    tmp_path: Path,
) -> None:
    (tmp_path / "table.csv").write_text('a,"b\nc",d\n1,2,3\n')
    assert list(read_table(tmp_path / "table.csv").columns) == ["a", "b\nc", "d"]
    (tmp_path / "table.csv").write_text('a,"b\nc",d,e\n1,2,3,4\n')
    with pytest.raises(InputError, match=r"table\.csv, row 1: expected 2 fields, found more"):
        read_table(tmp_path / "table.csv")
