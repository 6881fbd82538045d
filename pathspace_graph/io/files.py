"""Output that appears as a whole or not at all, and never costs an earlier result.

Audit hooks (`sys.addaudithook`) see each step that changes what a path names, and can end the process before.
"""

import ctypes
import errno
import json
import math
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import OutputError

from .manifest import MANIFEST_FILE, manifest_of

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None  # type: ignore[assignment]

STDOUT: Final = Path("-")  # path at which a single file is written to standard output
SYNC: Final = "pathspace_graph.sync"  # audit event before a file or a folder is flushed, with its path
RENAME: Final = "pathspace_graph.rename"  # audit event before a rename with flags, with both paths

_AT_FDCWD: Final = -100  # a relative path is relative to the working folder
_NOREPLACE: Final = 1
_EXCHANGE: Final = 2
_UNSUPPORTED: Final = frozenset({errno.ENOSYS, errno.EINVAL, errno.ENOTSUP})
_TOKEN: Final = "[0-9a-f]{8}"


@contextmanager
def atomic_folder(target: Path | str, marker: str) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that gets a manifest and takes its place on success.

    An earlier result, known by the file `marker`, is kept as a numbered backup `NAME.~1~`; anything else but
    an empty folder is an OutputError. Even where the power is cut, the target is the old or the new.
    """
    final = _followed(target)
    with _placed(final, Path.mkdir, lambda: check_target(final, marker)) as temporary:
        yield temporary
        (temporary / MANIFEST_FILE).write_text(manifest_of(temporary), encoding="utf-8", newline="\n")


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path of the same suffix, whose file takes its place at `path` on success.

    An earlier file is kept as a numbered backup `NAME.~1~`. Symbolic links are followed. Standard output
    (`-`), a device and a pipe are written in place.
    """
    path, final = Path(path), _followed(path)
    if is_stream(path):
        with TemporaryDirectory() as folder:
            temporary = Path(folder, path.name)
            yield temporary
            with _naming(path):
                content = temporary.read_bytes()
                with nullcontext(sys.stdout.buffer) if path == STDOUT else path.open("wb") as stream:
                    stream.write(content)
                    stream.flush()
        return
    with _placed(final, Path.touch, lambda: check_file_target(final)) as temporary:
        yield temporary


def is_stream(path: Path) -> bool:
    """Return whether a path is standard output, a device or a pipe, which can't be replaced."""
    return path == STDOUT or (path.exists() and not path.is_file() and not path.is_dir())


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yield a temporary path beside `file` that takes its place on success; no backup is kept."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with _naming(file), _beside(file, Path.touch) as temporary:
        yield temporary
        sync(temporary)
        temporary.replace(file)
        sync(file.parent)


def write_text(file: Path, text: str) -> None:
    """Write text in UTF-8, whole or not at all; an earlier file is replaced."""
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def to_plain(value: Any) -> Any:
    """Return the value in the types of strict JSON; NaN becomes null, and infinity the text "inf"."""
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_plain(value.tolist())
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None if math.isnan(value) else str(value)
    return str(value) if isinstance(value, Path) else value


def write_json(file: Path, content: Any, indent: int | None = 2) -> None:
    """Write the content as strict JSON, see `to_plain`, and replace an earlier file."""
    write_text(file, json.dumps(to_plain(content), indent=indent, allow_nan=False) + "\n")


def write_manifest(folder: Path) -> None:
    write_text(folder / MANIFEST_FILE, manifest_of(folder))


def remove_manifest(folder: Path) -> None:
    (folder / MANIFEST_FILE).unlink(missing_ok=True)


def check_target(target: Path | str, marker: str) -> None:
    """Raise an OutputError where `atomic_folder` would lose something foreign at `target`, or fail."""
    if Path(target) == STDOUT:
        raise OutputError(f"{STDOUT}: expected a folder to write; only one file goes to standard output")
    target = _followed(target)
    _check_parents(target)
    if not target.exists():
        return
    if not target.is_dir():
        raise OutputError(f"{target}: expected a folder to write, found a file")
    try:
        is_empty = all(is_temporary(entry.name) for entry in target.iterdir())
        if is_empty or (target / marker).is_file():
            return
    except OSError as error:
        raise OutputError(f"{target}: expected a readable folder: {error.strerror}") from error
    raise OutputError(f"{target}: expected an empty folder or an earlier result, found files but no {marker}")


def check_file_target(path: Path | str) -> None:
    """Raise an OutputError where `atomic_file` could not write `path`."""
    if is_stream(Path(path)):
        return
    path = _followed(path)
    _check_parents(path)
    if path.is_dir():
        raise OutputError(f"{path}: expected a file to write, found a folder")


def _followed(path: Path | str) -> Path:
    return Path(os.path.realpath(path))


def _check_parents(target: Path) -> None:
    nearest = next((parent for parent in target.parents if parent.exists()), target)
    if not nearest.is_dir():
        raise OutputError(f"{nearest}: expected a folder, found a file")
    if not os.access(nearest, os.W_OK):
        raise OutputError(f"{nearest}: expected a folder that can be written")


# --- the way to the place ----------------------------------------------------------------------------------


@contextmanager
def _placed(final: Path, make: Callable[[Path], None], check: Callable[[], None]) -> Iterator[Path]:
    """Yield a temporary path that is put in place on success; on failure new folders above are removed."""
    check()
    missing = [parent for parent in final.parents if not parent.exists()]
    with _naming(final):
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            with _beside(final, make) as temporary:
                yield temporary
                check()
                sync_tree(temporary)
                _put_in_place(temporary, final)
            for parent in (final, *missing):
                sync(parent.parent)
        except BaseException:
            for parent in missing:
                with suppress(OSError):
                    parent.rmdir()
            raise


def _put_in_place(temporary: Path, final: Path) -> None:
    if temporary.is_dir():
        with suppress(OSError):
            temporary.rename(final)  # also over an empty folder, but over nothing else
            return
    numbers = count(1)
    while not rename_new(temporary, final):
        backup = final.with_name(f"{final.name}.~{next(numbers)}~")
        if rename_new(temporary, backup):
            try:
                exchange(backup, final, spare=temporary)
                return
            except OSError as error:
                with suppress(FileNotFoundError):
                    backup.rename(temporary)
                if not isinstance(error, FileNotFoundError):  # what is there may go meanwhile
                    raise


@contextmanager
def _naming(final: Path) -> Iterator[None]:
    """Turn an error of the disk, which names a temporary path or none, into one that names the target."""
    try:
        yield
    except OSError as error:
        if any(map(is_temporary, final.parts)):
            raise  # whoever writes the folder around it names that
        named = Path(str(error.filename or final))
        if not any(map(is_temporary, named.parts)) and named not in (final, *final.parents):
            raise  # of a file that is read
        raise OutputError(f"{final}: can't be written: {error.strerror or error}") from error


# --- temporary paths -------------------------------------------------------------------------------------


def is_temporary(name: str) -> bool:
    return re.fullmatch(rf"\..*\.{_TOKEN}\.tmp(\.[^.]*)?", name) is not None


@contextmanager
def _beside(final: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a new path beside `final`, made by `make` and locked, which is gone at the end."""
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


def lock(path: Path, *, wait: bool) -> int | None:
    """Return a descriptor that locks a path until it is closed or the process dies; None without a lock."""
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


# --- single steps ----------------------------------------------------------------------------------------


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
    for inner in (*sorted(path.rglob("*"), reverse=True), path):
        if not inner.is_symlink():
            sync(inner)


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
    """Exchange what two paths name: in one step, or else in three by way of `spare`."""
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
