"""The few exceptions of this library; the command line turns each into one line and exit code 2."""

from __future__ import annotations

from pathlib import Path


class PathspaceError(Exception):
    """This is the base of all errors that a user can mend.

    Its text is one line that says what was expected and what was found.
    """


class InputError(PathspaceError):
    """A user's file is missing or wrong.

    The text names the file, the row (1 is the first line) and what was expected.
    """

    def __init__(self, file: Path | str, message: str, row: int | None = None) -> None:
        self.file = Path(file)
        self.row = row
        where = str(file) if row is None else f"{file}, row {row}"
        super().__init__(f"{where}: {message}")


class OutputError(PathspaceError):
    """An output path cannot be written without losing something that is there already."""


class SettingsError(PathspaceError):
    """A setting is out of its range, or names something unknown."""


class SingularSystemError(PathspaceError):
    """The normal equations are not positive definite, since nothing determines some variable."""
