"""Snapshots: a whole estimator as one file, from which it goes on as if it had never stopped.

The file is a NumPy archive (.npz) of two arrays of bytes: `structure`, JSON in UTF-8, and `numbers`, the
memory of all arrays. Its comment is the SHA-256 of all before, which is verified first. The structure has
`format`, `classes`, each as [name, layout, names of the attributes], `nodes`, one for an object, and `root`.
A value is null, a boolean, a number or a text as in JSON, [7] for node 7, or ["nan"], ["inf"], ["-inf"]. A
node is one of

    ["object", class, value, ...]      by the class's number, the attributes in its order
    ["array", dtype, shape, strides, offset in the numbers, writeable]
    ["number", value]                  a number of NumPy's, by its array
    [type, value, ...]                 of another type of `TYPES`, by the parts that it is made of

No attribute is forgotten; what is held twice, circles, and overlaps in memory are kept. No code comes from
the file: an object is of a class of the rooms below, and made without its constructor.
"""

import dis
import json
import math
import sys
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import fields, is_dataclass
from functools import cache, cached_property
from hashlib import sha256
from inspect import unwrap
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeVar
from zipfile import BadZipFile, ZipFile

import gtsam
import numpy as np
from joblib.externals.loky import Future
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors import linear as linear_arrays
from pathspace_graph.graph.gaussian import factors_of, graph_of
from pathspace_graph.graph.variables import sizes
from pathspace_graph.io.files import atomic_file
from pathspace_graph.io.parsing import parse_json, read_bytes, shown

from .checkpoint import Recovery
from .errors import InputError, PathspaceError, SettingsError
from .lengths import Length, Text

E = TypeVar("E")
Structure = dict[str, Any]
Bytes = NDArray[np.uint8]

FORMAT: Final = "pathspace-snapshot/2"
PACKAGE: Final = "pathspace_graph."
ROOMS: Final = (  # rooms and modules whose classes estimators are made of
    *("baselines", "batch", "factors", "front_end", "graph", "health", "io.log", "loop", "mapping"),
    *("online", "settings", "spline"),
)
FORMAT_ERRORS: Final = (  # of a file that does not fit together; they include Recursion- and UnicodeError
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, MemoryError),
    *(OSError, EOFError, BadZipFile),
)
_DTYPES: Final = ("<f8", "<i8", "|b1", "<i4", "<u8", "|u1", "|i1")
_ALIGNMENT: Final = 64
_DIGEST_SIZE: Final = 64
_FLOATS: Final = ("nan", "inf", "-inf")


def save(estimator: object, path: Path | str) -> None:
    """Write an estimator to one file; SettingsError where it holds something that cannot be saved."""
    write(path, *Encoder(known_classes()).encode(estimator))


def restore(path: Path | str, kind: type[E], check: Callable[[E], object]) -> E:
    """Return the estimator of a file; InputError where there is none, or `check` of a copy raises."""
    file = Path(path)
    structure, numbers = read(file)
    try:
        trial, found = (Decoder(known_classes()).decode(structure, numbers.copy()) for _ in range(2))
        if type(found) is not kind:
            raise TypeError(f"found a {type(found).__name__}")
        check(trial)
    except (*FORMAT_ERRORS, PathspaceError) as error:
        told = " ".join(str(error).split())
        raise InputError(file, f"expected a {kind.__name__}: {type(error).__name__}: {told}"[:400]) from error
    return found


def write(path: Path | str, structure: Structure, numbers: Bytes) -> None:
    text = json.dumps({"format": FORMAT, **structure}, allow_nan=False, separators=(",", ":")).encode()
    with atomic_file(path) as temporary:
        temporary.write_bytes(archive(text, numbers))


def archive(text: bytes, numbers: Bytes) -> bytes:
    """Return the content of a file; its comment, which is its end, is the SHA-256 of all before."""
    stream = BytesIO()
    np.savez(stream, structure=np.frombuffer(text, np.uint8), numbers=numbers)
    with ZipFile(stream, "a") as zipped:
        zipped.comment = bytes(_DIGEST_SIZE)
    content = stream.getvalue()[:-_DIGEST_SIZE]
    return content + sha256(content).hexdigest().encode()


