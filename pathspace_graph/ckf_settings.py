"""Settings of the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass

from .positive import Positive


@dataclass(frozen=True)
class CkfSettings(Positive):
    """The paper's filters."""
