"""Output that appears as a whole or not at all, and never costs an earlier result by mistake."""

import csv
import ctypes
import json
import math
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pathspace_graph.errors import OutputError

STDOUT: Final = Path("-")  # path at which a single file is written to standard output


@contextmanager
def atomic_folder(target: Path | str, marker: str, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that takes its place on success.

    An earlier result, recognized by the file `marker`, is replaced if `force`, and an OutputError without.
    Anything else except an empty folder is an OutputError.
    """
    final = Path(target).resolve()
    check_target(final, marker, force=force)
    with _beside(final, Path.mkdir) as temporary:
        yield temporary
        check_target(final, marker, force=force)
        with suppress(OSError):
            final.rmdir()  # an empty folder is no result
        if final.exists():
            _exchange(temporary, final)
        else:
            temporary.rename(final)


def _exchange(one: Path, other: Path) -> None:
    """Exchange two folders: on Linux in one step, so that a kill leaves either in its place."""
    with suppress(TypeError, AttributeError):  # other systems have no such call
        at, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
        if not ctypes.CDLL(None).renameat2(at, os.fsencode(one), at, os.fsencode(other), exchange):
            return
    aside = one.with_suffix(".old")
    other.rename(aside)
    one.rename(other)
    aside.rename(one)


@contextmanager
def atomic_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path of the same suffix, whose file takes its place at `path` on success.

    An earlier file is replaced. Symbolic links are followed. Standard output (`-`), a device and a pipe are
    written in place.
    """
    path, final = Path(path), Path(path).resolve()
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
    with _beside(final, Path.touch) as temporary:
        yield temporary
        temporary.replace(final)


def is_stream(path: Path) -> bool:
    """Whether a path is standard output, a device or a pipe, which can't be replaced."""
    return path == STDOUT or (path.exists() and not path.is_file() and not path.is_dir())


def write_text(file: Path, text: str) -> None:
    """Write text in UTF-8, whole or not at all; an earlier file is replaced."""
    with atomic_file(file) as temporary:
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


def write_table(file: Path, names: Collection[str], *values: ArrayLike, delimiter: str = ",") -> None:
    """Write a CSV file of columns (rows,) or (rows, k) below their names, if any; numbers read back equal."""
    columns = [column for value in values for column in np.atleast_2d(np.asarray(value).T).tolist()]
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, delimiter=delimiter, lineterminator="\n")
        writer.writerows([names] if names else [])
        writer.writerows(zip(*columns, strict=True))


# --- checks of the target -------------------------------------------------------------------------------


def check_target(target: Path | str, marker: str, *, force: bool = False) -> None:
    """Raise an OutputError where `atomic_folder` would lose files at `target`, or fail."""
    if Path(target) == STDOUT:
        raise OutputError(f"{STDOUT}: expected a folder to write; only one file goes to standard output")
    target = Path(target).resolve()
    _check_parents(target)
    if not target.exists():
        return
    if not target.is_dir():
        raise OutputError(f"{target}: expected a folder to write, found a file")
    try:
        is_empty = all(is_temporary(entry.name) for entry in target.iterdir())
        is_result = (target / marker).is_file()
    except OSError as error:
        raise OutputError(f"{target}: expected a readable folder: {error.strerror}") from error
    if not is_empty and not is_result:
        raise OutputError(f"{target}: expected an empty folder, found files but no {marker}")
    if is_result and not force:
        raise OutputError(f"{target}: expected no earlier result, found one (--force replaces it)")


def check_file_target(path: Path | str) -> None:
    """Raise an OutputError where `atomic_file` could not write `path`."""
    if is_stream(Path(path)):
        return
    path = Path(path).resolve()
    _check_parents(path)
    if path.is_dir():
        raise OutputError(f"{path}: expected a file to write, found a folder")


def _check_parents(target: Path) -> None:
    nearest = next((parent for parent in target.parents if parent.exists()), target)
    if not nearest.is_dir():
        raise OutputError(f"{nearest}: expected a folder, found a file")
    if not os.access(nearest, os.W_OK):
        raise OutputError(f"{nearest}: expected a folder that can be written")


# --- temporary paths ------------------------------------------------------------------------------------


@contextmanager
def _beside(final: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Yield a new path beside `final`, made by `make`; what is there at the end is removed.

    Folders above are made, and removed on failure. An error of the disk names `final`.
    """
    missing = [parent for parent in final.parents if not parent.exists()]
    # the suffix stays last, as writers choose the format by it
    path = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.tmp{final.suffix}")
    with _naming(final):
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            make(path)
            try:
                yield path
            finally:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)
        except BaseException:
            for parent in missing:
                with suppress(OSError):
                    parent.rmdir()
            raise


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
