"""Settings whose numbers are checked where they are made."""

from dataclasses import fields
from math import inf, isfinite
from typing import ClassVar

from pathspace_graph.errors import SettingsError


class Positive:
    """Settings whose numbers are all positive and, unless they are listed as unlimited, finite."""

    UNLIMITED: ClassVar[tuple[str, ...]] = ()
    """Numbers that may be infinite, which means that there is no limit."""

    SIGNED: ClassVar[tuple[str, ...]] = ()
    """Numbers that may have either sign."""

    prefix: ClassVar[str]
    """What stands before the names of the settings on the command line."""

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Set the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = "" if group == "mapper" else f"{group}."

    def __post_init__(self) -> None:
        """Raise a SettingsError that names the first wrong setting, as the command line knows it."""
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if entry.name in self.SIGNED:
                if not isfinite(value):
                    raise SettingsError(f"{self.prefix}{entry.name}: expected a number, found {value}")
                continue
            if not value > 0:
                raise SettingsError(f"{self.prefix}{entry.name}: expected a positive number, found {value}")
            if value == inf and entry.name not in self.UNLIMITED:
                raise SettingsError(f"{self.prefix}{entry.name}: expected a finite number, found {value}")