def read(file: Path) -> tuple[Structure, Bytes]:
    """Return structure and numbers of a file; an InputError where it is not as it was written."""
    whole = read_bytes(file, "a snapshot")
    if whole.startswith(b"pathspace-snapshot/"):
        raise InputError(file, f"expected {FORMAT}, found {shown(whole[:20].decode(errors='replace'))}")
    try:
        if sha256(whole[:-_DIGEST_SIZE]).hexdigest().encode() != whole[-_DIGEST_SIZE:]:
            raise ValueError
        with np.load(BytesIO(whole), allow_pickle=False) as members:
            text, numbers = members["structure"].tobytes().decode(), members["numbers"]
    except FORMAT_ERRORS:
        raise InputError(file, "expected a snapshot as it was written, found another content") from None
    structure = parse_json(text, file)
    if not isinstance(structure, dict) or structure.get("format") != FORMAT:
        raise InputError(file, f"expected {FORMAT}, found {shown(structure)}")
    return structure, numbers


def known_classes() -> dict[str, type]:
    """Return every class of the rooms' modules that are loaded, by its name without the package's own."""
    rooms = tuple(PACKAGE + room for room in ROOMS)
    return {
        f"{name}.{one.__qualname__}".removeprefix(PACKAGE): one
        for name, module in [*sys.modules.items()]
        if name in rooms or name.startswith(tuple(f"{room}." for room in rooms))
        for one in vars(module).values()
        if isinstance(one, type) and one.__module__ == name
    }


@cache
def layout(kind: type) -> dict[str, str]:
    """Return the attributes that the code of a class sets, with their types; another layout is refused."""
    members = [member for base in kind.__mro__ for member in vars(base).values()]
    functions = [getattr(member, "fget", None) or getattr(member, "__func__", member) for member in members]
    functions += [unwrap(function) for function in functions if hasattr(function, "__wrapped__")]
    codes = [function.__code__ for function in functions if hasattr(function, "__code__")]
    steps = chain.from_iterable(map(dis.get_instructions, codes))
    names = dict.fromkeys(sorted({str(step.argval) for step in steps if step.opname == "STORE_ATTR"}), "")
    return names | {one.name: str(one.type) for one in (fields(kind) if is_dataclass(kind) else ())}


def _bayes_net(*conditionals: gtsam.GaussianConditional) -> gtsam.GaussianBayesNet:
    net = gtsam.GaussianBayesNet()
    for conditional in conditionals:
        net.push_back(conditional)
    return net


def _jacobian(factor: gtsam.JacobianFactor) -> tuple[Any, ...]:
    return linear_arrays.keys_of_factor(factor), linear_arrays.jacobian_matrix(factor)


def _conditional(conditional: gtsam.GaussianConditional) -> tuple[Any, ...]:
    keys, matrix = _jacobian(conditional)
    return keys, matrix, linear_arrays.frontals_of(conditional, sizes(keys).tolist())


