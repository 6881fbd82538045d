"""A command line as a frozen dataclass: each field is an option, each field of settings a dotted one.

The metadata of a field say what its type does not: `name` is the option's name where it is not the field's,
empty for settings without a prefix, None for a field that no option sets; `place` marks a positional
argument; `words` are completed by the shell.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from inspect import get_annotations
from itertools import takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from pathspace_graph.errors import MAX_INTEGER, SettingsError, check_name

PLACE: Final = {"place": True}
INLINE: Final = {"name": ""}
NO_OPTION: Final = {"name": None}
SHOWN: Final = 80  # most characters of a wrong value in a message
MANY: Final = 10_000  # most words of an option
KINDS: Final[dict[Any, tuple[str, str]]] = {  # what an option takes: in a message, and in the help
    int: ("whole number", "NUMBER"),
    float: ("number", "NUMBER"),
    Path: ("path", "PATH"),
    str: ("text", "TEXT"),
    bool: ("flag without a value", ""),
}


@dataclass(frozen=True)
class Option:
    """An option of a command."""

    path: tuple[str, ...]  # names of the fields from the command to the value
    name: str  # on the command line, dotted
    group: type[Any] | None  # settings that it belongs to, which have a prefix; None for the command's own
    home: type[Any]  # dataclass that has the field
    entry: Field[Any]
    hint: Any

    @property
    def is_place(self) -> bool:
        return "place" in self.entry.metadata

    @property
    def flag(self) -> str:
        return self.name.upper() if self.is_place else f"--{self.name.replace('_', '-')}"

    @property
    def flags(self) -> tuple[str, ...]:
        """The flag, and for a bool the one that sets it to false: `--calibration.no-sensor`."""
        *groups, name = self.flag[2:].split(".")
        return (self.flag, f"--{'.'.join([*groups, f'no-{name}'])}") if self.kind is bool else (self.flag,)

    @property
    def kind(self) -> Any:
        """Type of the value, without None."""
        if get_origin(self.hint) not in (Union, UnionType):
            return self.hint
        return next(one for one in get_args(self.hint) if one is not NoneType)

    @property
    def choices(self) -> tuple[str, ...]:
        """The only words that it takes; empty for any value."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def is_required(self) -> bool:
        return self.entry.default is MISSING

    @property
    def count(self) -> int:
        """Most words that it takes: MANY for a tuple of any length."""
        if get_origin(self.kind) is tuple:
            return MANY if Ellipsis in get_args(self.kind) else len(get_args(self.kind))
        return 0 if self.kind is bool else 1

    @property
    def expected(self) -> str:
        """What it takes, in words."""
        if self.choices:
            return f"one of {', '.join(sorted(self.choices))}"
        word, _ = KINDS[_item(self.kind)]
        return f"a {word}" if self.count in (0, 1, MANY) else f"{self.count} {word}s"

    @property
    def takes(self) -> str:
        """What it takes, as the help shows it: the words to choose from with the default first."""
        if self.choices:
            return "|".join(sorted(self.choices, key=lambda word: word != self.entry.default))
        word = KINDS[_item(self.kind)][1]
        return f"{word}..." if self.count == MANY else " ".join([word] * self.count)

    @property
    def usage(self) -> str:
        return self.flag if self.is_place else f"{self.flag} {self.takes}"

    def value(self, words: Sequence[str], flag: str = "") -> Any:
        """Convert the words after a flag; SettingsError if the option does not take them."""
        if self.kind is bool and not words:
            return flag == self.flag
        if words == ["None"] and NoneType in get_args(self.hint):
            return None
        expected = self.expected
        try:
            if len(words) == self.count or (self.count == MANY and words):
                values = [_converted(word, _item(self.kind)) for word in words]
                return tuple(values) if get_origin(self.kind) is tuple else values[0]
        except OverflowError:
            expected = f"whole numbers up to {MAX_INTEGER}"
        except ValueError:
            pass
        raise SettingsError(f"{self.flag}: expected {expected}, found {_shown(words)}")


def _shown(words: Sequence[str]) -> str:
    return repr(" ".join(words))[:SHOWN] if words else "none"


