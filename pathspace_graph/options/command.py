"""What every command has in common, and how its fields become options."""

from dataclasses import dataclass
from typing import Annotated, Final

from cyclopts import Group, Parameter

INLINE: Final = Parameter(name="*")
"""Settings whose options have no prefix."""
FILE: Final = Parameter(allow_leading_hyphen=True)
"""A single file to write, where `-` is standard output."""

_EVERY: Final = Parameter(negative=(), group=Group("Every command", sort_key=3))


def suggest(*names: str) -> Parameter:
    """Complete these names in a shell; others are accepted too, such as estimators of other packages."""
    return Parameter(completer=lambda _: names)


@dataclass(frozen=True, kw_only=True)
class Command:
    """Options of every command."""

    quiet: Annotated[bool, Parameter(name=("--quiet", "-q")), _EVERY] = False
    """Print errors and hints only."""
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v")), _EVERY] = False
    """Print progress in lines, and where an error comes from."""
    json: Annotated[bool, _EVERY] = False
    """Print the result as JSON."""


@dataclass(frozen=True, kw_only=True)
class FolderCommand(Command):
    """Options of a command that writes one folder."""

    force: Annotated[bool, Parameter(negative=())] = False
    """Replace an earlier result in the folder."""
