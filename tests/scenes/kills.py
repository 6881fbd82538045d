"""Kills: a process dies before one of its steps on the disk, and what was not flushed by then is lost."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

from pathspace_graph.io.files import RENAME, SYNC

from .pretenders import contents

Contents = dict[str, bytes]

STEPS = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate", SYNC, RENAME}
"""Python announces a change of the disk by one of these audit events, or by `open`."""
DIED, COMPLETED, RAISED = 41, 42, 43
"""A child process ends with one of these exit codes."""


class Killer:
    """Ends the process before its step of this number (from 1), as if the power were cut.

    What was written since it began, and not flushed, is empty then.
    """

    def __init__(self, root: Path, at: int) -> None:
        self._root = root
        self._left = at
        self._kept = {file.stat().st_ino for file in root.rglob("*") if file.is_file()}
        self._dead = False

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if self._dead or not self._is_step(event, arguments):
            return
        self._left -= 1
        if self._left == 0:
            self._dead = True
            self._lose()
            os._exit(DIED)
        if event == SYNC:
            self._kept.add(Path(str(arguments[0])).stat().st_ino)

    def _is_step(self, event: str, arguments: tuple[object, ...]) -> bool:
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            return bool(writes) and str(path).startswith(str(self._root))
        return event in STEPS

    def _lose(self) -> None:
        for file in self._root.rglob("*"):
            if file.is_file() and file.stat().st_ino not in self._kept:
                os.truncate(file, 0)


def dies(work: Callable[[], object], root: Path, at: int) -> bool:
    """Whether the work of a child process ends at its step of this number; else it was done in fewer."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork where there are threads
        child = os.fork()
    if child == 0:
        sys.addaudithook(Killer(root, at))
        try:
            work()
        except BaseException:
            traceback.print_exc()
            os._exit(RAISED)
        os._exit(COMPLETED)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (DIED, COMPLETED)
    return code == DIED


def results(folder: Path, name: str) -> list[Contents]:
    """What stands at a target and at its backups, each a folder or a file."""
    found = sorted(path for path in folder.glob(f"{name}*") if path.name == name or "~" in path.name)
    return [content_of(path) for path in found]


def content_of(path: Path) -> Contents:
    return contents(path) if path.is_dir() else {"": path.read_bytes()}


def leftovers(folder: Path) -> list[str]:
    """Temporary files of dead runs."""
    return [path.name for path in folder.rglob(".*") if ".tmp" in path.name]
