"""Kills: a process dies before one of its steps on the disk, and what was not flushed by then is lost."""

from __future__ import annotations

import os
import shutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from .pretenders import contents

Contents = dict[str, bytes]

SYNC = "fsync"
STEPS = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate", SYNC}
"""Audit events of changes of the disk, beside `open`; SYNC is the recorder's."""


class Recorder:
    """Keeps, for each step of a process, what a folder would be if the power were cut before it.

    What was written since it began, and not flushed, is empty then.
    """

    def __init__(self, root: Path, cuts: Path) -> None:
        self._root, self._cuts, self._steps = root, cuts, 0
        self._kept: set[object] = {file.stat().st_ino for file in root.rglob("*") if file.is_file()}
        self._is_recording = False

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if self._is_recording or not self._is_step(event, arguments):
            return
        self._is_recording = True
        self._steps += 1
        shutil.copytree(self._root, self._cuts / str(self._steps), copy_function=self._copy)
        if event == SYNC:
            self._kept.add(arguments[0])
        self._is_recording = False

    def _is_step(self, event: str, arguments: tuple[object, ...]) -> bool:
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            return bool(writes) and str(path).startswith(str(self._root))
        return event in STEPS

    def _copy(self, source: str, target: str) -> None:
        is_flushed = Path(source).stat().st_ino in self._kept
        Path(target).write_bytes(Path(source).read_bytes() if is_flushed else b"")


def kills(work: Callable[[], object], root: Path) -> Iterator[bool]:
    """Leave a folder as a kill before each step of the work does, then, with False, as all of it does.

    The work is done once, in a process of its own, which holds none of its locks any more.
    """
    cuts = root.with_name(f"{root.name}-cuts")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork where there are threads
        child = os.fork()
    if child == 0:
        sys.addaudithook(Recorder(root, cuts))
        os.fsync = lambda descriptor: sys.audit(SYNC, os.fstat(descriptor).st_ino)  # type: ignore[assignment]
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    count = len([*cuts.iterdir()])
    root.rename(cuts / str(count + 1))
    for step in range(1, count + 2):
        shutil.rmtree(root, ignore_errors=True)
        (cuts / str(step)).rename(root)
        yield step <= count


def results(folder: Path, name: str) -> list[Contents]:
    """What stands at a target and at its backups, each a folder or a file."""
    found = sorted(path for path in folder.glob(f"{name}*") if path.name == name or "~" in path.name)
    return [content_of(path) for path in found]


def content_of(path: Path) -> Contents:
    return contents(path) if path.is_dir() else {"": path.read_bytes()}


def leftovers(folder: Path) -> list[str]:
    """Temporary files of dead runs."""
    return [path.name for path in folder.rglob(".*") if ".tmp" in path.name]
