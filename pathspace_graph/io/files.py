"""Output that appears as a whole or not at all, and never costs an earlier result."""

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import OutputError

from . import disk
from .manifest import MANIFEST_FILE, manifest_of

STDOUT: Final = Path("-")
"""Path at which a single file is written to standard output."""


@contextmanager
def atomic_folder(target: Path | str, marker: str) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that takes its place on success and is removed on failure.

    It is given a manifest. An empty folder at `target` is used. An earlier result, known by the file `marker`
    in it, is kept as a numbered backup `NAME.~1~`; anything else there is an OutputError. At each moment the
    target is the old or the new, even if the process is killed or the power is cut.
    """
    final = _followed(target)
    with _placed(final, Path.mkdir, lambda: check_target(final, marker)) as temporary:
        yield temporary
        (temporary / MANIFEST_FILE).write_text(manifest_of(temporary), encoding="utf-8", newline="\n")


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path of the same suffix, whose file takes its place at `path` on success.

    A file that is there already is kept as a numbered backup `NAME.~1~`; on failure nothing is left behind.
    Symbolic links are followed. `-` is standard output; it, a device and a pipe are written in place.
    """
    path, final = Path(path), _followed(path)
    if is_stream(path):
        with TemporaryDirectory() as folder:
            temporary = Path(folder, path.name)
            yield temporary
            with _naming(path):
                _copy(temporary, path)
        return
    with _placed(final, Path.touch, lambda: check_file_target(final)) as temporary:
        yield temporary


def is_stream(path: Path) -> bool:
    """Return whether a path is standard output, a device or a pipe, which can't be replaced."""
    return path == STDOUT or (path.exists() and not path.is_file() and not path.is_dir())


def _copy(source: Path, target: Path) -> None:
    content = source.read_bytes()
    with nullcontext(sys.stdout.buffer) if target == STDOUT else target.open("wb") as stream:
        stream.write(content)
        stream.flush()


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yield a temporary path beside `file` that takes its place on success; no backup is kept."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with _naming(file), disk.beside(file, Path.touch) as temporary:
        yield temporary
        disk.sync(temporary)
        temporary.replace(file)
        disk.sync(file.parent)


def write_text(file: Path, text: str) -> None:
    """Write text in UTF-8, whole or not at all; an earlier file is replaced."""
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def to_plain(value: Any) -> Any:
    """Return the value in the types of strict JSON.

    Arrays and tuples become lists, numpy's scalars numbers, and paths texts. NaN becomes null, and infinity
    the text "inf".
    """
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
    """Write the manifest of what a folder holds now."""
    write_text(folder / MANIFEST_FILE, manifest_of(folder))


def remove_manifest(folder: Path) -> None:
    """Remove the manifest of a folder that is about to change, where there is one."""
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
        names = [entry.name for entry in target.iterdir() if not disk.is_temporary(entry.name)]
        foreign = bool(names) and not (target / marker).is_file()
    except OSError as error:
        raise OutputError(f"{target}: expected a readable folder: {error.strerror}") from error
    if foreign:
        expected = "expected an empty folder or an earlier result"
        raise OutputError(f"{target}: {expected}, found files but no {marker}")


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


@contextmanager
def _placed(final: Path, make: Callable[[Path], None], check: Callable[[], None]) -> Iterator[Path]:
    """Yield a temporary path that is flushed to the disk and put in place on success.

    Folders above it are made; on failure those of them are removed that are still empty.
    """
    check()
    missing = [parent for parent in final.parents if not parent.exists()]
    with _naming(final):
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            with disk.beside(final, make) as temporary:
                yield temporary
                check()
                disk.sync_tree(temporary)
                _put_in_place(temporary, final)
            for parent in (final, *missing):
                disk.sync(parent.parent)
        except BaseException:
            for parent in missing:
                with suppress(OSError):
                    parent.rmdir()
            raise


def _put_in_place(temporary: Path, final: Path) -> None:
    """Move what was written to its place, and what was there to a numbered backup."""
    if temporary.is_dir():
        with suppress(OSError):
            temporary.rename(final)  # also over an empty folder, but over nothing else
            return
    numbers = count(1)
    while not disk.rename_new(temporary, final):
        backup = final.with_name(f"{final.name}.~{next(numbers)}~")
        if disk.rename_new(temporary, backup):
            try:
                disk.exchange(backup, final, spare=temporary)
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
        if any(map(disk.is_temporary, final.parts)):
            raise  # whoever writes the folder around it names that
        named = Path(str(error.filename or final))
        if not any(map(disk.is_temporary, named.parts)) and named not in (final, *final.parents):
            raise  # of a file that is read
        raise OutputError(f"{final}: can't be written: {error.strerror or error}") from error
