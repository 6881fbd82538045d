"""What fuzzing began with, and what it found: every input is read, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import PathspaceError

from .targets import TARGETS

CORPUS = Path(__file__).with_name("corpus")
INPUTS = sorted(file for file in CORPUS.rglob("*") if file.is_file())
READ = {"good", "quoted", "splines", "points", "eufs", "tum", "pacsim", "fssim"}
"""Inputs of these names are read, all others are refused."""


@pytest.mark.parametrize("file", INPUTS, ids=lambda file: f"{file.parent.name}-{file.name}")
def test_an_input_is_read_or_refused_in_one_line(file: Path, tmp_path: Path) -> None:
    target = TARGETS[file.parent.name]
    if file.name in READ:
        target.run(file.read_bytes(), tmp_path)
        return
    with pytest.raises(PathspaceError) as caught:
        target.run(file.read_bytes(), tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_every_target_has_inputs() -> None:
    assert {file.parent.name for file in INPUTS} == set(TARGETS)
