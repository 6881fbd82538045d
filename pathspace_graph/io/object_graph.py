"""A graph of objects as plain lists and one block of bytes, and back again to the last bit.

Objects may refer to each other in circles, and what is held twice is held twice afterwards. Arrays that share
memory share it afterwards. A value is null, a boolean, a number or a text as in JSON, or a list:

    ["nan"], ["inf"], ["-inf"]    a number that JSON does not have
    [7]                           the node with this number

A node is a list that begins with its kind:

    ["list", value, ...]          also tuple, set, frozenset, and slice with three values
    ["deque", longest, value, ...]
    ["dict", key, value, key, value, ...]
    ["number", dtype, value]      a number of numpy's
    ["array", dtype, shape, strides, offset in the block, writeable]
    ["object", class, value, ...] by the class's number, the attributes in its order
    ["made", codec, value, ...]   by a codec, from values that it knows

Only classes and codecs that the caller names are known. No code is found by a name from a file: an object is
made without its constructor, and its attributes must be those that its class sets.
"""

from __future__ import annotations

import dis
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property
from itertools import chain, pairwise
from types import UnionType
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError

from .limits import shown

Structure = dict[str, Any]
"""This holds the root's value, the nodes, and the classes with the names of their attributes."""
Classes = Mapping[str, type]
"""These are the known classes by name."""

FORMAT_ERRORS: Final = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
)
"""Decoding raises one of these where a structure does not fit together; `RecursionError` is among them."""
_DTYPES: Final = ("<f8", "<i8", "|b1", "<i4", "<u8", "|u1", "|i1")
"""Arrays have one of these types."""
_ALIGNMENT: Final = 64
_OFFSET: Final = 4
_SEQUENCES: Final[dict[str, Callable[[list[Any]], Any]]] = {
    "tuple": tuple,
    "frozenset": frozenset,
    "slice": lambda values: slice(*values),
}
_CONTENTS: Final[dict[type, Callable[[Any], Iterable[Any]]]] = {
    list: iter,
    tuple: iter,
    set: lambda value: sorted(value, key=repr),
    frozenset: lambda value: sorted(value, key=repr),
    dict: lambda value: chain.from_iterable(value.items()),
    deque: lambda value: (value.maxlen, *value),
    slice: lambda value: (value.start, value.stop, value.step),
}
_MUTABLE: Final[dict[str, type]] = {"list": list, "set": set, "dict": dict, "deque": deque}
_FLOATS: Final = ("nan", "inf", "-inf")


@dataclass(frozen=True)
class Codec:
    """A codec takes instances of one foreign type apart, and makes them again."""

    type: type
    """Exactly the instances of this type are meant."""
    parts: Callable[[Any], tuple[Any, ...]]
    """This returns what an instance is made of: numbers, arrays, and instances of other codecs."""
    make: Callable[..., Any]
    """This makes the instance of the same parts, or raises where they are not as they should be."""


@cache
def attributes_of(kind: type) -> tuple[frozenset[str], frozenset[str]]:
    """Returns the names of the attributes that an instance must have, and of those that it may have."""
    if is_dataclass(kind):
        names = frozenset(field.name for field in fields(kind))
        return names, names
    always, ever = set[str](), set[str]()
    for base in kind.__mro__:
        for name, member in vars(base).items():
            stored = _stored(getattr(member, "fget", None) or getattr(member, "__func__", None) or member)
            ever |= stored
            always |= stored if name == "__init__" else set()
    return frozenset(always), frozenset(ever)


def _stored(function: Any) -> set[str]:
    """Returns the names of the attributes of its own object that a method sets, or one that it wraps."""
    code, inner = getattr(function, "__code__", None), getattr(function, "__wrapped__", None)
    own = set() if inner is None else _stored(inner)
    if code is None or not code.co_varnames:
        return own
    steps = [*dis.get_instructions(code)]
    return own | {
        str(step.argval)
        for before, step in pairwise(steps)
        if step.opname == "STORE_ATTR" and _loads(before, code.co_varnames[0])
    }


def _loads(step: dis.Instruction, name: str) -> bool:
    """Returns whether a step ends with a variable on the stack; newer Pythons join two loads to one step."""
    last = step.argval[-1] if isinstance(step.argval, tuple) else step.argval
    return last == name and any(load in step.opname for load in ("LOAD_FAST", "LOAD_DEREF"))


# --- from objects to a structure ---------------------------------------------------------------------------


