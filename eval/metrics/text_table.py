"""A table of text for the terminal, for files, for Markdown and for LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from rich.table import Table
from rich.text import Text
from tabulate import LATEX_ESCAPE_RULES, SEPARATING_LINE, tabulate

_BORDER: Final = 3
"""A terminal's table has this many characters between two columns."""
_UNICODE: Final = str.maketrans(
    {"–": "--", "σ": r"$\sigma$", "−": "$-$", "±": r"$\pm$", "²": r"$^2$", "×": r"$\times$"}
)
"""LaTeX gets these commands in place of characters that not every font has."""


@dataclass(frozen=True)
class TextTable:
    """A table holds rows of text under a header: first names, left-aligned, then numbers, right-aligned."""

    title: str
    """This sentence stands above the table; it may be empty."""
    header: tuple[str, ...]
    """Every column has a title."""
    rows: tuple[tuple[str, ...], ...]
    """Every row is as long as the header."""
    groups: tuple[int, ...] = ()
    """A new group of rows begins at each of these row numbers."""
    names: int = 1
    """The first columns, as many as this, are names."""

    def parts(self, width: int) -> list[TextTable]:
        """Returns tables of at most `width` characters, each with the names and some of the other columns."""
        needed = [max(map(len, column)) + _BORDER for column in zip(self.header, *self.rows, strict=True)]
        shared = sum(needed[: self.names]) + 1
        parts: list[list[int]] = [[]]
        for number in range(self.names, len(self.header)):
            if parts[-1] and shared + sum(needed[k] for k in (*parts[-1], number)) > width:
                parts.append([])
            parts[-1].append(number)
        return [self._only([*range(self.names), *part]) for part in parts]

    def _only(self, columns: Sequence[int]) -> TextTable:
        rows = tuple(tuple(row[k] for k in columns) for row in self.rows)
        return replace(self, header=tuple(self.header[k] for k in columns), rows=rows)

    def rich(self) -> Table:
        """Returns the table for a terminal, without its title; units in brackets aren't taken for markup."""
        table = Table()
        for number, name in enumerate(self.header):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for number, row in enumerate(self.rows):
            table.add_row(*map(Text, row), end_section=number + 1 in self.groups)
        return table

    def text(self) -> str:
        """Returns the table for a text file, without its title: columns aligned by blanks."""
        return self._formatted("simple", self.rows)

    def markdown(self) -> str:
        """Returns the title and the table in Markdown."""
        rows = [[cell.replace("|", r"\|") for cell in row] for row in self.rows]
        title = f"{self.title}\n\n" if self.title else ""
        return f"{title}{self._formatted('pipe', rows)}\n"

    def latex(self) -> str:
        """Returns a `table` environment in LaTeX, with the title as its caption; it needs booktabs."""
        rows: list[Sequence[str] | str] = []
        for number, row in enumerate(self.rows):
            rows += [SEPARATING_LINE, row] if number in self.groups else [row]
        caption = "".join(LATEX_ESCAPE_RULES.get(character, character) for character in self.title)
        lines = [
            r"% \usepackage{booktabs}",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{caption}}}",
            self._formatted("latex_booktabs", rows),
            r"\end{table}",
            "",
        ]
        return "\n".join(lines).translate(_UNICODE)

    def _formatted(self, style: str, rows: Sequence[Sequence[str] | str]) -> str:
        sides = ["left"] * self.names + ["right"] * (len(self.header) - self.names)
        return str(tabulate(rows, self.header, tablefmt=style, colalign=sides, disable_numparse=True))
