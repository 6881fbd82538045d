"""The runs that tables are measured over."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.eval.tables.cases import find_tracks, make_cases


def test_cases_are_every_track_with_every_seed() -> None:
    cases = make_cases([Path("a.yaml")], generated=2, seeds=3, laps=5)
    assert len(cases) == 9
    assert len(set(cases)) == 9
    assert [case.name for case in cases[::3]] == ["a", "generated 0", "generated 1"]


def test_tracks_are_found_in_their_folders(tmp_path: Path) -> None:
    for name in ("pacsim/b.yaml", "pacsim/a.yaml", "eufs/c.csv", "eufs/LICENSE.txt", "tum/d.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [track.name for track in find_tracks(tmp_path)] == ["a.yaml", "b.yaml", "c.csv"]
    with pytest.raises(InputError, match="expected track files"):
        find_tracks(tmp_path / "tum")
