"""Snapshots: an estimator in one file, from which it continues to the same map.

A file has a line with its format, a line with the SHA-256 of the rest, and a pickle of the estimator. It is
verified before it is read. It contains no code: it can call only `new`, which creates an object of one of our
own classes without its constructor, and `MAKERS`. Only the version of the package that wrote it can read it.
"""

import io
import pickle
import pickletools
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from functools import cached_property
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import gtsam
import numpy as np
from joblib.externals.loky import Future
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors import linear
from pathspace_graph.factors._kernels import RowStore
from pathspace_graph.graph.gaussian import factors_of, graph_of
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import sizes
from pathspace_graph.io.files import atomic_file
from pathspace_graph.io.parsing import read_bytes, shown

from .errors import InputError, PathspaceError, SettingsError

E = TypeVar("E")

SNAPSHOT: Final = f"pathspace-snapshot/3 of pathspace-graph {version('pathspace-graph')}"
ROOMS: Final = tuple(  # rooms and modules with classes of estimators
    f"{__package__}.{room}"
    for room in (
        *("baselines", "batch", "factors", "front_end", "graph", "health", "io.log", "lengths", "loop"),
        *("mapping", "online", "settings", "spline"),
    )
)
DTYPES: Final = ("<f8", "<i8", "|b1", "<i4", "<u8", "|u1", "|i1")
OPERATIONS: Final = frozenset(
    (
        *("PROTO", "FRAME", "MARK", "MEMOIZE", "BINGET", "LONG_BINGET", "REDUCE", "BUILD", "STOP"),
        *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
        *("SHORT_BINBYTES", "BINBYTES", "SHORT_BINUNICODE", "BINUNICODE", "STACK_GLOBAL"),
        *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "APPEND", "APPENDS"),
        *("EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_SET", "ADDITEMS", "FROZENSET"),
    )
)
"""Pickle operations that `save` writes."""
FORMAT_ERRORS: Final = (  # errors of an inconsistent file, including Recursion- and UnicodeError
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, MemoryError),
    *(OSError, EOFError, ImportError, pickle.UnpicklingError),
)


def save(estimator: object, path: Path | str) -> None:
    """Write an estimator to one file; SettingsError if a part of it cannot be saved."""
    stream = io.BytesIO()
    _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(estimator)
    content = stream.getvalue()
    with atomic_file(path) as temporary:
        temporary.write_bytes(b"\n".join([SNAPSHOT.encode(), sha256(content).hexdigest().encode(), content]))


def restore(path: Path | str, kind: type[E], check: Callable[[E], object]) -> E:
    """Read an estimator from a file; InputError if there is none, or `check` raises for a copy."""
    file = Path(path)
    content = _verified(file)
    try:
        _check_operations(content)
        trial, found = (_Unpickler(io.BytesIO(content)).load() for _ in range(2))
        if type(found) is not kind:
            raise TypeError(f"found a {type(found).__name__}")
        check(trial)
    except (*FORMAT_ERRORS, PathspaceError) as error:
        told = " ".join(str(error).split())
        raise InputError(file, f"expected a {kind.__name__}: {type(error).__name__}: {told}"[:400]) from error
    return found


