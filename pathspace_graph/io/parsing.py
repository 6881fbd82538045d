"""Text files as plain data: TOML, JSON and YAML within the limits of what is read, and never as code."""

from __future__ import annotations

import json
import re
import stat
import tomllib
from pathlib import Path
from typing import Any, Final

import yaml

from pathspace_graph.errors import InputError

from .limits import MAX_DEPTH, MAX_FILE_BYTES, check_content, too_deep

_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MERGE: Final = "tag:yaml.org,2002:merge"
_YAML_ERRORS: Final = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
"""The parser of YAML raises these for values that do not fit their tags, such as `2020-99-99`."""


def read_text(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> str:
    """Returns the text of a file in UTF-8 of at most `most` bytes; an InputError says that `expected` was
    expected."""
    data = read_bytes(file, expected, most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(file, "expected text in UTF-8", data.count(b"\n", 0, error.start) + 1) from None


def read_bytes(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> bytes:
    """Returns the bytes of a file, at most `most`; an InputError says that `expected` was expected."""
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


def parse_json(text: str, file: Path) -> Any:
    """Returns the content of JSON; an InputError names the file and the row."""
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(file, f"expected JSON ({error.msg})", error.lineno) from None
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(file, f"expected JSON: {error}") from None
    except RecursionError:
        raise InputError(file, too_deep()) from None
    check_content(content, file)
    return content


def read_json(file: Path, expected: str) -> Any:
    """Returns the content of a JSON file; an InputError says that `expected` was expected where it fails."""
    return parse_json(read_text(file, expected), file)


def parse_toml(text: str, file: Path) -> dict[str, Any]:
    """Returns the content of TOML; an InputError names the file and, where it is known, the row."""
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise InputError(file, too_deep()) from None
    except ValueError as error:
        line = re.search(r"at line (\d+)", str(error))
        raise InputError(file, f"expected TOML: {error}", int(line[1]) if line else None) from None
    check_content(content, file)
    return content


class _Loader(_YAML_LOADER):  # type: ignore[misc]
    """Makes plain values of YAML, but for merge keys, by which a short text can stand for a huge one."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == _MERGE:
                raise yaml.MarkedYAMLError(problem="merge keys are not read", problem_mark=key.start_mark)
        super().flatten_mapping(node)


def parse_yaml(text: str, file: Path) -> Any:
    """Returns the content of YAML; an InputError names the file and, where it is known, the row."""
    try:
        _check_depth(text, file)
        content = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        raise InputError(file, f"expected YAML: {error.problem}", _row(error.problem_mark)) from None
    except _YAML_ERRORS as error:
        raise InputError(file, f"expected YAML: {' '.join(str(error).split())}") from None
    check_content(content, file)
    return content


def _check_depth(text: str, file: Path) -> None:
    """Raises an InputError where YAML is nested too deep, which would overflow the stack of its composer."""
    depth = 0
    for event in yaml.parse(text, Loader=_YAML_LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise InputError(file, too_deep(), _row(event.start_mark))


def _row(mark: Any) -> int | None:
    """Returns the row (from 1) of a mark, which the parser may not give."""
    return None if mark is None else int(mark.line) + 1
