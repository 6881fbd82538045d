"""Tables whose first row says how many fields there are: no field beyond them is dropped in silence."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.io.tables import read_trajectory

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
