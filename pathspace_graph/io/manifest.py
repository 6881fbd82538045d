"""The manifest of a folder: size and SHA-256 of each file as it was written, which `verify` checks."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pathspace_graph.errors import InputError

from .parsing import parse_json, read_text, shown

FORMAT: Final = "pathspace-manifest/1"
MANIFEST_FILE: Final = "manifest.json"
_MARK: Final = "pathspace"  # held more than once, so that a damaged manifest isn't taken for another's
_DIGEST: Final = "pathspace_digest"  # key of the manifest's own SHA-256, taken without this key


def manifest_of(folder: Path) -> str:
    """Return the manifest of a folder: of its files but hidden ones, and of manifests of subfolders."""
    files = {file.relative_to(folder).as_posix(): file for file in sorted(_files(folder))}
    return _text({name: {"size": one.stat().st_size, "sha256": _digest(one)} for name, one in files.items()})


def _files(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        if path.name.startswith(".") or path.name == MANIFEST_FILE or path.is_symlink():
            continue
        if path.is_dir():
            inner = path / MANIFEST_FILE
            yield from [inner] if inner.is_file() else _files(path)
        elif path.is_file():
            yield path


def _text(files: Any) -> str:
    content = {"format": FORMAT, "files": files}
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps(content | {_DIGEST: digest}, indent=1) + "\n"


def read_manifest(folder: Path) -> dict[str, dict[str, Any]] | None:
    """Return size and SHA-256 of listed files by path; None without a manifest of this program."""
    file = folder / MANIFEST_FILE
    if not file.is_file():
        return None
    text = read_text(file, "a manifest")
    content = parse_json(text, file)
    if _MARK not in text:
        return None
    files = content.get("files") if isinstance(content, dict) else None
    # any other byte makes another text
    if not isinstance(files, dict) or text != _text(files):
        raise InputError(file, "expected the manifest as it was written, found another content")
    return files


def verify_all(folder: Path) -> int:
    """Verify every listed file, also by the manifests of subfolders, and return their number."""
    listed = read_manifest(folder)
    if listed is None:
        raise InputError(folder, f"expected a folder with a manifest ({MANIFEST_FILE}), found none")
    count = len(listed)
    for name, entry in listed.items():
        file = folder / name
        if not file.is_file():
            raise InputError(file, "expected a file that the manifest lists, found none")
        _verify_file(file, entry)
        if file.name == MANIFEST_FILE:
            count += verify_all(file.parent)
    return count


def _verify_file(file: Path, entry: Any) -> None:
    try:
        good = entry["size"] == file.stat().st_size and entry["sha256"] == _digest(file)
    except (LookupError, TypeError) as error:
        raise InputError(file, f"expected size and sha256 in the manifest, found {shown(entry)}") from error
    except OSError as error:
        raise InputError(file, f"expected a readable file: {error.strerror}") from error
    if not good:
        expected = f"expected the file as it was written ({MANIFEST_FILE})"
        raise InputError(file, f"{expected}, found another content")


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
