"""TOML, JSON and YAML as plain data, never as code, within limits beyond which a file is refused.

The limits are generous: they guard against damage and mistakes. What a certain vehicle can do is a setting of
its estimator.
"""

import json
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from reprlib import Repr
from typing import Any, Final

import yaml

from pathspace_graph.errors import InputError

MAX_FILE_BYTES: Final = 2**30
MAX_HEADER_BYTES: Final = 2**22  # also of a study
MAX_TRACK_BYTES: Final = 2**23
MAX_DEPTH: Final = 32  # of lists and tables in each other
MAX_INTEGER: Final = 2**63 - 1
MAX_VARIANTS: Final = 10_000  # of a study's grid

MAX_STAMP: Final = 1e10  # s: 300 years; stamps in milliseconds or nanoseconds are beyond it
MAX_SPEED: Final = 1e3  # m/s
MAX_YAW_RATE: Final = 1e3  # rad/s
MAX_HELD: Final = 1e3  # m, moved by a twist until the next row
MAX_DRIVE: Final = 1e6  # m
MAX_RANGE: Final = 1e4  # m, each coordinate of a detection
MAX_DETECTIONS: Final = 10_000  # of one perception cycle
MAX_COORDINATE: Final = 1e8  # m, of a map, a trajectory or a track; any geodetic grid has room in it
MAX_DEGREE: Final = 20
MAX_ANGLE: Final = 1e6  # rad, of a heading that was not wrapped
MAX_NOISE: Final = 1e6  # a number in a log's header, in its own unit
MAX_TRACK_LENGTH: Final = 3e4  # m; rows are matched in a time that grows with its square
MAX_TRACK_WIDTH: Final = 100.0  # m, from the middle of a track to a boundary
MAX_CONES: Final = 6_000  # of each boundary of a track
SHOWN_CHARACTERS: Final = 120  # of what was found, in a message


def _short() -> Repr:
    short = Repr()
    short.maxlevel, short.maxstring, short.maxother, short.maxlong = 3, 80, 60, 40
    return short


_SHORT: Final = _short()


def shown(value: Any) -> str:
    """Return a value as a message shows it: short, whatever it holds."""
    text = _SHORT.repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."


def check_content(content: Any, file: Path) -> None:
    """Raise an InputError where the content of a file is nested too deep or has too large a whole number."""
    level, seen = [content], set[int]()
    for _ in range(MAX_DEPTH):
        values = list(chain.from_iterable(map(_children, level)))
        for value in values:
            if isinstance(value, int) and abs(value) > MAX_INTEGER:
                raise InputError(file, f"expected whole numbers up to {MAX_INTEGER}, found {shown(value)}")
        # what an alias names more than once is looked at once
        inner = {id(value): value for value in values if isinstance(value, dict | list)}
        level = [value for key, value in inner.items() if key not in seen]
        seen |= inner.keys()
        if not level:
            return
    raise InputError(file, too_deep())


def too_deep() -> str:
    """Return the message for a file that is nested deeper than allowed."""
    return f"expected lists and tables nested at most {MAX_DEPTH} deep, found deeper ones"


def _children(value: Any) -> Any:
    if isinstance(value, dict):
        return chain(value.keys(), value.values())
    return value if isinstance(value, list) else (value,)


# --- files and their formats -----------------------------------------------------------------------------


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
