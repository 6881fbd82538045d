"""TOML, JSON, YAML and CSV as plain data, never as code, within limits against damage and mistakes."""

import csv
import json
import re
import stat
import tomllib
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from reprlib import Repr
from typing import Any, BinaryIO, Final, NamedTuple, NoReturn, Self, TypeVar

import msgspec
import numpy as np
import yaml
from numpy.typing import ArrayLike

from pathspace_graph.errors import MAX_INTEGER, InputError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray

T = TypeVar("T")

MAX_FILE_BYTES: Final = 2**30
MAX_HEADER_BYTES: Final = 2**22  # also of a study
MAX_TRACK_BYTES: Final = 2**23
MAX_DEPTH: Final = 32  # of lists and tables in each other
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

TOO_DEEP: Final = f"expected lists and tables nested at most {MAX_DEPTH} deep, found deeper ones"
_SHORT: Final = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 3, 80, 60, 40


def shown(value: Any) -> str:
    """Short text of any value, for a message."""
    text = _SHORT.repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."


def check_content(content: Any, file: Path) -> None:
    """Raise an InputError where the content of a file is nested too deep or has too large a whole number."""
    level, seen = [content], set[int]()
    for _ in range(MAX_DEPTH + 1):
        for value in level:
            if isinstance(value, int) and abs(value) > MAX_INTEGER:
                raise InputError(file, f"expected whole numbers up to {MAX_INTEGER}, found {shown(value)}")
        # what an alias names more than once is looked at once
        inner = {id(value): value for value in level if isinstance(value, dict | list)}
        parents = [value for key, value in inner.items() if key not in seen]
        if not parents:
            return
        seen |= inner.keys()
        level = [*chain.from_iterable(map(_children, parents))]
    raise InputError(file, TOO_DEEP)


def _children(value: Any) -> Any:
    return chain(value.keys(), value.values()) if isinstance(value, dict) else value


# --- files and their formats -----------------------------------------------------------------------------

_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MERGE: Final = "tag:yaml.org,2002:merge"
# of the parsers; that of YAML raises most of them for values that do not fit their tags, as `2020-99-99`
_ERRORS: Final = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError)


def read_text(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> str:
    """Read the text of a file in UTF-8, or in UTF-16 with a byte-order mark, of at most `most` bytes.

    An InputError says what was `expected`.
    """
    return _decoded(read_bytes(file, expected, most), file)


def _encoding(data: bytes) -> str:
    return "utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig"


def _decoded(data: bytes, file: Path) -> str:
    try:
        return data.decode(_encoding(data))
    except UnicodeDecodeError as error:
        raise InputError(file, "expected text in UTF-8", data.count(b"\n", 0, error.start) + 1) from None


def read_bytes(file: Path, expected: str = "a file", most: int = MAX_FILE_BYTES) -> bytes:
    """Read the bytes of a file, at most `most`; an InputError says what was `expected`."""
    with _opened(file, expected, most) as stream:
        return stream.read()


@contextmanager
def _opened(file: Path, expected: str, most: int) -> Iterator[BinaryIO]:
    """Open a file of at most `most` bytes; an InputError says what was `expected`."""
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):  # a pipe would block where it is opened
            raise InputError(file, f"expected {expected}, found a folder, a device or a pipe")
        if found.st_size > most:
            raise InputError(file, f"expected at most {most} bytes, found more")
        with file.open("rb") as stream:
            yield stream
    except FileNotFoundError:
        raise InputError(file, f"expected {expected}, found none") from None
    except OSError as error:
        raise InputError(file, f"expected {expected}, can't be read ({error.strerror})") from None


@contextmanager
def _parsing(file: Path, kind: str) -> Iterator[None]:
    """Turn what a parser raises into an InputError that names the file and, where it is known, the row."""
    try:
        yield
    except RecursionError:
        raise InputError(file, TOO_DEEP) from None
    except json.JSONDecodeError as error:
        raise InputError(file, f"expected {kind} ({error.msg})", error.lineno) from None
    except yaml.MarkedYAMLError as error:
        raise InputError(file, f"expected {kind}: {error.problem}", _row(error.problem_mark)) from None
    except _ERRORS as error:
        line = re.search(r"at line (\d+)", str(error)) if kind == "TOML" else None
        told = " ".join(str(error).split())
        raise InputError(file, f"expected {kind}: {told}", int(line[1]) if line else None) from None


def _parsed(kind: str, load: Callable[[str], Any], text: str, file: Path) -> Any:
    with _parsing(file, kind):
        content = load(text)
    check_content(content, file)
    return content


