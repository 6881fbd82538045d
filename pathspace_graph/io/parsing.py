"""Text files as plain data: TOML, JSON and YAML within the limits of what is read, and never as code."""

import json
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import yaml

from pathspace_graph.errors import InputError

from .limits import MAX_DEPTH, MAX_FILE_BYTES, check_content, too_deep

_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MERGE: Final = "tag:yaml.org,2002:merge"
_ERRORS: Final = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
"""Errors of the parsers, that of YAML for values that do not fit their tags, such as `2020-99-99`."""


def read_text(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> str:
    """Return the text of a file in UTF-8 of at most `most` bytes; an InputError says what was expected."""
    data = read_bytes(file, expected, most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(file, "expected text in UTF-8", data.count(b"\n", 0, error.start) + 1) from None


def read_bytes(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> bytes:
    """Return the bytes of a file, at most `most`; an InputError says that `expected` was expected."""
    try:
        # a pipe would block where it is opened
        data = _read(file, most + 1) if stat.S_ISREG(file.stat().st_mode) else None
    except FileNotFoundError:
        raise InputError(file, f"expected {expected}, found none") from None
    except OSError as error:
        raise InputError(file, f"expected {expected}, can't be read ({error.strerror})") from None
    if data is None:
        raise InputError(file, f"expected {expected}, found a folder, a device or a pipe")
    if len(data) > most:
        raise InputError(file, f"expected at most {most} bytes, found more")
    return data


def _read(file: Path, most: int) -> bytes:
    with file.open("rb") as stream:
        return stream.read(most)


@contextmanager
def _parsing(file: Path, kind: str) -> Iterator[None]:
    """Turn what a parser raises into an InputError that names the file and, where it is known, the row."""
    try:
        yield
    except RecursionError:
        raise InputError(file, too_deep()) from None
    except json.JSONDecodeError as error:
        raise InputError(file, f"expected {kind} ({error.msg})", error.lineno) from None
    except yaml.MarkedYAMLError as error:
        raise InputError(file, f"expected {kind}: {error.problem}", _row(error.problem_mark)) from None
    except _ERRORS as error:
        line = re.search(r"at line (\d+)", str(error)) if kind == "TOML" else None
        told = " ".join(str(error).split())
        raise InputError(file, f"expected {kind}: {told}", int(line[1]) if line else None) from None


def parse_json(text: str, file: Path) -> Any:
    """Return the content of JSON; an InputError names the file and the row."""
    with _parsing(file, "JSON"):
        content = json.loads(text)
    check_content(content, file)
    return content


def read_json(file: Path, expected: str) -> Any:
    """Return the content of a JSON file; an InputError says that `expected` was expected where it fails."""
    return parse_json(read_text(file, expected), file)


def parse_toml(text: str, file: Path) -> dict[str, Any]:
    """Return the content of TOML; an InputError names the file and, where it is known, the row."""
    with _parsing(file, "TOML"):
        content = tomllib.loads(text)
    check_content(content, file)
    return content


class _Loader(_YAML_LOADER):  # type: ignore[misc]
    """YAML loader of plain values without merge keys, by which a short text can stand for a huge one."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == _MERGE:
                raise yaml.MarkedYAMLError(problem="merge keys are not read", problem_mark=key.start_mark)
        super().flatten_mapping(node)


def parse_yaml(text: str, file: Path) -> Any:
    """Return the content of YAML; an InputError names the file and, where it is known, the row."""
    with _parsing(file, "YAML"):
        _check_depth(text, file)
        content = yaml.load(text, Loader=_Loader)
    check_content(content, file)
    return content


def _check_depth(text: str, file: Path) -> None:
    """Raise an InputError where YAML is nested too deep, which would overflow the stack of its composer."""
    depth = 0
    for event in yaml.parse(text, Loader=_YAML_LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise InputError(file, too_deep(), _row(event.start_mark))


def _row(mark: Any) -> int | None:
    """Return the row (from 1) of a mark, which the parser may not give."""
    return None if mark is None else int(mark.line) + 1
