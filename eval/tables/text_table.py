"""A table of text, for a terminal, for Markdown and for LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from rich.table import Table
from rich.text import Text

_BORDER: Final = 3
"""Characters between two columns in a terminal."""
_SPACE: Final = "  "
"""Between two columns of plain text."""
_LATEX: Final = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "σ": r"$\sigma$",
    "−": "$-$",
    "±": r"$\pm$",
    "<": r"$<$",
    ">": r"$>$",
    "²": r"$^2$",
    "×": r"$\times$",
}
"""What text means in LaTeX."""


@dataclass(frozen=True)
class TextTable:
    """Rows of text under a header: first names, to the left, then numbers, to the right."""

    title: str
    """A sentence above it."""
    header: tuple[str, ...]
    """A title for each column."""
    rows: tuple[tuple[str, ...], ...]
    """As long as the header each."""
    groups: tuple[int, ...] = ()
    """Numbers of the rows that a new group of rows begins at."""
    names: int = 1
    """How many of the columns are names."""

    def parts(self, width: int) -> list[TextTable]:
        """Tables of `width` characters at most, each with the names and some of the other columns."""
        needed = [max(map(len, column)) + _BORDER for column in zip(self.header, *self.rows, strict=True)]
        shared = sum(needed[: self.names]) + 1
        groups: list[list[int]] = [[]]
        for number in range(self.names, len(self.header)):
            if groups[-1] and shared + sum(needed[k] for k in (*groups[-1], number)) > width:
                groups.append([])
            groups[-1].append(number)
        return [self._only([*range(self.names), *group]) for group in groups]

    def _only(self, columns: Sequence[int]) -> TextTable:
        rows = tuple(tuple(row[k] for k in columns) for row in self.rows)
        return replace(self, header=tuple(self.header[k] for k in columns), rows=rows)

    def rich(self) -> Table:
        """For a terminal, without the title; a unit in brackets isn't taken for markup."""
        table = Table()
        for number, name in enumerate(self.header):
            table.add_column(Text(name), justify="left" if number < self.names else "right")
        for number, row in enumerate(self.rows):
            table.add_row(*map(Text, row), end_section=number + 1 in self.groups)
        return table

    def text(self) -> str:
        """For a file to look at, without the title: columns aligned by blanks."""
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]

        def line(cells: tuple[str, ...]) -> str:
            names = map(str.ljust, cells[: self.names], widths)
            numbers = map(str.rjust, cells[self.names :], widths[self.names :])
            return _SPACE.join([*names, *numbers]).rstrip()

        rule = "-" * (sum(widths) + len(_SPACE) * (len(widths) - 1))
        return "\n".join([line(self.header), rule, *map(line, self.rows)])

    def markdown(self) -> str:
        """For a README."""
        aligned = ["---"] * self.names + ["---:"] * (len(self.header) - self.names)
        rows = [[cell.replace("|", r"\|") for cell in row] for row in self.rows]
        lines = [f"| {' | '.join(line)} |\n" for line in (self.header, aligned, *rows)]
        return "".join([f"{self.title}\n\n"] * bool(self.title) + lines)

    def latex(self) -> str:
        """For a paper, with the package booktabs."""
        columns = "l" * self.names + "r" * (len(self.header) - self.names)
        lines = [
            r"% \usepackage{booktabs}",
            r"\begin{table}",
            r"  \centering",
            rf"  \caption{{{latex_text(self.title)}}}",
            rf"  \begin{{tabular}}{{{columns}}}",
            r"    \toprule",
            _latex_row(self.header),
        ]
        for number, row in enumerate(self.rows):
            if number == 0 or number in self.groups:
                lines.append(r"    \midrule")
            lines.append(_latex_row(row))
        return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}", r"\end{table}", ""])


def latex_text(text: str) -> str:
    """The same text where some characters are commands."""
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_row(cells: tuple[str, ...]) -> str:
    return f"    {' & '.join(map(latex_text, cells))} \\\\"