def parse_json(text: str, file: Path) -> Any:
    """Parse JSON; an InputError names the file and, where it is known, the row."""
    return _parsed("JSON", json.loads, text, file)


def read_json(file: Path, expected: str) -> Any:
    """Read a JSON file; an InputError says what was `expected`."""
    return parse_json(read_text(file, expected), file)


def parse_toml(text: str, file: Path) -> dict[str, Any]:
    content: dict[str, Any] = _parsed("TOML", tomllib.loads, text, file)
    return content


def typed(value: Any, kind: type[T], file: Path, where: str = "", *, strict: bool = True) -> T:
    """Convert plain data to a type, checked by msgspec; an InputError names the file and the dotted key.

    Unless it is `strict`, a text may stand for a number: YAML takes 1e-5 for a word.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        said, _, at = str(error).replace("`", "").partition(" - at ")
        path = at.rpartition("$")[2].removeprefix(".")
        missing = "".join(re.findall("missing required field (.*)", said))
        key = ".".join(filter(None, (where, path, missing)))
        said = re.sub(r"str matching regex '\^\((.*)\)\$'", lambda words: f"one of {words[1]}", said)
        told = "expected, but missing" if missing else said[0].lower() + said[1:]
        raise InputError(file, f"{key or 'the file'}: {told}") from None


class _Loader(_YAML_LOADER):  # type: ignore[misc]
    """YAML loader of plain values without merge keys, by which a short text can stand for a huge one."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        for key, _ in node.value:
            if key.tag == _MERGE:
                raise yaml.MarkedYAMLError(problem="merge keys are not read", problem_mark=key.start_mark)
        super().flatten_mapping(node)


def parse_yaml(text: str, file: Path) -> Any:
    with _parsing(file, "YAML"):
        depth = 0
        for event in yaml.parse(text, Loader=_YAML_LOADER):  # deep ones overflow the stack of its composer
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise InputError(file, TOO_DEEP, _row(event.start_mark))
    return _parsed("YAML", partial(yaml.load, Loader=_Loader), text, file)


def _row(mark: Any) -> int | None:
    return None if mark is None else int(mark.line) + 1


# --- CSV -------------------------------------------------------------------------------------------------


MISSING: Final = frozenset({"", "nan", "na", "n/a", "none", "null", "-"})  # words for no number
DELIMITERS: Final = ",;\t"
CHUNK: Final = 4096  # rows whose texts are in memory at a time
_DECIMAL_COMMA: Final = re.compile(r"([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)")


class Column(NamedTuple):
    """A column that is read as numbers."""

    largest: float = MAX_COORDINATE
    unit: str = ""
    read: Callable[[str], float] = float  # the number of a text


@dataclass(frozen=True)
class Table:
    """Rows below a CSV header, column by column."""

    file: Path
    columns: dict[str, Any]  # numbers (rows,) of declared columns, which may not be finite; texts of others
    lines: IntArray  # line of each row in the file; the header is line 1
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
        return len(self.lines)

    def fail(self, index: int, message: str) -> NoReturn:
        raise InputError(self.file, message, int(self.lines[index]))

    def require(self, good: BoolArray, message: str) -> None:
        """Raise an InputError for the first row that is not good; `good` is (rows,)."""
        if not good.all():
            self.fail(int(np.argmin(good)), message)

    def numbers(self, name: str, largest: float | None = None, *, missing: bool = False) -> Array:
        """Column as finite numbers (rows,), at most as large as declared, or as `largest`.

        With `missing`, a number may be missing, as in `MISSING`, or not be finite; NaN stands for both.
        """
        column, values = self.declared.get(name, Column()), self.columns[name]
        if name not in self.declared:
            texts = ["nan" if missing and text.strip().lower() in MISSING else text for text in values]
            values = _numbers(self.file, name, column, texts, self.lines)
        known, unit = np.isfinite(values), f" {column.unit}".rstrip()
        most = largest or column.largest
        for good, expected in (
            (known | missing, "a finite number"),
            (~known | (np.abs(values) <= most), f"a number of at most {most:g}{unit} in size"),
        ):
            found = f"found {values[np.argmin(good)]:g}" if len(good) else ""
            self.require(good, f"expected {expected} in column '{name}', {found}")
        return np.where(known, values, np.nan)

    def stack(self, names: Sequence[str], largest: float | None = None) -> Array:
        """Named columns side by side (rows, names), see `numbers`."""
        return np.column_stack([self.numbers(name, largest) for name in names])


