"""Temporary files: those of dead runs are removed, those of living ones are not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pathspace_graph.errors import OutputError
from pathspace_graph.io import files
from pathspace_graph.io.files import atomic_file, atomic_folder, check_target, is_temporary, write_text

from ..scenes.kills import leftovers


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_a_dead_run_left_is_removed_when_the_same_target_is_written(tmp_path: Path) -> None:
    (tmp_path / ".out.0123abcd.tmp").mkdir()
    (tmp_path / ".out.0123abcd.tmp" / "half").write_text("?")
    (tmp_path / ".plot.0123abcd.tmp.png").write_text("?")
    others = [".other.0123abcd.tmp", ".out.tmp", ".out.0123abcd.tmp.png"]
    for name in others:
        (tmp_path / name).write_text("of another target")
    with atomic_folder(tmp_path / "out", "marker") as folder:
        (folder / "marker").write_text("1")
    with atomic_file(tmp_path / "plot.png") as file:
        file.write_text("1")
    assert names(tmp_path) == sorted([*others, "out", "plot.png"])


def test_two_runs_beside_each_other_do_not_harm_one_another(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "out", "marker") as first:
        (first / "marker").write_text("1")
        with atomic_folder(tmp_path / "out", "marker") as second:
            (second / "marker").write_text("2")
        assert (first / "marker").read_text() == "1"
    assert (tmp_path / "out" / "marker").read_text() == "1"
    assert (tmp_path / "out.~1~" / "marker").read_text() == "2"


def test_a_living_process_keeps_what_it_has_locked(tmp_path: Path) -> None:
    read, write = os.pipe()
    done_read, done_write = os.pipe()
    child = os.fork()
    if child == 0:
        with atomic_file(tmp_path / "f.txt") as file:
            file.write_text("child")
            os.write(write, b"x")
            os.read(done_read, 1)
        os._exit(0)
    os.read(read, 1)
    write_text(tmp_path / "f.txt", "parent")
    assert len(leftovers(tmp_path)) == 1
    os.write(done_write, b"x")
    assert os.waitpid(child, 0)[1] == 0
    assert names(tmp_path) == ["f.txt", "f.txt.~1~"]
    assert (tmp_path / "f.txt").read_text() == "child"
    for descriptor in (read, write, done_read, done_write):
        os.close(descriptor)


def test_a_folder_with_leftovers_only_is_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / ".study.0123abcd.tmp.json").write_text("{")
    check_target(tmp_path, "study.json")
    assert not is_temporary(".study.json") and not is_temporary("study.0123abcd.tmp.json")


@pytest.mark.parametrize("has_exchange", [True, False])
def test_an_exchange_is_one_step_or_goes_by_way_of_a_spare_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_exchange: bool
) -> None:
    if not has_exchange:
        monkeypatch.setattr(files, "_renameat2", lambda: None)
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    files.exchange(tmp_path / "a", tmp_path / "b", tmp_path / "spare")
    assert (tmp_path / "a" / "file").read_text() == "b"
    assert (tmp_path / "b" / "file").read_text() == "a"
    assert not files.rename_new(tmp_path / "a", tmp_path / "b")
    assert files.rename_new(tmp_path / "a", tmp_path / "c")
    assert names(tmp_path) == ["b", "c"]


def test_results_are_kept_where_the_system_can_not_exchange(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_renameat2", lambda: None)
    for text in "123":
        with atomic_folder(tmp_path / "out", "marker") as folder:
            (folder / "marker").write_text(text)
        with atomic_file(tmp_path / "f.txt") as file:
            file.write_text(text)
    assert names(tmp_path) == ["f.txt", "f.txt.~1~", "f.txt.~2~", "out", "out.~1~", "out.~2~"]
    assert [(tmp_path / f"out{end}" / "marker").read_text() for end in ("", ".~1~", ".~2~")] == [
        "3",
        "1",
        "2",
    ]


def test_a_failed_exchange_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    write_text(tmp_path / "f.txt", "1")
    monkeypatch.setattr(files, "exchange", fail)
    with pytest.raises(OutputError, match="Permission denied"), atomic_file(tmp_path / "f.txt") as file:
        file.write_text("2")
    assert names(tmp_path) == ["f.txt"]
    assert (tmp_path / "f.txt").read_text() == "1"


def test_locks_hold_until_they_are_closed_and_know_what_is_gone(tmp_path: Path) -> None:
    file = tmp_path / "f"
    file.touch()
    held = files.lock(file, wait=True)
    assert held is not None
    assert files.lock(file, wait=False) is None
    os.close(held)
    again = files.lock(file, wait=False)
    assert again is not None
    os.close(again)
    assert files.lock(tmp_path / "none", wait=True) is None
