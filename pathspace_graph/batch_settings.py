"""Settings of the batch optimization over a whole log."""

from __future__ import annotations

from dataclasses import dataclass

from .positive import Positive


@dataclass(frozen=True)
class BatchSettings(Positive):
    """The batch optimization over a whole log."""
