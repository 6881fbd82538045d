"""The manifest of a folder: size and SHA-256 of each file as it was written, which `verify` checks."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pathspace_graph.errors import InputError

from .parsing import read_json, typed

FORMAT: Final = "pathspace-manifest/1"
MANIFEST_FILE: Final = "manifest.json"


def manifest_of(folder: Path) -> str:
    """Manifest of a folder: of its files but hidden ones, and of manifests of subfolders."""
    files = {file.relative_to(folder).as_posix(): _entry(file) for file in sorted(_files(folder))}
    return json.dumps({"format": FORMAT, "files": files}, indent=1) + "\n"


def _files(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.name.startswith(".") or path.name == MANIFEST_FILE or path.is_symlink():
            continue
        if path.is_dir():
            inner = path / MANIFEST_FILE
            yield from [inner] if inner.is_file() else _files(path)
        elif path.is_file():
            yield path


def _entry(file: Path) -> dict[str, Any]:
    with file.open("rb") as stream:
        return {"size": file.stat().st_size, "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}


def verify_all(folder: Path) -> int:
    """Verify every listed file, also by the manifests of subfolders, and return their number."""
    manifest = folder / MANIFEST_FILE
    if not manifest.is_file():
        raise InputError(folder, f"expected a folder with a manifest ({MANIFEST_FILE}), found none")
    content = typed(read_json(manifest, "a manifest"), dict[str, Any], manifest)
    if content.get("format") != FORMAT:
        raise InputError(manifest, f'expected format = "{FORMAT}"')
    listed = typed(content.get("files"), dict[str, dict[str, Any]], manifest, "files")
    count = len(listed)
    for name, entry in listed.items():
        file = folder / name
        if not file.is_file():
            raise InputError(file, "expected a file that the manifest lists, found none")
        try:
            is_same = entry == _entry(file)
        except OSError as error:
            raise InputError(file, f"expected a readable file: {error.strerror}") from error
        if not is_same:
            raise InputError(
                file, f"expected the file as it was written ({MANIFEST_FILE}), found another one"
            )
        if file.name == MANIFEST_FILE:
            count += verify_all(file.parent)
    return count
