"""Output that appears as a whole or not at all, and never costs an earlier result."""

import json
import math
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
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


@contextmanager
def atomic_folder(target: Path | str, marker: str) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that gets a manifest and takes its place on success.

    An earlier result, recognized by the file `marker`, is kept as a numbered backup `NAME.~1~`. Anything
    else except an empty folder is an OutputError.
    """
    final = _followed(target)
    check_target(final, marker)
    with _parents(final), _beside(final, Path.mkdir) as temporary:
        yield temporary
        (temporary / MANIFEST_FILE).write_text(manifest_of(temporary), encoding="utf-8", newline="\n")
        check_target(final, marker)
        for path in (*temporary.rglob("*"), temporary):
            _sync(path)
        backup = _backup(final)
        try:
            temporary.rename(final)
        except OSError:
            if backup:
                backup.rename(final)
            raise
        _sync(final.parent)


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
    check_file_target(final)
    with replacing(final, backup=True) as temporary:
        yield temporary


def is_stream(path: Path) -> bool:
    """Whether a path is standard output, a device or a pipe, which can't be replaced."""
    return path == STDOUT or (path.exists() and not path.is_file() and not path.is_dir())


@contextmanager
def replacing(file: Path, *, backup: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `file` that takes its place on success."""
    with _parents(file), _beside(file, Path.touch) as temporary:
        yield temporary
        _sync(temporary)
        if backup:
            check_file_target(file)
            _backup(file)
        temporary.replace(file)
        _sync(file.parent)


def write_text(file: Path, text: str) -> None:
    """Write text in UTF-8, whole or not at all; an earlier file is replaced."""
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def to_plain(value: Any) -> Any:
    """Convert a value to the types of strict JSON; NaN becomes null, and infinity the text "inf"."""
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


# --- checks of the target -------------------------------------------------------------------------------


def check_target(target: Path | str, marker: str) -> None:
    """Raise an OutputError where `atomic_folder` would lose foreign files at `target`, or fail."""
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


def _backup(final: Path) -> Path | None:
    """Back up a path under a numbered name: a folder is renamed, a file is linked."""
    with suppress(OSError):
        final.rmdir()  # an empty folder is no result
    if not os.path.lexists(final):
        return None
    names = (final.with_name(f"{final.name}.~{number}~") for number in count(1))
    backup = next(name for name in names if not os.path.lexists(name))
    if final.is_dir():
        return final.rename(backup)
    try:
        os.link(final, backup, follow_symlinks=False)
    except OSError:  # a file system without hard links
        shutil.copy2(final, backup, follow_symlinks=False)
    return backup


# --- temporary paths ------------------------------------------------------------------------------------


@contextmanager
def _parents(final: Path) -> Iterator[None]:
    """Make the folders above a path, and remove them on failure; errors of the disk name the path."""
    missing = [parent for parent in final.parents if not parent.exists()]
    with _naming(final):
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            yield
        except BaseException:
            for parent in missing:
                with suppress(OSError):
                    parent.rmdir()
            raise
        for parent in missing:
            _sync(parent.parent)


@contextmanager
def _naming(final: Path) -> Iterator[None]:
    """Turn an error of the disk, which names a temporary path or none, into one that names the target."""
    try:
        yield
    except OSError as error:
        if any(map(is_temporary, final.parts)):
            raise  # the enclosing `atomic_folder` names its target
        named = Path(str(error.filename or final))
        if not any(map(is_temporary, named.parts)) and named not in (final, *final.parents):
            raise  # an error of reading
        raise OutputError(f"{final}: can't be written: {error.strerror or error}") from error


def is_temporary(name: str) -> bool:
    return re.fullmatch(r"\..*\.[0-9a-f]{8}\.tmp(\.[^.]*)?", name) is not None


@contextmanager
def _beside(final: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a new path beside `final`, made by `make` and locked, which is gone at the end.

    Unlocked ones, which dead runs left there, are removed as well.
    """
    stem, suffix = re.escape(f".{final.stem}."), re.escape(f".tmp{final.suffix}")
    for path in final.parent.iterdir():
        if fcntl and re.fullmatch(f"{stem}[0-9a-f]{{8}}{suffix}", path.name):
            with suppress(OSError), _locked(path):
                _remove(path)
    # the suffix stays last, as writers choose the format by it
    path = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.tmp{final.suffix}")
    make(path)
    with _locked(path):
        try:
            yield path
        finally:
            _remove(path)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock a path; OSError where another process has locked it. Locks of dead processes end."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError:
        if not path.is_dir():  # some systems can't flush a folder
            raise
