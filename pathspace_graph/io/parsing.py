"""Text, TOML, JSON and YAML as plain data, never as code; tables of numbers; and the limits of both."""

import re
import stat
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from reprlib import Repr
from typing import Any, Final, NamedTuple, Self, TypeVar

import msgspec
import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from pathspace_graph.errors import MAX_INTEGER, InputError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray

T = TypeVar("T")

MAX_FILE_BYTES: Final = 2**30
MAX_HEADER_BYTES: Final = 2**22  # also of a study
MAX_DEPTH: Final = 32  # of lists and tables in each other

MAX_STAMP: Final = 1e10  # s: 300 years; stamps in milliseconds or nanoseconds are beyond it
MAX_HELD: Final = 1e3  # m, moved by a twist until the next row
MAX_DRIVE: Final = 1e6  # m
MAX_RANGE: Final = 1e4  # m, each coordinate of a detection
MAX_DETECTIONS: Final = 10_000  # of one perception cycle
MAX_COORDINATE: Final = 1e8  # m, of a map, a trajectory or a track; any geodetic grid has room in it
MAX_NOISE: Final = 1e6  # a number in a log's header, in its own unit

TOO_DEEP: Final = f"expected lists and tables nested at most {MAX_DEPTH} deep, found deeper ones"
_SHORT: Final = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 3, 80, 60, 40


def shown(value: Any) -> str:
    """Short text of any value, for a message."""
    text = _SHORT.repr(value)
    return text if len(text) <= 120 else text[:117] + "..."


