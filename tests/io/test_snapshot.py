"""The file of a snapshot: what was written is read, and anything else is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.io.snapshot import read_snapshot, write_snapshot

from ..scenes.kills import dies

STRUCTURE = {"root": [0], "text": "ä\n", "numbers": [1, -0.0, 5e-324, 1.7976931348623157e308]}


@pytest.mark.parametrize("data", [b"", b"\n", b"\0\xff\n" * 5])
def test_what_was_written_is_read(data: bytes, tmp_path: Path) -> None:
    write_snapshot(tmp_path / "a.snap", STRUCTURE, data)
    assert read_snapshot(tmp_path / "a.snap") == (STRUCTURE, data)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.snap", tmp_path):
        with pytest.raises(InputError, match="expected a snapshot, found"):
            read_snapshot(path)


def test_every_flipped_bit_and_every_cut_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.snap"
    write_snapshot(file, STRUCTURE, b"\0\1\2")
    good = file.read_bytes()
    for at in range(len(good)):
        for damaged in (good[:at], good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :]):
            file.write_bytes(damaged)
            with pytest.raises(InputError, match=r"a\.snap: expected") as caught:
                read_snapshot(file)
            assert "\n" not in str(caught.value)
    file.write_bytes(good + b"\0")
    with pytest.raises(InputError, match="another content"):
        read_snapshot(file)


def test_a_number_that_json_does_not_have_is_no_structure(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Out of range float"):
        write_snapshot(tmp_path / "a.snap", [float("nan")], b"")
    assert not [*tmp_path.iterdir()]


def test_a_kill_at_any_step_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    file, step, kills = tmp_path / "a.snap", 0, 0
    write_snapshot(file, "old", b"1")
    old = file.read_bytes()
    killed = True
    while killed:
        step += 1
        killed = dies(lambda: write_snapshot(file, "new", b"2"), tmp_path, step)
        kills += killed
        assert read_snapshot(file) in (("old", b"1"), ("new", b"2"))
        for backup in tmp_path.glob("a.snap.~*"):
            assert read_snapshot(backup)
            backup.unlink()
        file.write_bytes(old)
    assert kills > 3
    write_snapshot(file, "new", b"2")
    assert {path.name for path in tmp_path.iterdir()} == {"a.snap", "a.snap.~1~"}
