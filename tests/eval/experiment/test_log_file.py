"""Logs of a study on disk: exact, with empty cycles, and data only."""

from __future__ import annotations

import hashlib
import io
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.eval.experiment.drives import read_log_file, write_log_file
from pathspace_graph.io.log import Detections

from ...io.test_log import assert_same, small_log


def empty_cycle(t: float) -> Detections:
    return Detections(t, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int))


@pytest.mark.parametrize("truth", [True, False])
def test_a_log_comes_back_exactly_with_its_empty_cycles(truth: bool, tmp_path: Path) -> None:
    log = small_log()
    first, *rest = log.cycles
    log = replace(log, cycles=(empty_cycle(-0.1), first, empty_cycle(0.05), *rest, empty_cycle(0.3)))
    log = log if truth else replace(log, truth=None)
    write_log_file(tmp_path / "a.log", log)
    assert_same(read_log_file(tmp_path / "a.log"), log)


def test_a_log_without_cycles_comes_back(tmp_path: Path) -> None:
    log = replace(small_log(), cycles=(), truth=None)
    write_log_file(tmp_path / "a.log", log)
    assert_same(read_log_file(tmp_path / "a.log"), log)


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]


def test_a_damaged_log_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.log"
    write_log_file(file, small_log())
    good = file.read_bytes()
    for at in np.random.default_rng(0).integers(len(good), size=300):
        file.write_bytes(flipped(good, int(at)))
        with pytest.raises(InputError, match="not as it was written"):
            read_log_file(file)


def test_a_pickle_is_never_run(tmp_path: Path) -> None:
    file = tmp_path / "a.log"
    archive = io.BytesIO()
    np.savez(archive, odometry_t=np.array([{}], dtype=object))
    for content in (pickle.dumps(small_log()), b"", archive.getvalue()):
        file.write_bytes(hashlib.sha256(content).digest() + content)
        with pytest.raises(InputError, match="expected the log of a study"):
            read_log_file(file)
