"""A flipped byte in any file that is written is read or refused by the readers.

`FLIPS=3000 pytest tests/io/test_flipped_bytes.py` does it more often.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.eval.experiment.run import make_plan
from pathspace_graph.eval.experiment.runner import read_record, write_record
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.frames import read_cycles
from pathspace_graph.io.log import FILES
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import write_result
from pathspace_graph.io.tables import read_trajectory

from ..scenes.pretenders import write_round_track
from .test_log import small_log
from .test_results import result

FLIPS = int(os.environ.get("FLIPS", "300"))
"""Each file has this number of flipped bytes, one at a time."""

READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    **dict.fromkeys(FILES, ("log", read_log)),
    "map.json": ("map", read_map),
    "trajectory.tum": ("map", lambda folder: read_trajectory(folder / "trajectory.tum")),
    "cycles.csv": ("map", read_cycles),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_log(small_log(), folder / "log")
    write_result(folder / "map", result(), {"estimator": "fixed-lag", "laps": [{"lap": 1, "rmse": 0.5}]})
    return folder


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """The same bytes but one."""
    at, mask = int(rng.integers(len(data))), int(rng.integers(1, 256))
    return data[:at] + bytes([data[at] ^ mask]) + data[at + 1 :]


def refused(file: Path, read: Callable[[Path], object]) -> int:
    """How many of the flips are refused with the file's name."""
    good, rng, count = file.read_bytes(), np.random.default_rng(0), 0
    for _ in range(FLIPS):
        file.write_bytes(flipped(good, rng))
        try:
            read(file.parent)
        except InputError as error:
            count += error.file == file
            assert "\n" not in str(error)
    file.write_bytes(good)
    read(file.parent)
    return count


@pytest.mark.parametrize("name", READERS)
def test_in_a_file_of_a_log_or_a_map(name: str, written: Path) -> None:
    folder, read = READERS[name]
    refused(written / folder / name, read)


def test_in_a_cell_of_a_study(tmp_path: Path) -> None:
    """A damaged cell is run again."""
    cell = make_plan(Study(tracks=(write_round_track(tmp_path),))).cells[0]
    record = cell.failed(ValueError("lost")) | {"rows": [{"lap": 1, "rmse": 0.123456}]}
    write_record(tmp_path, cell, record)
    assert read_record(tmp_path, cell) == record
    (file,) = (tmp_path / "cells").iterdir()
    good, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(FLIPS):
        file.write_bytes(flipped(good, rng))
        found = read_record(tmp_path, cell)
        assert found is None or found == record  # another blank between two values is no other content
    file.write_text("[]")
    assert read_record(tmp_path, cell) is None


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("log.toml", r"log\.toml"),
        ("odometry.csv", r"odometry\.csv, row \d+: expected 4 fields"),
        ("detections.csv", r"detections\.csv, row \d+: expected 7 fields"),
        ("truth_associations.csv", r"truth_associations\.csv: expected a row for each of 9 detections"),
    ],
)
def test_a_log_that_was_half_written_is_told_by_what_is_in_it(name: str, said: str, tmp_path: Path) -> None:
    write_log(small_log(), tmp_path / "log")
    file = tmp_path / "log" / name
    file.write_text(file.read_text()[: len(file.read_text()) * 6 // 10])
    with pytest.raises(InputError, match=said):
        read_log(tmp_path / "log")