def read_text(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> str:
    """Read the text of a file in UTF-8 of at most `most` bytes.

    An InputError says what was `expected`.
    """
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):  # a pipe would block where it is opened
            raise InputError(file, f"expected {expected}, found a folder, a device or a pipe")
        if found.st_size > most:
            raise InputError(file, f"expected at most {most} bytes, found more")
        data = file.read_bytes()
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise InputError(file, f"expected {expected}, found none") from None
    except OSError as error:
        raise InputError(file, f"expected {expected}, can't be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise InputError(file, "expected text in UTF-8", row) from None


# --- TOML, JSON and YAML -----------------------------------------------------------------------------------

_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@contextmanager
def _parsing(file: Path, kind: str, text: str) -> Iterator[None]:
    """Turn what a parser raises into an InputError that names the file and, where it is known, the row."""
    try:
        yield
    except RecursionError:
        raise InputError(file, TOO_DEEP) from None
    except yaml.MarkedYAMLError as error:
        row = None if error.problem_mark is None else error.problem_mark.line + 1
        raise InputError(file, f"expected {kind}: {error.problem}", row) from None
    # YAML raises most of these for values that do not fit their tags, as `2020-99-99`
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        told = " ".join(str(error).split())
        line, byte = re.search(r"at line (\d+)", told), re.search(r"\(byte (\d+)\)|truncated", told)
        row = int(line[1]) if line else None
        if byte:
            row = text.encode()[: int(byte[1]) if byte[1] else None].count(b"\n") + 1
        raise InputError(file, f"expected {kind}: {told}", row) from None


def parse_json(text: str, file: Path) -> Any:
    """Parse JSON; an InputError names the file and, where it is known, the row."""
    with _parsing(file, "JSON", text):
        return msgspec.json.decode(text)


def read_json(file: Path, expected: str) -> Any:
    """Read a JSON file; an InputError says what was `expected`."""
    return parse_json(read_text(file, expected), file)


def parse_toml(text: str, file: Path) -> dict[str, Any]:
    """Parse TOML; an InputError names the file and, where it is known, the row."""
    with _parsing(file, "TOML", text):
        content = tomllib.loads(text)
    check_content(content, file)
    return content


def check_content(content: Any, file: Path, depth: int = MAX_DEPTH) -> None:
    """Raise an InputError where plain data is nested too deep or has too large a whole number."""
    if isinstance(content, int) and abs(content) > MAX_INTEGER:
        raise InputError(file, f"expected whole numbers up to {MAX_INTEGER}, found {shown(content)}")
    if isinstance(content, dict | list):
        if not depth:
            raise InputError(file, TOO_DEEP)
        for inner in content.values() if isinstance(content, dict) else content:
            check_content(inner, file, depth - 1)


def parse_yaml(text: str, file: Path) -> Any:
    """Parse YAML of plain values; an InputError names the file and, where it is known, the row."""
    with _parsing(file, "YAML", text):
        depth = 0
        for event in yaml.parse(text, Loader=_YAML_LOADER):  # deep ones overflow the stack of its composer
            row = event.start_mark.line + 1 if event.start_mark else None
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise InputError(file, TOO_DEEP, row)
            if isinstance(event, yaml.ScalarEvent) and event.value == "<<":  # a short text of a huge one
                raise InputError(file, "expected YAML: merge keys are not read", row)
        return yaml.load(text, Loader=_YAML_LOADER)


def typed(value: Any, kind: type[T], file: Path, where: str = "", *, strict: bool = True) -> T:
    """Convert plain data to a type, checked by msgspec; an InputError names the file and the dotted key.

    Unless it is `strict`, a text may stand for a number: YAML takes 1e-5 for a word.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        said, _, at = str(error).replace("`", "").partition(" - at ")
        said = said.replace("Number out of range", "Expected a smaller number")
        path = at.rpartition("$")[2].removeprefix(".")
        missing = "".join(re.findall("missing required field (.*)", said))
        key = ".".join(filter(None, (where, path, missing)))
        said = re.sub(r"str matching regex '\^\((.*)\)\$'", lambda words: f"one of {words[1]}", said)
        told = "expected, but missing" if missing else said[0].lower() + said[1:]
        raise InputError(file, f"{key or 'the file'}: {told}") from None


# --- tables ------------------------------------------------------------------------------------------------

LABEL: Final = "label"  # column of words
MISSING: Final = frozenset({"", "nan", "na", "n/a", "none", "null", "-"})  # words for no number


class Column(NamedTuple):
    """Limit of the numbers in a column."""

    largest: float = MAX_COORDINATE
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of a file or of arrays, column by column."""

    file: Path
    columns: dict[str, NDArray[Any]]  # texts or numbers (rows,)
    rows: IntArray  # number of each row (rows,) in the file
    declared: Mapping[str, Column] = field(default_factory=dict)

    @classmethod
    def of_arrays(cls, file: Path, declared: Mapping[str, Column], *values: ArrayLike) -> Self:
        """Make the table of arrays (rows,) and (rows, k) that a file with their columns would give."""
        try:
            rows = np.column_stack([np.asarray(value, float) for value in values])
        except ValueError as error:
            raise InputError(file, f"expected arrays of numbers with a row each: {error}") from None
        if rows.shape[1] != len(declared):
            raise InputError(file, f"expected the columns {', '.join(declared)}, found {rows.shape[1]}")
        return cls(file, dict(zip(declared, rows.T, strict=True)), np.arange(len(rows)) + 1, declared)

    def __len__(self) -> int:
        return len(self.rows)

    def require(self, good: BoolArray, message: str) -> None:
        """Raise an InputError for the first row that is not good; `good` is (rows,)."""
        if not good.all():
            raise InputError(self.file, message, int(self.rows[np.argmin(good)]))

    def numbers(self, name: str, largest: float | None = None, *, missing: bool = False) -> Array:
        """Column as finite numbers (rows,), at most as large as declared, or as `largest`.

        With `missing`, a number may be missing, as in `MISSING`, or not be finite; NaN stands for both.
        """
        values, (declared, unit) = self.parsed(name, missing=missing), self.declared.get(name, Column())
        known, most = np.isfinite(values), largest or declared
        for good, expected in (
            (known | missing, "a finite number"),
            (~known | (np.abs(values) <= most), f"a number of at most {most:g} {unit}".rstrip() + " in size"),
        ):
            found = f"found {values[np.argmin(good)]:g}" if len(good) else ""
            self.require(good, f"expected {expected} in column '{name}', {found}")
        return np.where(known, values, np.nan)

    def parsed(self, name: str, *, missing: bool = False) -> Array:
        """Column as numbers (rows,), which may not be finite."""
        if name not in self.columns:
            found = shown(",".join(self.columns))
            raise InputError(self.file, f"expected a column '{name}', found none in {found}", 1)
        texts = self.columns[name]
        if texts.dtype != object:
            return texts.astype(float)
        if missing:
            words = ("nan" if text.strip().lower() in MISSING else text for text in texts)
            texts = np.array([*words], dtype=object)
        try:
            if (text := "".join(texts)).isascii() and "_" not in text:  # which Python would also read
                return texts.astype(float)
        except ValueError:
            pass
        first = [*map(is_number, texts)].index(False)
        found = f"expected a number in column '{name}', found {shown(texts[first].strip())}"
        raise InputError(self.file, found, int(self.rows[first]))

    def stack(self, names: Sequence[str], largest: float | None = None) -> Array:
        """Named columns side by side (rows, names), see `numbers`."""
        return np.column_stack([self.numbers(name, largest) for name in names])


def is_number(text: str) -> bool:
    """Whether a text is a number, in ASCII and without underscores."""
    try:
        float(text)
    except ValueError:
        return False
    return text.isascii() and "_" not in text
