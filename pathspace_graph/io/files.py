"""Output that appears as a whole or not at all, and never costs an earlier result."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pathspace_graph.errors import OutputError


@contextmanager
def atomic_folder(target: Path | str, marker: str) -> Iterator[Path]:
    """Yields a temporary folder beside `target` that takes its place on success and is removed on failure.

    An empty folder at `target` is used. An earlier result, known by the file `marker` in it, is kept as a
    numbered backup `NAME.~1~`. Anything else there is an OutputError.
    """
    final = Path(target).absolute()
    check_target(final, marker)
    made = _make_parents(final)
    temporary = _temporary_sibling(final)
    try:
        _mkdir(temporary)
        yield temporary
        check_target(final, marker)
        _put_in_place(temporary, final)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        _remove_empty(made)
        raise


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path beside `path`, of the same suffix, that takes its place on success.

    A file that is there already is kept as a numbered backup `NAME.~1~`; on failure nothing is left behind.
    """
    final = Path(path).absolute()
    check_file_target(final)
    made = _make_parents(final)
    temporary = _temporary_sibling(final)
    try:
        yield temporary
        check_file_target(final)
        _put_in_place(temporary, final)
    except BaseException:
        temporary.unlink(missing_ok=True)
        _remove_empty(made)
        raise


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yields a temporary path beside `file` that takes its place on success; no backup is kept."""
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary_sibling(file)
    try:
        yield temporary
        temporary.replace(file)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(file: Path, text: str) -> None:
    """Writes text in UTF-8, whole or not at all; an earlier file is replaced."""
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def check_target(target: Path | str, marker: str) -> None:
    """Raises an OutputError where `atomic_folder` would lose something foreign at `target`, or fail."""
    target = Path(target).absolute()
    _check_parents(target)
    if not target.exists() and not target.is_symlink():
        return
    if not target.is_dir():
        raise OutputError(f"{target}: expected a folder to write, found a file")
    try:
        foreign = any(target.iterdir()) and not (target / marker).is_file()
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
    backup: Path | None = None
    try:
        if final.is_dir() and not final.is_symlink() and not any(final.iterdir()):
            final.rmdir()
        elif final.exists() or final.is_symlink():
            backup = final.rename(_free_backup(final))
        temporary.rename(final)
    except OSError as error:
        if backup is not None:
            backup.rename(final)
        raise OutputError(f"{final}: can't be written: {error.strerror}") from error


def _free_backup(path: Path) -> Path:
    number = 1
    while (backup := path.with_name(f"{path.name}.~{number}~")).exists() or backup.is_symlink():
        number += 1
    return backup


def _temporary_sibling(final: Path) -> Path:
    # the suffix stays last, as writers choose the format by it
    return final.with_name(f".{final.stem}.{secrets.token_hex(4)}.tmp{final.suffix}")


def _make_parents(final: Path) -> list[Path]:
    missing = [parent for parent in final.parents if not parent.exists()]
    for parent in reversed(missing):
        _mkdir(parent)
    return missing


def _mkdir(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: can't be made: {error.strerror}") from error


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:
            return
