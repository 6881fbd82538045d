"""What takes seconds is computed once a session, by the worker and the file that ask for it first."""

from __future__ import annotations

import hashlib
import os
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from typing import Any, TypeVar

T = TypeVar("T")

FOLDER = "PATHSPACE_TEST_SESSION"
"""The variable of the environment that names the folder of the session, which all workers share."""
LONGEST = 600.0
"""A worker that has computed something for so long (s) has died."""

_known: dict[str, Any] = {}


def pickled(value: object, file: Path) -> None:
    file.write_bytes(pickle.dumps(value))


def unpickled(file: Path) -> Any:
    return pickle.loads(file.read_bytes())


def once(
    make: Callable[[], T],
    *key: object,
    write: Callable[[T, Path], None] = pickled,
    read: Callable[[Path], T] = unpickled,
) -> T:
    """Returns what `make` returns, which belongs to a key that can be pickled.

    All tests of a worker get the same object, so none of them may change it. Another worker reads what was
    written. Where `make` raises, the next one tries again.
    """
    name = hashlib.sha256(pickle.dumps(key)).hexdigest()
    file, begun = (Path(os.environ[FOLDER]) / f"{name}{suffix}" for suffix in ("", ".begun"))
    begin = time.monotonic()
    while name not in _known:
        if file.exists():
            _known[name] = read(file)
            break
        try:
            begun.mkdir()
        except FileExistsError:
            assert time.monotonic() < begin + LONGEST, f"expected {file} of another worker"
            time.sleep(0.02)
            continue
        try:
            value = make()
            write(value, begun / "new")
            (begun / "new").replace(file)
            _known[name] = value
        except BaseException:
            rmtree(begun)
            raise
    return _known[name]  # type: ignore[no-any-return]
