"""Hook of the site's build: figures become tables, lists of names become the API.

A line that is only a link to a table of the report (`figures/NAME.csv`) becomes that table with the link as
its caption. A link to the folder becomes a line with commits, dates and machines. `::: MODULE: NAMES`
becomes a directive of mkdocstrings for each name.
"""

import csv
import re
from pathlib import Path

FIGURES = Path(__file__).parent / "figures"
LINK = re.compile(r"^\[.*\]\(figures/(.*)\)$", flags=re.MULTILINE)
API = re.compile(r"^::: (\S+): (.*)$", flags=re.MULTILINE)

Rows = list[dict[str, str]]  # figures of a file, by the names of its columns


def on_page_markdown(markdown: str, **_: object) -> str:
    """Insert tables and directives into the text of a page."""
    markdown = API.sub(lambda api: "\n".join(f"::: {api[1]}.{name}" for name in api[2].split()), markdown)
    return LINK.sub(lambda link: f"{table(read(link[1]))}\n\n*{link[0]}*" if link[1] else made(), markdown)


def read(name: str) -> Rows:
    with (FIGURES / name).open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def table(rows: Rows) -> str:
    """Markdown table of a file, with rows and columns in the order of the file."""
    title = next(iter(rows[0]))
    columns = [*dict.fromkeys(row["column"] for row in rows)]
    lines = [[title, *columns], [":---", *["---:"] * len(columns)]]
    for label in dict.fromkeys(row[title] for row in rows):
        cells = {row["column"]: figure(row).replace(" ", "&nbsp;") for row in rows if row[title] == label}
        lines.append([label, *(cells[column] for column in columns)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def figure(row: dict[str, str]) -> str:
    """Value with half the width of its interval, such as `0.165 ± 0.036`."""
    return " ± ".join(filter(None, (row["value"], row["half_width"])))


def made() -> str:
    """Line with the commits and dates of all tables, by machine."""
    machines = dict[str, set[str]]()
    for row in (row for file in FIGURES.glob("*.csv") for row in read(file.name)):
        machines.setdefault(row["machine"], set()).add(f"{row['date']} at {row['commit']}")
    each = (f"{', '.join(sorted(times))} (machine: {name})" for name, times in sorted(machines.items()))
    return f"*Measured {'; '.join(each)}.*"
