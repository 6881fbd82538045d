"""Output appears as a whole or not at all, and costs nothing that was there by mistake."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import OutputError
from pathspace_graph.io.files import (
    atomic_file,
    atomic_folder,
    check_file_target,
    check_target,
    is_temporary,
    write_json,
)
from pathspace_graph.io.parsing import read_json


def write_result(target: Path, text: str, *, force: bool = False) -> None:
    with atomic_folder(target, "marker", force=force) as folder:
        (folder / "marker").write_text(text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("system", ["Linux", "other"])
def test_an_earlier_result_is_refused_or_replaced_by_force(
    system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if system == "other":
        monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    write_result(tmp_path / "out", "1")
    (tmp_path / "out" / "old").write_text("of the first")
    with pytest.raises(OutputError, match=r"out: expected no earlier result, found one \(--force"):
        write_result(tmp_path / "out", "2")
    assert (tmp_path / "out" / "marker").read_text() == "1"
    write_result(tmp_path / "out", "2", force=True)
    assert names(tmp_path) == ["out"]
    assert names(tmp_path / "out") == ["marker"]
    assert (tmp_path / "out" / "marker").read_text() == "2"


def test_foreign_things_are_refused_and_kept(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thing").write_text("mine")
    for target in ("file", "foreign", "file/below"):
        with pytest.raises(OutputError, match="expected"):
            check_target(tmp_path / target, "marker")
        with pytest.raises(OutputError):
            write_result(tmp_path / target, "1", force=True)
    assert names(tmp_path) == ["file", "foreign"]
    assert names(tmp_path / "foreign") == ["thing"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failure_leaves_nothing_and_keeps_the_earlier_result(
    tmp_path: Path, error: type[BaseException]
) -> None:
    write_result(tmp_path / "out", "1")
    for target in (tmp_path / "out", tmp_path / "new" / "deep"):
        with pytest.raises(error), atomic_folder(target, "marker", force=True) as folder:
            (folder / "half").write_text("?")
            raise error
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "marker").read_text() == "1"


def test_what_appears_meanwhile_is_not_lost(tmp_path: Path) -> None:
    with pytest.raises(OutputError), atomic_folder(tmp_path / "out", "marker") as folder:
        (folder / "marker").write_text("1")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "foreign").write_text("mine")
    assert names(tmp_path) == ["out"]
    assert names(tmp_path / "out") == ["foreign"]


def test_single_file(tmp_path: Path) -> None:
    for text in "12":
        with atomic_file(tmp_path / "deep" / "plot.png") as path:
            assert path.suffix == ".png"
            path.write_text(text)
    assert (tmp_path / "deep" / "plot.png").read_text() == "2"
    assert names(tmp_path / "deep") == ["plot.png"]
    with pytest.raises(OutputError, match="found a folder"):
        check_file_target(tmp_path / "deep")


# --- what is not a regular file ----------------------------------------------------------------------------


def test_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for name in ("file", "folder", "new"):
        (tmp_path / name).symlink_to(tmp_path / "there" / name)
    write_result(tmp_path / "there" / "folder", "1")
    (tmp_path / "there" / "file").write_text("1")
    write_result(tmp_path / "folder", "2", force=True)
    for name in ("file", "new"):
        with atomic_file(tmp_path / name) as path:
            path.write_text("2")
    assert all((tmp_path / name).is_symlink() for name in ("file", "folder", "new"))
    assert names(tmp_path) == ["file", "folder", "new", "there"]
    assert names(tmp_path / "there") == ["file", "folder", "new"]
    assert (tmp_path / "folder" / "marker").read_text() == (tmp_path / "file").read_text() == "2"


def test_a_pipe_is_written_in_place(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.txt")
    reader = os.open(tmp_path / "pipe.txt", os.O_RDONLY | os.O_NONBLOCK)
    with atomic_file(tmp_path / "pipe.txt") as path:
        assert path.suffix == ".txt"
        path.write_text("through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert names(tmp_path) == ["pipe.txt"] and (tmp_path / "pipe.txt").is_fifo()


def test_a_minus_is_standard_output(tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    with atomic_file("-") as path:
        path.write_bytes(b"\x00\xff")
    assert capfdbinary.readouterr().out == b"\x00\xff"
    with pytest.raises(OutputError, match="only one file goes to standard output"):
        check_target("-", "marker")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_device_is_named() -> None:
    message = r"^/dev/full: can't be written: No space left on device$"
    with pytest.raises(OutputError, match=message), atomic_file("/dev/full") as path:
        path.write_text("much")


FULL = """
import resource, signal, sys
from pathlib import Path
from pathspace_graph.errors import OutputError
from pathspace_graph.io.files import atomic_file, atomic_folder, write_text

resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
write = {"file": atomic_file, "folder": lambda target: atomic_folder(target, "marker")}
for name in ("file", "folder", "text", "nested"):
    target = Path(sys.argv[1], name)
    try:
        if name == "text":
            write_text(target, 2000 * "x")
        elif name == "nested":
            with atomic_folder(target, "marker") as temporary:
                write_text(temporary / "marker", 2000 * "x")
        else:
            with write[name](target) as temporary:
                (temporary if name == "file" else temporary / "marker").write_text(2000 * "x")
    except OutputError as error:
        print(error)
"""


def test_a_full_disk_names_the_file_and_leaves_nothing(tmp_path: Path) -> None:
    run = subprocess.run([sys.executable, "-c", FULL, tmp_path], capture_output=True, text=True, check=True)
    for line, name in zip(run.stdout.splitlines(), ("file", "folder", "text", "nested"), strict=True):
        assert line == f"{tmp_path / name}: can't be written: File too large"
    assert names(tmp_path) == []


def test_an_error_of_reading_meanwhile_is_not_one_of_writing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_file(tmp_path / "out.txt") as path:
        path.write_text((tmp_path / "none.txt").read_text())
    assert names(tmp_path) == []


TERMINATED = """
import sys, time
from pathlib import Path
from pathspace_graph import cli
from pathspace_graph.io.files import atomic_file, atomic_folder

def work(*_):
    with atomic_folder(Path(sys.argv[1], "new", "out"), "marker"), atomic_file(Path(sys.argv[1], "f")):
        print("ready", flush=True)
        time.sleep(60.0)

cli.parse = work
sys.exit(cli.main())
"""


def test_nothing_hidden_stays_where_a_command_is_terminated(tmp_path: Path) -> None:
    command = [sys.executable, "-c", TERMINATED, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        assert len(names(tmp_path)) == 2
        process.terminate()
    assert process.returncode == 143
    assert names(tmp_path) == []


# --- JSON ------------------------------------------------------------------------------------------------


def test_two_runs_beside_each_other_do_not_harm_one_another(tmp_path: Path) -> None:
    with atomic_file(tmp_path / "f.txt") as first:
        first.write_text("1")
        with atomic_file(tmp_path / "f.txt") as second:
            second.write_text("2")
        assert (tmp_path / "f.txt").read_text() == "2"
    assert (tmp_path / "f.txt").read_text() == "1"
    with pytest.raises(OutputError, match="--force"), atomic_folder(tmp_path / "out", "marker") as folder:
        (folder / "marker").write_text("1")
        write_result(tmp_path / "out", "2")
    assert (tmp_path / "out" / "marker").read_text() == "2"
    assert names(tmp_path) == ["f.txt", "out"]


def test_a_folder_with_leftovers_only_is_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / ".study.0123abcd.tmp.json").write_text("{")
    check_target(tmp_path, "study.json")
    assert not is_temporary(".study.json") and not is_temporary("study.0123abcd.tmp.json")


def test_a_folder_that_cannot_be_written_is_refused_beforehand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(OutputError, match="expected a folder that can be written"):
        check_target(tmp_path / "new" / "map", "map.json")


def test_what_json_lacks_is_written_as_plain_values(tmp_path: Path) -> None:
    content = [
        np.nan,
        np.inf,
        {4: -np.inf},
        np.array([[np.nan, 1.5]]),
        (np.int64(3), np.bool_(True)),
        Path("a/b"),
    ]
    write_json(tmp_path / "f.json", content)
    assert read_json(tmp_path / "f.json", "a list") == [
        None,
        "inf",
        {"4": "-inf"},
        [[None, 1.5]],
        [3, True],
        "a/b",
    ]