# how an instance of a container, or of a type of another package, is taken apart, and made of its parts
TYPES: Final[dict[type, tuple[Callable[[Any], Iterable[Any]], Callable[..., Any]]]] = {
    list: (iter, lambda *values: [*values]),
    tuple: (iter, lambda *values: values),
    set: (lambda values: sorted(values, key=repr), lambda *values: {*values}),
    frozenset: (lambda values: sorted(values, key=repr), lambda *values: frozenset(values)),
    dict: (
        lambda entries: chain.from_iterable(entries.items()),
        lambda *values: dict(zip(values[::2], values[1::2], strict=True)),
    ),
    deque: (lambda ring: (ring.maxlen, *ring), lambda longest, *values: deque(values, longest)),
    Text: (lambda text: (text.template, text.figures), lambda template, figures: Text(template, **figures)),
    Length: (lambda length: (length.value, length.power), Length),
    slice: (lambda span: (span.start, span.stop, span.step), slice),
    KDTree: (lambda tree: (np.array(tree.data),), KDTree),
    Recovery: (lambda recovery: (recovery.failures,), Recovery),
    Future: (lambda _: (), lambda: None),  # what a process is about to give is asked for again
    gtsam.GaussianFactorGraph: (factors_of, graph_of),
    gtsam.GaussianBayesNet: (factors_of, _bayes_net),
    gtsam.GaussianConditional: (
        _conditional,
        lambda keys, matrix, frontals: linear_arrays.conditional_of(keys, sizes(keys), frontals, matrix),
    ),
    gtsam.JacobianFactor: (
        _jacobian,
        lambda keys, matrix: linear_arrays.jacobian_factor_of(keys, sizes(keys), matrix),
    ),
    gtsam.HessianFactor: (
        lambda factor: (linear_arrays.keys_of_factor(factor), linear_arrays.hessian_matrix(factor)),
        lambda keys, matrix: linear_arrays.hessian_factor_of(keys, sizes(keys), matrix),
    ),
}
_MAKERS: Final = {kind.__name__: make for kind, (_, make) in TYPES.items()}


