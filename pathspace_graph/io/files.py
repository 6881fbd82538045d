"""Output that appears as a whole or not at all, and never costs an earlier result."""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from pathspace_graph.errors import OutputError

from . import disk
from .manifest import MANIFEST_FILE, manifest_of
from .temporary import beside, is_temporary


@contextmanager
def atomic_folder(target: Path | str, marker: str) -> Iterator[Path]:
    """Yields a temporary folder beside `target` that takes its place on success and is removed on failure.

    It is given a manifest. An empty folder at `target` is used. An earlier result, known by the file `marker`
    in it, is kept as a numbered backup `NAME.~1~`. Anything else there is an OutputError. At each moment the
    target is the old or the new, also where the process is killed or the power is cut.
    """
    final = Path(target).absolute()
    check_target(final, marker)
    with _parents(final), beside(final, _mkdir) as temporary:
        yield temporary
        check_target(final, marker)
        (temporary / MANIFEST_FILE).write_text(manifest_of(temporary), encoding="utf-8", newline="\n")
        disk.sync_tree(temporary)
        _put_in_place(temporary, final)


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path beside `path`, of the same suffix, that takes its place on success.

    A file that is there already is kept as a numbered backup `NAME.~1~`; on failure nothing is left behind.
    """
    final = Path(path).absolute()
    check_file_target(final)
    with _parents(final), beside(final, _touch) as temporary:
        yield temporary
        check_file_target(final)
        disk.sync(temporary)
        _put_in_place(temporary, final)


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yields a temporary path beside `file` that takes its place on success; no backup is kept."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with beside(file, _touch) as temporary:
        yield temporary
        disk.sync(temporary)
        temporary.replace(file)
        disk.sync(file.parent)


def write_text(file: Path, text: str) -> None:
    """Writes text in UTF-8, whole or not at all; an earlier file is replaced."""
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def to_plain(value: Any) -> Any:
    """Returns the value in the types of strict JSON.

    Arrays and tuples become lists, numpy's scalars become numbers, and paths become texts. JSON has no number
    that is not finite: NaN becomes null, since it is no value, and infinity becomes the text "inf".
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
    """Writes the content as strict JSON, see `to_plain`, and replaces an earlier file."""
    write_text(file, json.dumps(to_plain(content), indent=indent, allow_nan=False) + "\n")


def write_manifest(folder: Path) -> None:
    """Writes the manifest of what a folder holds now."""
    write_text(folder / MANIFEST_FILE, manifest_of(folder))


def remove_manifest(folder: Path) -> None:
    """Removes the manifest of a folder that is about to change, where there is one."""
    (folder / MANIFEST_FILE).unlink(missing_ok=True)


def check_target(target: Path | str, marker: str) -> None:
    """Raises an OutputError where `atomic_folder` would lose something foreign at `target`, or fail."""
    target = Path(target).absolute()
    _check_parents(target)
    if not target.exists() and not target.is_symlink():
        return
    if not target.is_dir():
        raise OutputError(f"{target}: expected a folder to write, found a file")
    try:
        names = [entry.name for entry in target.iterdir() if not is_temporary(entry.name)]
        foreign = bool(names) and not (target / marker).is_file()
    except OSError as error:
        raise OutputError(f"{target}: expected a readable folder: {error.strerror}") from error
    if foreign:
        raise OutputError(
            f"{target}: expected an empty folder or an earlier result, found files but no {marker}"
        )


def check_file_target(path: Path | str) -> None:
    """Raises an OutputError where `atomic_file` could not write `path`."""
    path = Path(path).absolute()
    _check_parents(path)
    if path.is_dir():
        raise OutputError(f"{path}: expected a file to write, found a folder")


def _check_parents(target: Path) -> None:
    for parent in target.parents:
        if parent.is_dir():
            return
        if parent.exists():
            raise OutputError(f"{parent}: expected a folder, found a file")


def _put_in_place(temporary: Path, final: Path) -> None:
    """Moves what was written to its place, and what was there to a numbered backup."""
    try:
        while not disk.rename_new(temporary, final):
            # what is there may go meanwhile, or a folder be filled; then it is tried again
            with suppress(FileNotFoundError):
                if _take_empty_folder(temporary, final) or _swap(temporary, final):
                    break
        disk.sync(final.parent)
    except OSError as error:
        raise OutputError(f"{final}: can't be written: {error.strerror}") from error


def _take_empty_folder(temporary: Path, final: Path) -> bool:
    """Replaces an empty folder in one step; it returns False where something else is there."""
    if final.is_symlink() or not final.is_dir() or any(final.iterdir()):
        return False
    try:
        temporary.rename(final)
    except OSError as error:
        if error.errno != errno.ENOTEMPTY:
            raise
        return False
    return True


def _swap(temporary: Path, final: Path) -> bool:
    """Exchanges the old result for the new one in one step, after which the old one has its backup's name.

    Where the system has no such step there are two, and only the backup is there between them. It returns
    True, since it is done then.
    """
    backup = _rename_to_backup(temporary, final)
    try:
        if disk.exchange(backup, final):
            return True
    except OSError:
        backup.rename(temporary)
        raise
    backup.rename(temporary)
    backup = _rename_to_backup(final, final)
    try:
        temporary.rename(final)
    except OSError:
        backup.rename(final)
        raise
    return True


def _rename_to_backup(path: Path, final: Path) -> Path:
    """Renames to the first free name of a backup of `final`, and returns it."""
    for number in count(1):
        backup = final.with_name(f"{final.name}.~{number}~")
        if not os.path.lexists(backup) and disk.rename_new(path, backup):
            return backup
    raise AssertionError("numbers don't end")


@contextmanager
def _parents(final: Path) -> Iterator[None]:
    """Makes the folders above a path, and on failure removes those that it made and that are still empty."""
    missing = [parent for parent in final.parents if not parent.exists()]
    for parent in reversed(missing):
        _mkdir(parent, exist_ok=True)
    try:
        yield
        for parent in missing:
            disk.sync(parent.parent)
    except BaseException:
        _remove_empty(missing)
        raise


def _mkdir(folder: Path, exist_ok: bool = False) -> None:
    try:
        folder.mkdir(exist_ok=exist_ok)
    except OSError as error:
        raise OutputError(f"{folder}: can't be made: {error.strerror}") from error


def _touch(file: Path) -> None:
    try:
        file.touch(exist_ok=False)
    except OSError as error:
        raise OutputError(f"{file}: can't be made: {error.strerror}") from error


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:
            return
