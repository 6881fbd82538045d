"""Settings whose numbers are checked where they are made."""

from __future__ import annotations

from dataclasses import fields
from typing import ClassVar

from pathspace_graph.errors import SettingsError


class Positive:
    """Settings whose numbers are all positive; infinity is allowed."""

    prefix: ClassVar[str]
    """This stands before the names of the settings on the command line."""

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Sets the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = "" if group == "mapper" else f"{group}."

    def __post_init__(self) -> None:
        """SettingsError names the first setting that isn't, as the command line knows it."""
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if isinstance(value, int | float) and not value > 0:
                raise SettingsError(f"{self.prefix}{entry.name}: expected a positive number, found {value}")
