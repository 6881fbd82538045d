"""A hint: what is odd about a log, where it is, its likely cause, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

Cause = Literal[
    "stamps",
    "clocks",
    "positions",
    "speeds",
    "yaw rate",
    "y to the right",
    "sensor frame",
    "map frame",
    "odometry",
    "mounting",
    "covariances",
    "noise",
    "labels",
    "unexplained",
]
"""The kinds of mistakes that are told."""


@dataclass(frozen=True)
class Hint:
    """Names a likely mistake in a log, with the figure that shows it."""

    LENGTHS: ClassVar = {"found": 1, "likely": 1, "advice": 1}

    cause: Cause
    """The mistake is of this kind."""
    file: str
    """It is in this file of the log."""
    columns: str
    """It is in these columns."""
    found: str
    """This was found, with its figure."""
    likely: str
    """This is the likely cause."""
    advice: str
    """This mends it."""

    @property
    def line(self) -> str:
        """Returns the hint in one line."""
        return f"{self.file}, {self.columns}: {self.found}; likely cause: {self.likely}; {self.advice}"


def because(hints: Sequence[Hint]) -> str:
    """Returns the likely causes of a refusal in words, or nothing where there is no hint."""
    causes = [f"{hint.likely} ({hint.file}, {hint.columns}: {hint.found})" for hint in hints]
    return f"likely cause: {'; '.join(causes)}" if causes else ""
