"""CSV tables with a header: columns by name, and errors that name the row."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError

from .limits import MAX_COORDINATE, MAX_FILE_BYTES, shown
from .parsing import read_text

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """Holds the rows below a CSV header, as text, column by column."""

    file: Path
    """The table was read from this file."""
    columns: dict[str, list[str]]
    """Each column has its texts under its name, as they stand in the file."""
    lines: list[int]
    """Each row stands on this line of the file; the header is line 1."""

    def __len__(self) -> int:
        return len(self.lines)

    def fail(self, index: int, message: str) -> NoReturn:
        """Raises the InputError of the row with this index."""
        raise InputError(self.file, message, self.lines[index])

    def require(self, good: NDArray[np.bool_], message: str) -> None:
        """Raises an InputError for the first row that is not good; `good` is (rows,)."""
        if not good.all():
            self.fail(int(np.argmin(good)), message)

    def numbers(self, name: str, largest: float = MAX_COORDINATE) -> FloatArray:
        """Returns the column as numbers (rows,) of at most `largest` in size.

        A word, NaN, infinity or a larger number is an InputError.
        """
        texts = self.columns[name]
        values = self._parsed(name)
        bad = ~np.isfinite(values)
        if bad.any():
            index = int(np.argmax(bad))
            self.fail(index, f"expected a finite number in column '{name}', found {shown(texts[index])}")
        bad = np.abs(values) > largest
        if bad.any():
            index = int(np.argmax(bad))
            expected = f"expected a number of at most {largest:g} in size in column '{name}'"
            self.fail(index, f"{expected}, found {shown(texts[index])}")
        return values

    def _parsed(self, name: str) -> FloatArray:
        """Returns the column as numbers (rows,), which may be NaN or infinite."""
        texts = self.columns[name]
        try:
            values = np.array(list(map(float, texts)), dtype=float)
            good = is_plain("".join(texts))
        except ValueError:
            good = False
        if not good:
            index = next(i for i, text in enumerate(texts) if not _is_number(text))
            self.fail(index, f"expected a number in column '{name}', found {shown(texts[index].strip())}")
        return values

    def stack(self, names: Sequence[str], largest: float = MAX_COORDINATE) -> FloatArray:
        """Returns the named columns side by side (rows, names), each number of at most `largest` in size."""
        return np.column_stack([self.numbers(name, largest) for name in names])


def read_table(file: Path, required: Sequence[str], comment: str = "", most: int = MAX_FILE_BYTES) -> Table:
    """Reads a CSV file with a header that holds at least the required columns, in any order.

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
    return Table(file, dict(zip(header, columns, strict=True)), lines[1:])


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


def _check_header(file: Path, header: list[str], required: Sequence[str], line: int) -> None:
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
    """Returns whether numbers are written in ASCII and without underscores, which Python would also read."""
    return text.isascii() and "_" not in text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return is_plain(text)
