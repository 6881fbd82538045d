"""The steps that change what a path names: each is one system call, and happens as a whole or not at all.

Python announces most changes of the disk to audit hooks (`sys.addaudithook`). The steps here that it doesn't
know announce themselves in the same way, so that a test can end the process before any of them.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import sys
from pathlib import Path
from typing import Final

SYNC: Final = "pathspace_graph.sync"
"""This audit event is raised before a file or a folder is flushed to the disk, with its path."""
RENAME: Final = "pathspace_graph.rename"
"""This audit event is raised before a rename with flags, with both paths."""

_RENAMEAT2: Final = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
"""Linux has this system call; elsewhere it is None."""
_AT_FDCWD: Final = -100
"""Linux takes a path relative to the working folder where a descriptor has this value."""
_NOREPLACE: Final = 1
"""Linux fails with this flag where the target exists."""
_EXCHANGE: Final = 2
"""Linux exchanges source and target with this flag."""
_UNSUPPORTED: Final = frozenset({errno.ENOSYS, errno.EINVAL, errno.ENOTSUP})
"""The system or the file system does not know the flag where a rename fails with one of these."""


def sync(path: Path) -> None:
    """Waits until the content of a file, or the names in a folder, are on the disk."""
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


def sync_tree(folder: Path) -> None:
    """Waits until every file and folder below `folder`, and the folder itself, are on the disk."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            file = Path(parent, name)
            if not file.is_symlink():
                sync(file)
        sync(Path(parent))


def exchange(first: Path, second: Path) -> bool:
    """Exchanges what two paths name; it returns False, and does nothing, where the system can't."""
    return _rename(first, second, _EXCHANGE)


def rename_new(source: Path, target: Path) -> bool:
    """Renames to a path that names nothing; it returns False, and does nothing, where something is there."""
    try:
        if _rename(source, target, _NOREPLACE):
            return True
    except FileExistsError:
        return False
    if os.path.lexists(target):
        return False
    source.rename(target)
    return True


def _rename(source: Path, target: Path, flag: int) -> bool:
    """Renames with a flag; it returns False where the system or the file system does not know the flag."""
    sys.audit(RENAME, str(source), str(target))
    if _RENAMEAT2 is None:
        return False
    if _RENAMEAT2(_AT_FDCWD, os.fsencode(source), _AT_FDCWD, os.fsencode(target), flag) == 0:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(source), None, str(target))


def lock(path: Path, *, wait: bool) -> int | None:
    """Returns a descriptor that locks a file or a folder until it is closed, or the process dies.

    It returns None where the path is gone, where the file system has no locks, and, unless it is to `wait`,
    where another process holds the lock.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        if os.path.samestat(os.fstat(descriptor), path.lstat()):
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return None
