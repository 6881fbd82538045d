"""Temporary files and folders beside their place: locked while they are written, removed if the run died."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from . import disk

_TOKEN_BYTES: Final = 4
"""The names of temporary files differ by this number of random bytes."""
_TOKEN: Final = f"[0-9a-f]{{{2 * _TOKEN_BYTES}}}"
"""These bytes match this pattern in the names."""


def is_temporary(name: str) -> bool:
    """Returns whether a file has the name of a temporary one."""
    return re.fullmatch(rf"\..*\.{_TOKEN}\.tmp(\.[^.]*)?", name) is not None


@contextmanager
def beside(final: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Yields a new path beside `final`, made by `make`, and removes it if it is still there at the end.

    It is locked meanwhile, so that another run knows that it is in use. What runs that died have left of the
    same target is removed before.
    """
    remove_leftovers(final)
    path, descriptor = _make_locked(final, make)
    try:
        yield path
    finally:
        _remove(path)
        if descriptor is not None:
            os.close(descriptor)


def _make_locked(final: Path, make: Callable[[Path], None]) -> tuple[Path, int | None]:
    while True:
        # the suffix stays last, as writers choose the format by it
        path = final.with_name(f".{final.stem}.{secrets.token_hex(_TOKEN_BYTES)}.tmp{final.suffix}")
        make(path)
        descriptor = disk.lock(path, wait=True)
        # another run may take it for a leftover in the moment before it is locked
        if descriptor is not None or path.exists():
            return path, descriptor


def remove_leftovers(final: Path) -> None:
    """Removes the temporary files of `final` that no living process has locked."""
    name = re.compile(re.escape(f".{final.stem}.") + _TOKEN + re.escape(f".tmp{final.suffix}"))
    try:
        found = [entry.name for entry in os.scandir(final.parent) if name.fullmatch(entry.name)]
    except OSError:
        return
    for leftover in map(final.with_name, found):
        descriptor = disk.lock(leftover, wait=False)
        if descriptor is not None:
            _remove(leftover)
            os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with suppress(OSError):
        path.unlink(missing_ok=True)
