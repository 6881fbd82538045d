"""Victoria Park: the file that GTSAM brings becomes a log, with GTSAM's optimum as its reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.convert.victoria_park import PERIOD, example_file
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.factors.se2 import compose, to_map
from pathspace_graph.io.log import Log, read_log
from pathspace_graph.labels import LEFT

POSES = 400
MOVE = "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n"


def beginning(folder: Path) -> Path:
    """The rows of the first poses of the file."""
    rows = example_file().read_text().splitlines()
    moves = [index for index, row in enumerate(rows) if row.startswith("ODOMETRY")]
    file = folder / "park.txt"
    file.write_text("\n".join(rows[: moves[POSES - 1] + 1]) + "\n")
    return file


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    folder = tmp_path_factory.mktemp("park")
    file, out = beginning(folder), folder / "log"
    assert main(["convert", str(file), "--from", "victoria-park", "--out", str(out)]) == 0
    return read_log(out)


def test_the_log_has_every_row_of_the_file(log: Log, tmp_path: Path) -> None:
    rows = [row.split() for row in beginning(tmp_path).read_text().splitlines()]
    moves = np.array([row[1:] for row in rows if row[0] == "ODOMETRY"], dtype=float)
    found = np.array([row[1:] for row in rows if row[0] == "LANDMARK"], dtype=float)
    np.testing.assert_allclose(np.diff(log.odometry.t), PERIOD)
    steps = [integrate_poses(np.array([PERIOD]), twist[None])[-1] for twist in log.odometry.twist]
    np.testing.assert_allclose(steps, moves[:, 2:5], atol=1e-11)
    points = np.concatenate([cycle.points_vehicle for cycle in log.cycles])
    np.testing.assert_array_equal(points, found[:, 2:4])
    np.testing.assert_allclose(
        np.concatenate([cycle.covariances for cycle in log.cycles]),
        np.tile(0.4 * np.eye(2), (len(points), 1, 1)),
    )
    assert all((cycle.labels == LEFT).all() for cycle in log.cycles)
    assert log.truth is not None
    assert log.truth.associations is not None
    trees = found[:, 1]
    np.testing.assert_array_equal(log.truth.associations, np.searchsorted(np.unique(trees), trees))
    assert log.source["truth"].startswith("no survey")


def test_the_reference_is_an_optimum_that_the_detections_agree_with(log: Log) -> None:
    truth = log.truth
    assert truth is not None
    assert truth.associations is not None
    np.testing.assert_array_equal(truth.poses[0], np.zeros(3))
    assert len(truth.poses) == POSES + 1
    stamps = np.concatenate([np.full(len(cycle.labels), cycle.t) for cycle in log.cycles])
    points = np.concatenate([cycle.points_vehicle for cycle in log.cycles])
    poses = truth.poses[np.searchsorted(truth.pose_t, stamps - 1e-6)]
    residuals = to_map(points, poses) - truth.cones[truth.associations]
    assert np.sqrt((residuals**2).mean()) < 0.3  # 0.63 m is what the file claims
    dead = np.zeros(3)
    for twist in log.odometry.twist:
        dead = compose(dead, integrate_poses(np.array([PERIOD]), twist[None])[-1])
    drift = np.hypot(*(dead - truth.poses[-1])[:2])
    assert 1.0 < drift < 30.0  # dead reckoning is not the reference


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ODOMETRY 0 1 1 0 0\n", "row 1: expected ODOMETRY and 11 numbers or LANDMARK and 7 numbers"),
        ("EDGE 0 1\n", "row 1: expected ODOMETRY"),
        ("ODOMETRY 0 1 a 0 0 1 0 0 1 0 1\n", "row 1: expected numbers after ODOMETRY"),
        (MOVE, "expected rows ODOMETRY and LANDMARK, found none"),
        (f"{MOVE}LANDMARK 7 2 5 1 1 0 1\n", "LANDMARK to begin with a pose"),
        (f"{MOVE}ODOMETRY 3 4 1 0 0 1 0 0 1 0 1\nLANDMARK 1 2 5 1 1 0 1\n", "to begin at the pose where"),
    ],
)  # fmt: skip
def test_a_file_of_another_kind_is_refused(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "park.txt"
    file.write_text(text)
    assert main(["convert", str(file), "--from", "victoria-park", "--out", str(tmp_path / "log")]) == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.count("\n") == 1
    assert not (tmp_path / "log").exists()
