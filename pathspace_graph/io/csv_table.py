"""CSV tables with a header: columns by name, and errors that name row and column."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.io.parsing import MAX_COORDINATE, MAX_FILE_BYTES, shown

from .parsing import read_text


class Column(NamedTuple):
    """What the numbers of a column must be."""

    largest: float = MAX_COORDINATE
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """Rows below a CSV header, as text, column by column."""

    file: Path
    columns: dict[str, list[str]]
    """Texts of each column, as they stand in the file."""
    lines: list[int]
    """Line of each row in the file; the header is line 1."""
    declared: Mapping[str, Column] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def fail(self, index: int, message: str) -> NoReturn:
        """Raise the InputError of the row with this index."""
        raise InputError(self.file, message, self.lines[index])

    def require(self, good: BoolArray, message: str) -> None:
        """Raise an InputError for the first row that is not good; `good` is (rows,)."""
        if not good.all():
            self.fail(int(np.argmin(good)), message)

    def numbers(self, name: str, largest: float | None = None) -> Array:
        """Return the column as numbers (rows,), at most as large as declared, or as `largest`.

        A word, NaN, infinity or a larger number is an InputError.
        """
        column, texts = self.declared.get(name, Column()), self.columns[name]
        most, unit = largest or column.largest, f" {column.unit}".rstrip()
        try:
            values = np.array(list(map(float, texts)), dtype=float)
            good = is_plain("".join(texts))
        except ValueError:
            good = False
        if not good:
            self._refuse(name, [*map(_is_number, texts)], "a number")
        self._refuse(name, np.isfinite(values), "a finite number")
        self._refuse(name, np.abs(values) <= most, f"a number of at most {most:g}{unit} in size")
        return values

    def _refuse(self, name: str, good: ArrayLike, expected: str) -> None:
        """Raise an InputError for the first row whose text is not as expected; `good` is (rows,)."""
        if not np.all(good):
            index = int(np.argmin(good))
            found = shown(self.columns[name][index].strip())
            self.fail(index, f"expected {expected} in column '{name}', found {found}")

    def stack(self, names: Sequence[str], largest: float | None = None) -> Array:
        """Return the named columns side by side (rows, names), see `numbers`."""
        return np.column_stack([self.numbers(name, largest) for name in names])


def read_table(
    file: Path, required: Mapping[str, Column] | Sequence[str], comment: str = "", most: int = MAX_FILE_BYTES
) -> Table:
    """Read a CSV file with a header that holds at least the required columns, in any order.

    Quotes, blanks around fields, empty lines, Windows line ends and a byte-order mark are tolerated;
    `comment` is stripped from the front of the header. A file that is missing, empty or larger than `most`
    (bytes), a missing column, or a row with too few or too many fields is an InputError.
    """
    rows, lines = _read_rows(file, most)
    if not rows:
        raise InputError(file, f"expected a header {','.join(required)}, found an empty file", 1)
    header = [name.strip() for name in rows[0]]
    if header:
        header[0] = header[0].removeprefix(comment).strip()
    _check_header(file, header, required, lines[0])
    body = [
        row if len(row) == len(header) else _fit(file, row, len(header), line)
        for row, line in zip(rows[1:], lines[1:], strict=True)
    ]
    columns = [list(column) for column in zip(*body, strict=True)] or [[] for _ in header]
    declared = required if isinstance(required, Mapping) else {}
    return Table(file, dict(zip(header, columns, strict=True)), lines[1:], declared)


def write_table(file: Path, names: Iterable[str], *values: ArrayLike) -> None:
    """Write a CSV file of columns (rows,), each of numbers or of texts, or of several side by side (rows, k).

    Every number has the shortest text that reads back as the same one.
    """
    columns = [column for value in values for column in np.atleast_2d(np.asarray(value).T).tolist()]
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def _read_rows(file: Path, most: int) -> tuple[list[list[str]], list[int]]:
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(StringIO(read_text(file, most=most), newline=""), skipinitialspace=True)
    try:
        for row in reader:
            if "".join(row).strip():
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(file, f"expected comma-separated values: {error}", reader.line_num) from error
    return rows, lines


def _check_header(file: Path, header: list[str], required: Iterable[str], line: int) -> None:
    for name in required:
        if header.count(name) != 1:
            found = "none" if name not in header else "more than one"
            raise InputError(
                file, f"expected a column '{name}', found {found} in {shown(','.join(header))}", line
            )


def _fit(file: Path, row: list[str], width: int, line: int) -> list[str]:
    while len(row) > width and not row[-1].strip():
        row = row[:-1]
    if len(row) != width:
        raise InputError(file, f"expected {width} fields, found {len(row)}", line)
    return row


def is_plain(text: str) -> bool:
    """Return whether numbers are written in ASCII and without underscores, which Python would also read."""
    return text.isascii() and "_" not in text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return is_plain(text)