class Encoder:
    """Walk of the objects that can be reached from a root; each of them becomes one node."""

    def __init__(self, classes: Mapping[str, type]) -> None:
        self._names = {kind: name for name, kind in classes.items()}
        self._rows: dict[tuple[type, tuple[str, ...]], int] = {}
        self._reached: list[tuple[Any, str]] = []  # it keeps them alive, so that no `id` is used twice
        self._numbers: dict[int, int] = {}
        self._arrays: list[tuple[NDArray[Any], list[Any]]] = []
        self._holder = ""

    def encode(self, root: Any) -> tuple[Structure, Bytes]:
        """Return the structure and the numbers; SettingsError where something cannot be saved."""
        value, nodes = self._value(root), list[Any]()
        for one, holder in self._reached:  # the list grows meanwhile
            self._holder = holder
            nodes.append(self._node(one))
        rows = [[self._names[kind], layout(kind), [*names]] for kind, names in self._rows]
        return {"root": value, "classes": rows, "nodes": nodes}, _lay_out(self._arrays)

    def _value(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else [str(value)]
        if id(value) not in self._numbers:
            self._numbers[id(value)] = len(self._reached)
            self._reached.append((value, self._holder))
        return [self._numbers[id(value)]]

    def _node(self, value: Any) -> list[Any]:
        kind = type(value)
        if kind is np.ndarray and value.dtype.str in _DTYPES:
            value = value.copy() if value.size and 0 in value.strides else value
            node = ["array", value.dtype.str, [*value.shape], [*value.strides], 0, value.flags.writeable]
            self._arrays.append((value, node))
            return node
        if isinstance(value, np.generic):
            return ["number", self._value(np.asarray(value))]
        if kind in self._names:
            cached = {name for name in vars(value) if isinstance(getattr(kind, name, None), cached_property)}
            held = {name: one for name, one in vars(value).items() if name not in cached}
            self._holder = kind.__name__
            number = self._rows.setdefault((kind, tuple(held)), len(self._rows))
            return ["object", number, *map(self._value, held.values())]
        if kind in TYPES:
            return [kind.__name__, *map(self._value, TYPES[kind][0](value))]
        found = f"{kind.__module__}.{kind.__qualname__} {getattr(value, 'dtype', '')}".rstrip()
        raise SettingsError(f"snapshot: expected what can be saved in {self._holder}, found a {found}")


def _lay_out(arrays: list[tuple[NDArray[Any], list[Any]]]) -> Bytes:
    """Return the memory of all arrays, which overlap as before, and note in each node where it begins."""
    bounds, end = [_bounds(array) for array, _ in arrays], 0
    for group in _overlapping(bounds):
        begin, low = -(-end // _ALIGNMENT) * _ALIGNMENT, min(bounds[i][0] for i in group)
        end = begin + max(bounds[i][1] for i in group) - low
        for i in group:
            arrays[i][1][4] = begin + arrays[i][0].__array_interface__["data"][0] - low
    numbers = np.zeros(end, np.uint8)
    for array, node in arrays:
        _view(numbers, node)[...] = array
    return numbers


def _bounds(array: NDArray[Any]) -> tuple[int, int]:
    begin = int(array.__array_interface__["data"][0])
    if array.size == 0:
        return begin, begin
    ends = [stride * (count - 1) for stride, count in zip(array.strides, array.shape, strict=True)]
    low, high = (sum(one for one in ends if one * sign > 0) for sign in (-1, 1))
    return begin + low, begin + high + array.itemsize


def _overlapping(bounds: list[tuple[int, int]]) -> list[list[int]]:
    """Return the groups of intervals that overlap, by their indices in ascending order."""
    groups, last = list[list[int]](), -1
    for i in sorted(range(len(bounds)), key=bounds.__getitem__):
        if bounds[i][0] >= last:
            groups.append([])
        groups[-1].append(i)
        last = max(last, bounds[i][1])
    return sorted(map(sorted, groups))


def _view(numbers: Bytes, node: list[Any]) -> NDArray[Any]:
    """Return the array of a node as a view of the numbers; ValueError or TypeError where it does not fit."""
    _, dtype, shape, strides, offset, _ = node
    if dtype not in _DTYPES:
        raise ValueError(f"expected one of the types {', '.join(_DTYPES)}, found {shown(dtype)}")
    if math.prod(shape) * np.dtype(dtype).itemsize > len(numbers):
        raise ValueError(f"expected an array inside of {len(numbers)} bytes, found {shown(shape)}")
    return np.empty(shape, dtype) if 0 in shape else np.ndarray(shape, dtype, numbers, offset, strides)


class Decoder:
    """Making of the objects of a structure: those of known classes first, so that circles can be closed."""

    def __init__(self, classes: Mapping[str, type]) -> None:
        self._known = classes
        self._made: dict[int, Any] = {}

    def decode(self, structure: Structure, numbers: Bytes) -> Any:
        """Return the root of a structure; one of FORMAT_ERRORS where it does not fit together."""
        self._nodes, self._numbers = structure["nodes"], numbers
        rows = [self._row(*row) for row in structure["classes"]]
        objects = {number: node for number, node in enumerate(self._nodes) if node[0] == "object"}
        self._made |= {number: object.__new__(rows[node[1]][0]) for number, node in objects.items()}
        for number, (_, row, *values) in objects.items():
            vars(self._made[number]).update(zip(rows[row][1], map(self._value, values), strict=True))
        for number in objects:
            if hasattr(self._made[number], "__post_init__"):
                copy(self._made[number]).__post_init__()  # settings must be in their ranges
        return self._value(structure["root"])

    def _row(self, name: str, stated: dict[str, str], names: list[str]) -> tuple[type, list[str]]:
        """Return a known class and the names of its attributes, which must be among those that it sets."""
        if name not in self._known:
            raise ValueError(f"expected a known class, found {shown(name)}")
        known = layout(self._known[name])
        other = [one for one in {**known, **stated} if known.get(one) != stated.get(one)]
        if other := other or [one for one in names if one not in known]:
            expected = f"expected the attributes of {name} in this version"
            raise ValueError(f"{expected}, found another {shown(other[0])}")
        return self._known[name], names

    def _value(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        (only,) = value
        if only in _FLOATS:
            return float(only)
        if only not in self._made:
            self._made[only] = self._make(self._nodes[only])
        return self._made[only]

    def _make(self, node: list[Any]) -> Any:
        kind, *rest = node
        if kind == "array":
            array = _view(self._numbers, node)
            if array.dtype == bool and array.size and array.view(np.uint8).max() > 1:
                raise ValueError("expected flags of 0 and 1, found others")
            array.flags.writeable = bool(node[-1])
            return array
        values = [self._value(one) for one in rest]
        return values[0][()] if kind == "number" else _MAKERS[kind](*values)
