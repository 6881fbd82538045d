"""Kills: a process dies before one of its steps on the disk."""

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

STEPS = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate"}
"""Audit events of changes of the disk, beside `open`."""


class Recorder:
    """Keeps, for each step of a process, what a folder would be after a kill before it."""

    def __init__(self, root: Path, cuts: Path) -> None:
        self._root, self._cuts, self._steps = root, cuts, 0
        self._is_recording = False

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if self._is_recording or not self._is_step(event, arguments):
            return
        self._is_recording = True
        self._steps += 1
        shutil.copytree(self._root, self._cuts / str(self._steps))
        self._is_recording = False

    def _is_step(self, event: str, arguments: tuple[object, ...]) -> bool:
        if event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            return bool(writes) and str(path).startswith(str(self._root))
        return event in STEPS


def kills(work: Callable[[], object], root: Path) -> Iterator[bool]:
    """Leave a folder as a kill before each step of the work does, then, with False, as all of it does.

    The work is done once, in a process of its own.
    """
    cuts = root.with_name(f"{root.name}-cuts")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork where there are threads
        child = os.fork()
    if child == 0:
        sys.addaudithook(Recorder(root, cuts))
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


def content_of(path: Path) -> Contents:
    return contents(path) if path.is_dir() else {"": path.read_bytes()}
