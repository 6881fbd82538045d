"""Settings whose numbers are checked where they are made."""

from __future__ import annotations

from dataclasses import fields
from math import inf
from typing import ClassVar

from pathspace_graph.errors import SettingsError


class Positive:
    """Holds settings whose numbers are all positive and, unless they are listed as unlimited, finite."""

    UNLIMITED: ClassVar[tuple[str, ...]] = ()
    """These numbers may be infinite, which means that there is no limit."""

    def __post_init__(self) -> None:
        """Raises a SettingsError that names the first wrong setting, as the command line knows it."""
        group = type(self).__name__.removesuffix("Settings").lower()
        prefix = "" if group == "mapper" else f"{group}."
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if not isinstance(value, int | float):
                continue
            if not value > 0:
                raise SettingsError(f"{prefix}{entry.name}: expected a positive number, found {value}")
            if value == inf and entry.name not in self.UNLIMITED:
                raise SettingsError(f"{prefix}{entry.name}: expected a finite number, found {value}")
