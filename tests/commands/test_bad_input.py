"""Bad input: exit code 2, one line with file, row and what was expected, and nothing left behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.cli import main

GOOD = {
    "log.toml": 'format = "pathspace-log/1"\n[odometry]\nsigma = [0.1, 0.1, 0.01]\n',
    "odometry.csv": "t,vx,vy,wz\n0.0,5,0,0\n0.1,5,0,0.1\n0.2,5,0,0.1\n",
    "detections.csv": "t,x,y,label,xx,xy,yy\n"
    "0.0,5,1.5,left,0.01,0,0.01\n0.1,5,-1.5,right,0.01,0,0.01\n0.1,4,0,unknown,0.01,0,0.01\n",
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    for name, text in GOOD.items():
        (folder / name).write_text(text)
    return folder


def with_cell(text: str, row: int, column: str, value: str) -> str:
    """The table with one cell replaced; row 1 is the header."""
    lines = [line.split(",") for line in text.splitlines()]
    lines[row - 1][lines[0].index(column)] = value
    return "\n".join(",".join(line) for line in lines) + "\n"


def test_the_log_that_is_spoilt_below_is_a_good_one(log: Path) -> None:
    assert main(["online", str(log), "--out", str(log.parent / "map")]) == 0


@pytest.mark.parametrize(("command", "out"), [("online", "map"), ("batch", "map"), ("compare", "table")])
@pytest.mark.parametrize(("column", "value"), [("vx", "900"), ("vy", "-101"), ("wz", "10.5")])
def test_a_motion_that_no_vehicle_can_make(
    command: str, out: str, column: str, value: str, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (log / "odometry.csv").write_text(with_cell(GOOD["odometry.csv"], 2, column, value))
    assert main([command, str(log), "--out", str(log.parent / out)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"{log / 'odometry.csv'}, row 2: cycle at 0.1 s: " in line
    assert f"expected {column} from -" in line
    assert [path.name for path in log.parent.iterdir()] == ["log"]
