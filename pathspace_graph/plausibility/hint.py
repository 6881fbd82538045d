"""Hints about likely mistakes in a log; their texts are a table, `hints.csv`."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

SURVIVABLE: Final = {"gaps", "reach", "mounting", "covariances", "labels", "noise", "sides"}
"""Causes in spite of which a map can be right."""


@dataclass(frozen=True)
class Hint:
    """A likely mistake in a log; lengths in its texts are in metres of the log."""

    cause: str
    """Kind of the mistake."""
    file: str
    columns: str
    """Columns of the file."""
    found: str
    """Finding, with its figure."""
    likely: str
    """Likely cause."""
    advice: str
    """Correction."""

    @property
    def line(self) -> str:
        return f"{self.file}, {self.columns}: {self.found}; likely cause: {self.likely}; {self.advice}"


with (files(__package__) / "hints.csv").open(encoding="utf-8") as _file:
    TEXTS: Final = {row.pop("mistake"): row for row in csv.DictReader(_file)}
    """Fields of the hint of each mistake, with places for its figures."""


def hint_of(mistake: str, **figures: Any) -> Hint:
    return Hint(**{name: text.format(**figures) for name, text in TEXTS[mistake].items()})


def because(hints: Sequence[Hint]) -> str:
    """Return the likely causes of a refusal in words; empty without hints."""
    causes = [f"{hint.likely} ({hint.file}, {hint.columns}: {hint.found})" for hint in hints]
    return f"likely cause: {'; '.join(causes)}" if causes else ""


def objections(hints: Sequence[Hint]) -> list[str]:
    """Return why the map of a log with these hints is wrong; empty if all are `SURVIVABLE`."""
    likely = [hint.likely for hint in hints if hint.cause not in SURVIVABLE]
    return [f"not a map of the drive: {'; '.join(likely)}"] if likely else []
