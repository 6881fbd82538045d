"""Trajectories in the TUM format come back as they were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.io.results import write_trajectory
from pathspace_graph.io.tables import read_trajectory


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
