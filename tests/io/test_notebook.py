"""What a notebook shows: short texts, pictures and frames; and the notebook of the pages, cell by cell."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from pathspace_graph import LEFT, RIGHT, FixedLagMapper, Log, Map, RunResult, SettingsError, run_online
from pathspace_graph.io.brief import brief

from ..scenes.drives import short_drive

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebook.ipynb"
LONGEST = 400
"""Most characters of a record's text."""


@cache
def drive() -> tuple[Log, RunResult]:
    log = short_drive()
    return log, run_online(log, FixedLagMapper(None, log.odometry_sigma))


def test_records_have_short_texts_that_say_what_they_hold() -> None:
    log, result = drive()
    for record in (log, log.truth, result, result.map, result.map.left, result.vehicle):
        assert len(repr(record)) < LONGEST
    assert f"{len(log.cycles)} cycles" in repr(log)
    assert f"left: {result.map.left.size} control points" in repr(result.map)
    assert repr(result.map) in repr(result)
    assert brief(np.zeros((4, 2))) == "array (4, 2)" and brief(np.zeros(2)) == "array([0., 0.])"


def test_a_boundary_is_found_by_side_label_and_name() -> None:
    _, result = drive()
    track = result.map
    assert track.left is track.boundaries[LEFT] is track.boundaries["left"]
    assert track.right is track.boundaries[RIGHT] is track.boundaries["right"]
    assert list(track.boundaries) == [LEFT, RIGHT] and "left" in track.boundaries
    with pytest.raises(KeyError):
        track.boundaries["middle"]
    with pytest.raises(SettingsError, match=r"map\.right: expected a mapped boundary, found none"):
        Map(False, {LEFT: track.left}).right  # noqa: B018 - the access is the test


def test_a_run_is_a_frame_with_a_row_for_each_cycle() -> None:
    _, result = drive()
    frame = result.to_frame()
    assert len(frame) == len(result.cycles)
    np.testing.assert_array_equal(frame[["x", "y", "theta"]].to_numpy(), result.trajectory)
    np.testing.assert_array_equal(frame["readings"], [record.readings for record in result.cycles])


def test_records_are_drawn() -> None:
    log, result = drive()
    for picture in (log.plot(), result.map.plot(), result.plot()):
        assert len(picture.axes[0].lines) > 2
        assert picture._repr_png_()[:8] == b"\x89PNG\r\n\x1a\n"  # type: ignore[attr-defined]
    assert plt.get_fignums() == []


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not NOTEBOOK.exists():
        pytest.skip("there are no pages beside an installed package")
    monkeypatch.chdir(tmp_path)
    content = json.loads(NOTEBOOK.read_text())
    cells = ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]
    assert not any(cell.get("outputs") for cell in content["cells"])
    names: dict[str, Any] = {}
    for cell in cells:
        exec(compile(cell, NOTEBOOK.name, "exec"), names)  # the notebook is ours
    assert names["result"].map.closed
    assert len(names["growing"]) > 3
