"""The exceptions of this library; the command line turns each into one line and exit code 2 or 3."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, Self


class PathspaceError(Exception):
    """Base of all errors that a user can fix; one line says what was expected and what was found."""


class InputError(PathspaceError):
    """A missing or invalid file; the text names file, row (from 1) and what was expected."""

    def __init__(self, file: Path | str, message: str, row: int | None = None) -> None:
        self.file = Path(file)
        self.row = row
        self.message = message
        where = str(file) if row is None else f"{file}, row {row}"
        super().__init__(f"{where}: {message}")


class ReadingError(PathspaceError):
    """An unusable perception cycle, which changes nothing; the text names field and row (from 0)."""

    def __init__(
        self, field: str, expected: str, found: object, row: int | None = None, t: float | None = None
    ) -> None:
        self.field, self.expected, self.found, self.row = field, expected, found, row
        self.t = t  # stamp of the cycle (s), if it has one
        when = "" if t is None else f"cycle at {t:.12g} s: "
        where = field if row is None else f"{field}, row {row}"
        value = f"{found:.12g}" if isinstance(found, float) else str(found)
        super().__init__(f"{when}{where}: expected {expected}, found {value}")

    def at(self, t: float) -> Self:
        """Add the stamp t (s) of the cycle."""
        return type(self)(self.field, self.expected, self.found, self.row, t)

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        """Pickle the error for worker processes."""
        return type(self), (self.field, self.expected, self.found, self.row, self.t)


class OutputError(PathspaceError):
    """An output path that cannot be written without losing existing files."""


class SettingsError(PathspaceError):
    """A setting out of its range, or an unknown name."""


class SolveError(PathspaceError):
    """An estimate that cannot be computed from valid input; exit code 3."""


class SingularSystemError(SolveError):
    """Normal equations that are not positive definite: some variable is not observable."""


@contextmanager
def solving(what: str) -> Iterator[None]:
    """Convert any other exception in the context to a SolveError about `what`."""
    try:
        yield
    except PathspaceError:
        raise
    except Exception as error:
        raise SolveError(f"{what} has failed: {type(error).__name__}: {error}") from error


def install(extra: str) -> str:
    """Command that installs the packages of an extra beside this one, from a wheel or a checkout."""
    return f"pip install 'pathspace-graph[{extra}]'"


MAX_INTEGER: Final = 2**63 - 1  # in a file or on the command line


def check_name(name: Any, known: Iterable[str], expected: str) -> None:
    """Raise a SettingsError for an unknown name, with the nearest known one, if any is near."""
    known = list(known)
    if name in known:
        return
    begins = [one for one in known if len(str(name)) >= 3 and one.startswith(str(name))]
    near = begins or get_close_matches(str(name), known, n=1)
    hint = f", the nearest is '{near[0]}'" if near else ""
    raise SettingsError(f"{expected}, found '{name}'{hint}")


def check_type(name: str, value: object, kind: type[Any]) -> None:
    """Raise a SettingsError for an argument that is not of a type."""
    if not isinstance(value, kind):
        found = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise SettingsError(f"{name}: expected {article} {kind.__name__}, found {found}")