class Encoder:
    """Walks the objects that can be reached from a root, and writes each of them once."""

    def __init__(self, classes: Classes, codecs: Mapping[str, Codec]) -> None:
        self._class_names = {kind: name for name, kind in classes.items()}
        self._codec_names = {codec.type: name for name, codec in codecs.items()}
        self._codecs = codecs
        self._rows: dict[tuple[type, tuple[str, ...]], int] = {}
        self._reached: list[tuple[Any, str]] = []  # it keeps them alive, so that no `id` is used twice
        self._numbers: dict[int, int] = {}
        self._arrays: list[tuple[NDArray[Any], list[Any]]] = []
        self._holder = ""

    def encode(self, root: Any) -> tuple[Structure, bytes]:
        """Returns the structure and the block of bytes; SettingsError where something cannot be saved."""
        value, nodes = self._value(root), list[Any]()
        for one, holder in self._reached:  # the list grows meanwhile
            self._holder = holder
            nodes.append(self._node(one))
        data = _lay_out(self._arrays)
        classes = [[self._class_names[kind], [*names]] for kind, names in self._rows]
        return {"root": value, "classes": classes, "nodes": nodes}, data

    def _value(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else [str(value)]
        number = self._numbers.get(id(value))
        if number is None:
            number = self._numbers[id(value)] = len(self._reached)
            self._reached.append((value, self._holder))
        return [number]

    def _node(self, value: Any) -> list[Any]:
        kind = type(value)
        if kind is np.ndarray:
            return self._array(value)
        if kind in self._class_names:
            return self._object(value)
        if isinstance(value, np.generic) and value.dtype.str in _DTYPES:
            return ["number", value.dtype.str, self._value(value.item())]
        if kind in _CONTENTS:
            return [kind.__name__, *map(self._value, _CONTENTS[kind](value))]
        return self._made(value)

    def _made(self, value: Any) -> list[Any]:
        name = self._codec_names.get(type(value))
        if name is None:
            kind = f"{type(value).__module__}.{type(value).__qualname__}"
            raise SettingsError(f"snapshot: expected what can be saved in {self._holder}, found a {kind}")
        return ["made", name, *map(self._value, self._codecs[name].parts(value))]

    def _array(self, array: NDArray[Any]) -> list[Any]:
        if array.dtype.str not in _DTYPES:
            expected = f"expected an array of numbers in {self._holder}"
            raise SettingsError(f"snapshot: {expected}, found one of {array.dtype}")
        if array.size and 0 in array.strides:
            array = array.copy()
        strides = [*array.strides] if array.size else []
        node = ["array", array.dtype.str, [*array.shape], strides, 0, array.flags.writeable]
        self._arrays.append((array, node))
        return node

    def _object(self, value: Any) -> list[Any]:
        kind = type(value)
        held = {name: one for name, one in vars(value).items() if not _is_cached(kind, name)}
        number = self._rows.setdefault((kind, tuple(held)), len(self._rows))
        self._holder = kind.__name__
        return ["object", number, *map(self._value, held.values())]


def _is_cached(kind: type, name: str) -> bool:
    return isinstance(getattr(kind, name, None), cached_property)


def _lay_out(arrays: list[tuple[NDArray[Any], list[Any]]]) -> bytes:
    """Returns the block of bytes of all arrays, and notes in the node of each where it begins.

    Arrays that overlap in memory overlap in the block as well. Bytes that belong to no array are zero.
    """
    bounds, end = [_bounds(array) for array, _ in arrays], 0
    for group in sorted(_overlapping(bounds)):
        begin = -(-end // _ALIGNMENT) * _ALIGNMENT
        low, high = min(bounds[i][0] for i in group), max(bounds[i][1] for i in group)
        for i in group:
            arrays[i][1][_OFFSET] = begin + _address(arrays[i][0]) - low
        end = begin + high - low
    block = np.zeros(end, np.uint8)
    for array, node in arrays:
        _view(block, node)[...] = array
    return block.tobytes()


def _overlapping(bounds: list[tuple[int, int]]) -> list[list[int]]:
    """Returns the groups of intervals that overlap, by their indices; intervals of no length are left out."""
    groups, last = list[list[int]](), -1
    for i in sorted(range(len(bounds)), key=bounds.__getitem__):
        low, high = bounds[i]
        if low < high:
            if low >= last:
                groups.append([])
            groups[-1].append(i)
            last = max(last, high)
    return [sorted(group) for group in groups]


def _address(array: NDArray[Any]) -> int:
    """Returns the address of an array's first element."""
    return int(array.__array_interface__["data"][0])


def _bounds(array: NDArray[Any]) -> tuple[int, int]:
    """Returns the address of the first byte of an array's memory, and of the one after its last."""
    begin = _address(array)
    if array.flags.forc:
        return begin, begin + array.nbytes
    reach = [stride * (count - 1) for stride, count in zip(array.strides, array.shape, strict=True)]
    low, high = sum(min(one, 0) for one in reach), sum(max(one, 0) for one in reach)
    return begin + low, begin + high + array.itemsize


def _view(block: NDArray[np.uint8], node: list[Any]) -> NDArray[Any]:
    """Returns the array of a node as a view of the block; ValueError or TypeError where it does not fit."""
    _, dtype, shape, strides, offset, _ = node
    size = math.prod(shape) * _known_dtype(dtype).itemsize
    if min(shape, default=1) < 0 or size > len(block):
        raise ValueError(f"expected an array inside the block of {len(block)} bytes, found {shown(shape)}")
    if size == 0:
        return np.empty(shape, dtype)
    return np.ndarray(shape, dtype, block, offset, strides)


def _known_dtype(name: Any) -> np.dtype[Any]:
    if name not in _DTYPES:
        raise ValueError(f"expected one of the types {', '.join(_DTYPES)}, found {shown(name)}")
    known: np.dtype[Any] = np.dtype(name)
    return known


# --- from a structure to objects ---------------------------------------------------------------------------


class Decoder:
    """Makes the objects of a structure: those that can be changed first, so that circles can be closed."""

    def __init__(self, classes: Classes, codecs: Mapping[str, Codec]) -> None:
        self._known, self._codecs, self._kinds = classes, codecs, {*classes.values()}
        self._nodes: list[list[Any]] = []
        self._rows: list[tuple[type, list[str]]] = []
        self._made: dict[int, Any] = {}
        self._begun: set[int] = set()
        self._block = np.zeros(0, np.uint8)

    def decode(self, structure: Any, data: bytes) -> Any:
        """Returns the root of a structure; one of FORMAT_ERRORS where it does not fit together."""
        self._block = np.array(np.frombuffer(data, np.uint8))
        self._nodes, self._rows = structure["nodes"], [self._row(*row) for row in structure["classes"]]
        for number, node in enumerate(self._nodes):
            if node[0] == "object":
                self._made[number] = object.__new__(self._rows[_index(node[1])][0])
            elif node[0] == "deque":
                self._made[number] = deque(maxlen=node[1])
            elif node[0] in _MUTABLE:
                self._made[number] = _MUTABLE[node[0]]()
        for number, node in enumerate(self._nodes):
            self._fill(self._at(number), node)
        for made in self._made.values():
            if type(made) in self._kinds and is_dataclass(made):
                _check_fields(made)
        return self._value(structure["root"])

    def _row(self, name: str, names: list[str]) -> tuple[type, list[str]]:
        """Returns a class that is known and the names of its attributes, which must be those it sets."""
        if name not in self._known:
            raise ValueError(f"expected a known class, found {shown(name)}")
        kind = self._known[name]
        needed, possible = attributes_of(kind)
        missing, foreign = sorted(needed - set(names)), sorted(set(names) - possible)
        if missing or foreign or len(set(names)) != len(names):
            found = f"no {missing[0]}" if missing else shown(foreign[0] if foreign else names)
            raise ValueError(f"expected the attributes of {name}, found {found}")
        return kind, names

    def _value(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        (only,) = value
        return float(only) if only in _FLOATS else self._at(_index(only))

    def _at(self, number: int) -> Any:
        """Returns the object of a node, and makes it first where all that it needs can be made."""
        if number not in self._made:
            if number in self._begun:
                raise ValueError(f"expected what can be made, found node {number} within itself")
            self._begun.add(number)
            self._made[number] = self._make(self._nodes[number])
        return self._made[number]

    def _make(self, node: list[Any]) -> Any:
        kind, *rest = node
        if kind == "array":
            array = _view(self._block, node)
            if array.dtype == bool and array.size and array.view(np.uint8).max() > 1:
                raise ValueError("expected flags of 0 and 1, found others")
            array.flags.writeable = bool(node[-1])
            return array
        if kind == "number":
            dtype, value = rest
            return _known_dtype(dtype).type(self._value(value))
        values = [self._value(one) for one in (rest[1:] if kind == "made" else rest)]
        return self._codecs[rest[0]].make(*values) if kind == "made" else _SEQUENCES[kind](values)

    def _fill(self, made: Any, node: list[Any]) -> None:
        """Gives an object that can be changed what it holds."""
        kind, *rest = node
        if kind in ("list", "deque"):
            made.extend(map(self._value, rest[1:] if kind == "deque" else rest))
        elif kind == "set":
            made.update(map(self._value, rest))
        elif kind == "dict":
            values = map(self._value, rest)
            made.update(zip(values, values, strict=True))
        elif kind == "object":
            names = self._rows[rest[0]][1]
            vars(made).update(zip(names, map(self._value, rest[1:]), strict=True))


def _index(number: Any) -> int:
    if type(number) is not int or number < 0:
        raise ValueError(f"expected a number of a node, found {shown(number)}")
    return number


# --- what a dataclass says of its fields -------------------------------------------------------------------

_NUMBERS: Final = {
    float: (float, int, np.floating, np.integer),
    int: (int, np.integer),
    bool: (bool, np.bool_),
}
"""A value of one of these types is enough for a field of a number."""


def _check_fields(made: Any) -> None:
    """Raises a TypeError where a field is of another type, or what the class raises for its own numbers."""
    kind: Any = type(made)
    for name, hint in _hints(kind).items():
        value = getattr(made, name)
        if not isinstance(value, _kinds(hint)):
            expected = f"expected a {getattr(hint, '__name__', hint)} as {kind.__name__}.{name}"
            raise TypeError(f"{expected}, found {shown(value)}")
    if hasattr(made, "__post_init__"):
        copy(made).__post_init__()  # it may give its object new fields


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _kinds(hint: Any) -> tuple[type, ...]:
    """Returns the types of the values that a field may have, of which only the outermost are checked."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return tuple(kind for one in get_args(hint) for kind in _kinds(one))
    if origin is Literal:
        return (str,)
    kind = object if isinstance(hint, TypeVar) or hint is Any else (origin or hint)
    return _NUMBERS.get(kind, (kind,))
