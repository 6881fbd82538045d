"""Steps that change what a path names, each one system call, and temporary paths beside their place.

Python announces most changes of the disk to audit hooks (`sys.addaudithook`). The steps here that it doesn't
know announce themselves in the same way, so that a test can end the process before any of them.
"""

import ctypes
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]

SYNC: Final = "pathspace_graph.sync"
"""Audit event before a file or a folder is flushed to the disk, with its path."""
RENAME: Final = "pathspace_graph.rename"
"""Audit event before a rename with flags, with both paths."""

_AT_FDCWD: Final = -100  # a relative path is relative to the working folder
_NOREPLACE: Final = 1
_EXCHANGE: Final = 2
_UNSUPPORTED: Final = frozenset({errno.ENOSYS, errno.EINVAL, errno.ENOTSUP})
_TOKEN: Final = "[0-9a-f]{8}"


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    sys.audit(SYNC, str(path))
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:  # what may be written need not be readable
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:  # some file systems can't flush a folder
            raise
    finally:
        os.close(descriptor)


def sync_tree(path: Path) -> None:
    """Wait until a file, or a folder with everything below it, is on the disk."""
    for parent, _, names in os.walk(path, topdown=False):
        for file in (Path(parent, name) for name in names):
            if not file.is_symlink():
                sync(file)
        sync(Path(parent))
    if path.is_file():
        sync(path)


def rename_new(source: Path, target: Path) -> bool:
    """Rename to a path that names nothing; return False, and do nothing, where something is there."""
    try:
        if _rename(source, target, _NOREPLACE):
            return True
    except FileExistsError:
        return False
    if os.path.lexists(target):
        return False
    source.rename(target)
    return True


def exchange(first: Path, second: Path, spare: Path) -> None:
    """Exchange what two paths name in one step.

    Where the system has no such step there are three by way of `spare`, and `first` names the old content of
    `second` between the last two.
    """
    if _rename(first, second, _EXCHANGE):
        return
    first.rename(spare)
    second.rename(first)
    try:
        spare.rename(second)
    except OSError:
        first.rename(second)
        raise


@cache
def _renameat2() -> Any:
    """Return the rename with flags of Linux; None elsewhere."""
    return getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None


def _rename(source: Path, target: Path, flag: int) -> bool:
    """Rename with a flag; return False where the system or the file system does not know the flag."""
    sys.audit(RENAME, str(source), str(target))
    rename = _renameat2()
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flag) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(source), None, str(target))


def lock(path: Path, *, wait: bool) -> int | None:
    """Return a descriptor that locks a file or a folder until it is closed, or the process dies.

    None where the path is gone, where the file system has no locks, and, unless it is to `wait`, where
    another process holds the lock.
    """
    if fcntl is None:
        return None
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    with suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        if os.path.samestat(os.fstat(descriptor), path.lstat()):
            return descriptor
    os.close(descriptor)
    return None


# --- temporary paths -------------------------------------------------------------------------------------


def is_temporary(name: str) -> bool:
    """Return whether a file has the name of a temporary one."""
    return re.fullmatch(rf"\..*\.{_TOKEN}\.tmp(\.[^.]*)?", name) is not None


@contextmanager
def beside(final: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a new path beside `final`, made by `make`, and remove it if it is still there at the end.

    It is locked meanwhile, so that another run knows that it is in use. What runs that died have left of the
    same target is removed before.
    """
    remove_leftovers(final)
    descriptor = None
    while descriptor is None:
        # the suffix stays last, as writers choose the format by it
        path = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.tmp{final.suffix}")
        make(path)
        descriptor = lock(path, wait=True)
        if descriptor is None and path.exists():  # no locks here
            break
    try:
        yield path
    finally:
        _remove(path)
        if descriptor is not None:
            os.close(descriptor)


def remove_leftovers(final: Path) -> None:
    """Remove the temporary files of `final` that no living process has locked."""
    name = re.compile(re.escape(f".{final.stem}.") + _TOKEN + re.escape(f".tmp{final.suffix}"))
    with suppress(OSError):
        for leftover in [path for path in final.parent.iterdir() if name.fullmatch(path.name)]:
            descriptor = lock(leftover, wait=False)
            if descriptor is not None:
                _remove(leftover)
                os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)