def _check_operations(content: bytes) -> None:
    """Raise an UnpicklingError for an operation that `save` does not write.

    Others may allocate memory by a number in the file, or emit warnings.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for operation, _, at in pickletools.genops(content):
            if operation.name not in OPERATIONS:
                raise pickle.UnpicklingError(f"expected no {operation.name}, found one at byte {at}")


def _verified(file: Path) -> bytes:
    """Return the pickle of a file; InputError for another format or a wrong checksum."""
    head, _, rest = read_bytes(file, "a snapshot").partition(b"\n")
    if head != SNAPSHOT.encode():
        raise InputError(file, f"expected {SNAPSHOT}, found {shown(head[:80].decode(errors='replace'))}")
    digest, _, content = rest.partition(b"\n")
    if sha256(content).hexdigest().encode() != digest:
        raise InputError(file, "expected a snapshot as it was written, found another content")
    return content


# --- functions that restore objects from their parts -----------------------------------------------------


def array_of(content: bytes, dtype: str, shape: tuple[int, ...], order: Any, writeable: bool) -> NDArray[Any]:
    """Restore an array of one of `DTYPES`, with its memory order if it was contiguous."""
    if dtype not in DTYPES:
        raise ValueError(f"expected one of the types {', '.join(DTYPES)}, found {shown(dtype)}")
    array = np.frombuffer(content, dtype).copy().reshape(shape, order=order)
    array.flags.writeable = bool(writeable)
    return array


def _array_parts(array: NDArray[Any]) -> tuple[Any, ...]:
    if array.dtype.str not in DTYPES:
        raise SettingsError(f"snapshot: expected an array of numbers, found one of {array.dtype}")
    order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    return array.tobytes(order), array.dtype.str, array.shape, order, array.flags.writeable


def number_of(array: NDArray[Any]) -> Any:
    """Restore a NumPy scalar from an array without axes."""
    return array[()]


def new(module: str, name: str) -> object:
    """Create an object of one of our classes without its constructor."""
    found = getattr(sys.modules.get(module), name, None) if _is_own(module) else None
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"expected a class of an estimator, found {shown(f'{module}.{name}')}")
    return object.__new__(found)


def tree_of(points: NDArray[np.float64]) -> KDTree:
    """Restore the tree of points (n, d)."""
    return KDTree(points)


def nothing() -> None:
    """Restore a future as None: its work is submitted again."""


def store_of(*groups: tuple[Any, Any, Any, Any]) -> RowStore:
    """Restore a store from groups of rows: keys, derivatives, residuals and owners."""
    return RowStore([Rows(*parts) for parts in groups])


def bayes_net_of(*conditionals: gtsam.GaussianConditional) -> gtsam.GaussianBayesNet:
    """Restore a net of conditionals, in this order."""
    net = gtsam.GaussianBayesNet()
    for conditional in conditionals:
        net.push_back(conditional)
    return net


def conditional_of(keys: Any, matrix: Any, frontals: int) -> gtsam.GaussianConditional:
    """Restore a conditional of the first `frontals` keys (k,) with the matrix `[A b]`."""
    return linear.conditional_of(keys, sizes(keys), frontals, matrix)


def jacobian_of(keys: Any, matrix: Any) -> gtsam.JacobianFactor:
    """Restore a factor of keys (k,) with the matrix `[A b]`."""
    return linear.jacobian_factor_of(keys, sizes(keys), matrix)


def hessian_of(keys: Any, matrix: Any) -> gtsam.HessianFactor:
    """Restore a factor of keys (k,) with its augmented information matrix."""
    return linear.hessian_factor_of(keys, sizes(keys), matrix)


def _jacobian_parts(factor: gtsam.JacobianFactor) -> tuple[Any, ...]:
    return linear.keys_of_factor(factor), linear.jacobian_matrix(factor)


def _conditional_parts(conditional: gtsam.GaussianConditional) -> tuple[Any, ...]:
    keys, matrix = _jacobian_parts(conditional)
    return keys, matrix, linear.frontals_of(conditional, sizes(keys).tolist())


def _hessian_parts(factor: gtsam.HessianFactor) -> tuple[Any, ...]:
    return linear.keys_of_factor(factor), linear.hessian_matrix(factor)


# for types of other packages: the function that restores an instance, and its parts
MAKERS: Final[dict[type, tuple[Callable[..., Any], Callable[[Any], Iterable[Any]]]]] = {
    np.ndarray: (array_of, _array_parts),
    slice: (slice, lambda span: (span.start, span.stop, span.step)),
    deque: (deque, lambda ring: ([*ring], ring.maxlen)),
    KDTree: (tree_of, lambda tree: (np.array(tree.data),)),
    Future: (nothing, lambda _: ()),
    RowStore: (store_of, RowStore.parts),
    gtsam.GaussianFactorGraph: (graph_of, factors_of),
    gtsam.GaussianBayesNet: (bayes_net_of, factors_of),
    gtsam.GaussianConditional: (conditional_of, _conditional_parts),
    gtsam.JacobianFactor: (jacobian_of, _jacobian_parts),
    gtsam.HessianFactor: (hessian_of, _hessian_parts),
}
_CALLED: Final = [new, number_of, *(make for make, _ in MAKERS.values())]


def _is_own(module: str) -> bool:
    return any(module == room or module.startswith(f"{room}.") for room in ROOMS)


class _Pickler(pickle.Pickler):
    def reducer_override(self, one: Any) -> Any:
        """Return a call that restores an object; cached properties are left out."""
        kind = type(one)
        if kind in MAKERS:
            make, parts = MAKERS[kind]
            return make, tuple(parts(one))
        if isinstance(one, np.generic):
            return number_of, (np.asarray(one),)
        if any(one is call for call in _CALLED):
            return NotImplemented
        if not _is_own(kind.__module__):
            raise SettingsError(f"snapshot: expected what can be saved, found a {kind.__qualname__}")
        if isinstance(one, str):
            return NotImplemented
        kept = {
            name: value
            for name, value in vars(one).items()
            if not isinstance(getattr(kind, name, None), cached_property)
        }
        return new, (kind.__module__, kind.__name__), kept


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return one of the functions that restore objects, and nothing else."""
        for call in _CALLED:
            if (module, name) == (call.__module__, call.__qualname__):
                return call
        raise pickle.UnpicklingError(f"expected a maker of an estimator's parts, found {module}.{name}")