def _numbers(file: Path, name: str, column: Column, texts: Sequence[str], lines: Any) -> Array:
    try:
        values = np.array(list(map(column.read, texts)), dtype=float)
        if column.read is not float or is_plain("".join(texts)):
            return values
    except ValueError:
        pass
    index = [*map(is_number, texts)].index(False)
    found = shown(texts[index].strip())
    raise InputError(file, f"expected a number in column '{name}', found {found}", int(lines[index]))


def read_table(
    file: Path,
    required: Mapping[str, Column] | Sequence[str],
    comment: str = "",
    most: int = MAX_FILE_BYTES,
    delimiters: str = ",",
    header: Sequence[str] = (),
) -> Table:
    """Read a CSV file whose header holds at least the required columns; an InputError says what is wrong.

    Where columns are declared, only these are read, as numbers; else all are, as texts. Quotes, blanks around
    fields, empty lines, Windows line ends, a byte-order mark and a `comment` in front of the header are
    tolerated. A file without a header has its columns in the order of `header`. Of several `delimiters` it is
    the most frequent one in the header; where that is no comma, numbers may have a decimal comma.
    """
    with _opened(file, "a file", most) as binary:
        stream = TextIOWrapper(binary, _encoding(binary.read(2)), newline="")
        try:
            stream.seek(0)
            first = next(filter(str.strip, stream), "")
            stream.seek(0)
            reader = csv.reader(stream, delimiter=max(delimiters, key=first.count), skipinitialspace=True)
            return _read_rows(file, reader, required, comment, header)
        except csv.Error as error:
            told = f"expected comma-separated values: {error}"
            raise InputError(file, told, reader.line_num) from error
        except UnicodeDecodeError:
            read_text(file, most=most)  # which names the row
            raise


def _read_rows(
    file: Path,
    reader: Any,
    required: Mapping[str, Column] | Sequence[str],
    comment: str,
    header: Sequence[str],
) -> Table:
    rows = ((reader.line_num, row) for row in reader if "".join(row).strip())
    line, header = (1, header) if header else next(rows, (1, []))
    if not header:
        raise InputError(file, f"expected a header {','.join(required)}, found an empty file", line)
    header = [name.strip() for name in header]
    header[0] = header[0].removeprefix(comment).strip()
    for name in required:
        if header.count(name) != 1:
            found = f"{'more than one' if name in header else 'none'} in {shown(','.join(header))}"
            raise InputError(file, f"expected a column '{name}', found {found}", line)
    declared = required if isinstance(required, Mapping) else {}
    parts: dict[str, list[Any]] = {name: [] for name in declared or header}
    lines = array("q")
    while chunk := [*islice(rows, CHUNK)]:  # numbers take a tenth of the memory of their texts
        places, fields = zip(*chunk, strict=True)
        lines.extend(places)
        texts = dict(zip(header, _columns(file, fields, places, len(header)), strict=True))
        for name, part in parts.items():
            own = texts[name] if reader.dialect.delimiter == "," else [*map(_with_point, texts[name])]
            part.extend([_numbers(file, name, declared[name], own, places)] if declared else own)
    empty = np.zeros(0)
    columns = {name: np.concatenate([empty, *part]) if declared else part for name, part in parts.items()}
    return Table(file, columns, np.array(lines), declared)


def _columns(
    file: Path, rows: Sequence[list[str]], lines: Sequence[int], width: int
) -> Iterable[Sequence[str]]:
    """Transpose rows to columns; surplus empty fields at the end of a row are dropped."""
    for row, line in zip(rows, lines, strict=True):
        while len(row) > width and not row[-1].strip():
            row.pop()
        if len(row) != width:
            raise InputError(file, f"expected {width} fields, found {len(row)}", line)
    return zip(*rows, strict=True)


def _with_point(text: str) -> str:
    """Replace the decimal comma of a number by a point; any other text is unchanged."""
    number = _DECIMAL_COMMA.fullmatch(text.strip())
    return f"{number[1]}.{number[2]}" if number else text


def write_table(file: Path, names: Iterable[str], *values: ArrayLike) -> None:
    """Write a CSV file of columns (rows,) or (rows, k); numbers read back as the same ones."""
    columns = [column for value in values for column in np.atleast_2d(np.asarray(value).T).tolist()]
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def is_plain(text: str) -> bool:
    """Whether numbers are in ASCII and have no underscores, which Python would also read."""
    return text.isascii() and "_" not in text


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return is_plain(text)