def _item(kind: Any) -> Any:
    """Type of a single word."""
    return get_args(kind)[0] if get_origin(kind) is tuple else kind


def _converted(word: str, kind: Any) -> Any:
    if get_origin(kind) is Literal:
        return get_args(kind)[get_args(kind).index(word)]
    if kind is int and word.lstrip("+-").isdecimal() and abs(float(word)) > MAX_INTEGER:
        raise OverflowError
    return kind(word)


def options_of(
    kind: type[Any], prefix: str = "", path: tuple[str, ...] = (), group: type[Any] | None = None
) -> Iterator[Option]:
    """Yield the options of a command, its own before those that it inherits."""
    entries: dict[str, Field[Any]] = {entry.name: entry for entry in fields(kind)}
    hints: dict[str, Any] = get_type_hints(kind)
    for name in (name for home in kind.__mro__ for name in get_annotations(home) if name in entries):
        entry, hint = entries[name], hints[name]
        shown = entry.metadata.get("name", name)
        if shown is None:
            continue
        if isinstance(hint, type) and is_dataclass(hint):
            own = group or (hint if shown else None)
            inside = f"{prefix}{shown}." if shown else prefix
            yield from options_of(hint, inside, (*path, name), own)
        else:
            yield Option((*path, name), prefix + shown, group, kind, entry, hint)


def parse(command: type[Any], program: str, words: Sequence[str]) -> Any:
    """Parse the words of a command line; SettingsError for bad usage."""
    options = [*options_of(command)]
    try:
        given = _given(options, words, program.rsplit(maxsplit=1)[-1])
    except SettingsError as error:
        raise SettingsError(f"{error} (see {program} --help)") from None
    base = command.base(given) if hasattr(command, "base") else {}
    values = {option.path: given[option.name] for option in options if option.name in given}
    return _made(command, values, base)


def _given(options: Sequence[Option], words: Sequence[str], name: str) -> dict[str, Any]:
    """Values of the options that are given, by name; SettingsError if any is wrong or missing."""
    flags = {flag: option for option in options if not option.is_place for flag in option.flags}
    given, places, rest = dict[str, Any](), list[str](), [*words]
    while rest:
        word = rest.pop(0)
        if not word.startswith("-") or word == "-":
            places.append(word)
            continue
        flag, *value = word.split("=", maxsplit=1)
        flag = flag.replace("_", "-")
        check_name(flag, flags, f"{name}: expected a known option")
        option = flags[flag]
        if option.name in given:
            raise SettingsError(f"{flag}: expected it once, found it twice")
        following = takewhile(lambda one: not one.startswith("--"), rest)
        own = [*value, *following][: max(option.count, len(value))]
        rest = rest[len(own) - len(value) :]
        given[option.name] = option.value(own, flag)
    if places:
        place = next((option for option in options if option.is_place), None)
        if place is None or len(places) > place.count:
            expected = f"one {place.flag}" if place else "options only"
            raise SettingsError(f"{name}: expected {expected}, found {_shown(places)}")
        given[place.name] = place.value(places)
    missing = [option.usage for option in options if option.is_required and option.name not in given]
    if missing:
        raise SettingsError(f"{name}: expected {' and '.join(missing)}, found none")
    return given


def _made(
    kind: type[Any], given: Mapping[tuple[str, ...], Any], base: Mapping[str, Any], path: tuple[str, ...] = ()
) -> Any:
    """Make a dataclass of the given values by path, else of `base`, else of the defaults."""
    hints: dict[str, Any] = get_type_hints(kind)
    own = dict(base)
    for entry in fields(kind):
        at, hint = (*path, entry.name), hints[entry.name]
        nested = isinstance(hint, type) and is_dataclass(hint)
        if nested and any(other[: len(at)] == at for other in given):
            inner = base.get(entry.name, hint())
            values = {one.name: getattr(inner, one.name) for one in fields(inner)}
            own[entry.name] = _made(hint, given, values, at)
        elif at in given:
            own[entry.name] = given[at]
    return kind(**own)
