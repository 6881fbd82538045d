"""Temporary files: those of dead runs are removed, those of living ones are not."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

import pytest

from pathspace_graph.errors import OutputError
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


def test_results_are_kept_where_there_are_no_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "link", refuse)
    for text in "123":
        with atomic_file(tmp_path / "f.txt") as file:
            file.write_text(text)
    assert [(tmp_path / f"f.txt{end}").read_text() for end in ("", ".~1~", ".~2~")] == ["3", "1", "2"]


def test_a_folder_that_cannot_be_put_in_place_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with atomic_folder(tmp_path / "out", "marker") as folder:
        (folder / "marker").write_text("1")
    rename = Path.rename

    def fail(path: Path, target: Path) -> Path:
        return refuse() if ".tmp" in path.name else rename(path, target)

    with pytest.raises(OutputError, match="Permission denied"), atomic_folder(tmp_path / "out", "marker"):
        monkeypatch.setattr(Path, "rename", fail)
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "marker").read_text() == "1"


def refuse(*_: object, **__: object) -> NoReturn:
    raise PermissionError(13, "Permission denied")
