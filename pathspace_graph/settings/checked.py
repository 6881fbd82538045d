"""Settings whose numbers are checked where they are made."""

from __future__ import annotations

from dataclasses import fields

from pathspace_graph.errors import SettingsError


class Positive:
    """Settings whose numbers are all positive; infinity is allowed."""

    def __post_init__(self) -> None:
        """SettingsError names the first setting that isn't, as the command line knows it."""
        group = type(self).__name__.removesuffix("Settings").lower()
        prefix = "" if group == "mapper" else f"{group}."
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if isinstance(value, int | float) and not value > 0:
                raise SettingsError(f"{prefix}{entry.name}: expected a positive number, found {value}")
