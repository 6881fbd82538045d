"""Settings of the Hungarian landmark graph."""

from __future__ import annotations

from dataclasses import dataclass

from .positive import Positive


@dataclass(frozen=True)
class LandmarkSettings(Positive):
    """The Hungarian landmark graph."""
