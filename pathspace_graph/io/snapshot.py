"""A snapshot on disk: a text line that says what it is, its digest, the structure as JSON, and the numbers.

    pathspace-snapshot/1
    SHA-256 of all that follows, in hexadecimal
    number of bytes of the structure
    {the structure, JSON in one line}
    the numbers, as raw bytes

The digest is verified before anything else is read, so a file that was cut or changed anywhere is refused.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from pathspace_graph.errors import InputError

from .files import atomic_file
from .limits import shown
from .parsing import parse_json, read_bytes

FORMAT: Final = "pathspace-snapshot/1"
_FAMILY: Final = FORMAT.partition("/")[0].encode()


def write_snapshot(path: Path | str, structure: Any, data: bytes) -> None:
    """Writes a structure of strict JSON and a block of bytes; an earlier file is kept as a backup."""
    text = json.dumps(structure, allow_nan=False, separators=(",", ":")).encode()
    content = b"%d\n%s\n%s" % (len(text), text, data)
    head = f"{FORMAT}\n{hashlib.sha256(content).hexdigest()}\n"
    with atomic_file(path) as temporary:
        temporary.write_bytes(head.encode() + content)


def read_snapshot(path: Path | str) -> tuple[Any, bytes]:
    """Returns the structure and the block of bytes of a snapshot; an InputError says why it is none."""
    file = Path(path)
    whole = read_bytes(file, "a snapshot")
    name, _, rest = whole.partition(b"\n")
    digest, _, content = rest.partition(b"\n")
    if name != FORMAT.encode():
        found = shown(name.decode(errors="replace")) if name.startswith(_FAMILY) else "another kind of file"
        raise InputError(file, f"expected {FORMAT}, found {found}")
    if digest != hashlib.sha256(content).hexdigest().encode():
        raise InputError(file, "expected the snapshot as it was written, found another content")
    length, _, body = content.partition(b"\n")
    size = int(length) if length.isdigit() and len(length) <= len(str(len(body))) else len(body)
    if body[size : size + 1] != b"\n":
        raise InputError(file, "expected the number of bytes of the structure, found another one")
    try:
        text = body[:size].decode()
    except UnicodeDecodeError:
        raise InputError(file, "expected a structure in UTF-8") from None
    return parse_json(text, file), body[size + 1 :]
