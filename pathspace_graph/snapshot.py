"""Snapshots: a whole estimator as one file, from which it goes on as if it had never stopped.

A file is data: classes are found by name in a table of those that estimators are made of, foreign types have
codecs, and no code comes from the file. See `io.object_graph` and `io.snapshot`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import gtsam
import numpy as np
from joblib.externals.loky import Future
from scipy.spatial import KDTree

from pathspace_graph.factors.linear_arrays import (
    conditional_of,
    frontals_of,
    hessian_factor_of,
    hessian_matrix,
    jacobian_factor_of,
    jacobian_matrix,
    keys_of_factor,
)
from pathspace_graph.graph.keys import sizes
from pathspace_graph.io.object_graph import FORMAT_ERRORS, Codec, Decoder, Encoder
from pathspace_graph.io.snapshot import read_snapshot, write_snapshot

from .checkpoint import Recovery
from .errors import InputError, PathspaceError

E = TypeVar("E")

PACKAGE: Final = "pathspace_graph."
ROOMS: Final = (
    "batch",
    "ckf",
    "factors",
    "front_end",
    "graph",
    "health",
    "io.log",
    "landmark",
    "loop",
    "mapping",
    "online",
    "scale",
    "settings",
    "spline",
)
"""Estimators are made of the classes of these rooms and modules."""


def save(estimator: object, path: Path | str) -> None:
    """Writes all of an estimator to one file, and changes nothing of it.

    An earlier file is kept as a numbered backup. SettingsError where it holds something that cannot be saved.
    """
    write_snapshot(path, *Encoder(known_classes(), CODECS).encode(estimator))


def restore(path: Path | str, kind: type[E], check: Callable[[E], object]) -> E:
    """Returns the estimator of a type that a file holds; an InputError of one line says why it cannot.

    `check` is called with a second copy, and must raise nothing.
    """
    file = Path(path)
    structure, data = read_snapshot(file)
    try:
        check(_decoded(structure, data, kind))
        return _decoded(structure, data, kind)
    except (*FORMAT_ERRORS, PathspaceError) as error:
        told = " ".join(str(error).split())
        raise InputError(file, f"expected a {kind.__name__}: {type(error).__name__}: {told}"[:400]) from error


def _decoded(structure: Any, data: bytes, kind: type[E]) -> E:
    found = Decoder(known_classes(), CODECS).decode(structure, data)
    if type(found) is not kind:
        raise TypeError(f"found a {type(found).__name__}")
    return found


def known_classes() -> dict[str, type]:
    """Returns every class of the modules that are loaded, by its name without the package's own."""
    rooms = tuple(PACKAGE + room for room in ROOMS)
    found = {}
    for name, module in [*sys.modules.items()]:
        if module is not None and (name in rooms or name.startswith(tuple(f"{room}." for room in rooms))):
            for one in vars(module).values():
                if isinstance(one, type) and one.__module__ == name:
                    found[f"{name}.{one.__qualname__}".removeprefix(PACKAGE)] = one
    return found


def _graph(kind: Callable[[], Any]) -> tuple[Callable[[Any], tuple[Any, ...]], Callable[..., Any]]:
    """Returns how a graph or a net is taken apart, and made again of its factors."""

    def parts(graph: Any) -> tuple[Any, ...]:
        return tuple(graph.at(i) for i in range(graph.size()))

    def make(*factors: Any) -> Any:
        graph = kind()
        for factor in factors:
            graph.push_back(factor)
        return graph

    return parts, make


def _conditional_parts(conditional: gtsam.GaussianConditional) -> tuple[Any, ...]:
    keys = keys_of_factor(conditional)
    return keys, frontals_of(conditional, sizes(keys).tolist()), jacobian_matrix(conditional)


CODECS: Final = {
    "graph": Codec(gtsam.GaussianFactorGraph, *_graph(gtsam.GaussianFactorGraph)),
    "net": Codec(gtsam.GaussianBayesNet, *_graph(gtsam.GaussianBayesNet)),
    "conditional": Codec(
        gtsam.GaussianConditional,
        _conditional_parts,
        lambda keys, frontals, matrix: conditional_of(keys, sizes(keys), frontals, matrix),
    ),
    "jacobian": Codec(
        gtsam.JacobianFactor,
        lambda factor: (keys_of_factor(factor), jacobian_matrix(factor)),
        lambda keys, matrix: jacobian_factor_of(keys, sizes(keys), matrix),
    ),
    "hessian": Codec(
        gtsam.HessianFactor,
        lambda factor: (keys_of_factor(factor), hessian_matrix(factor)),
        lambda keys, matrix: hessian_factor_of(keys, sizes(keys), matrix),
    ),
    "tree": Codec(KDTree, lambda tree: (np.array(tree.data),), KDTree),
    "recovery": Codec(Recovery, lambda recovery: (recovery.failures,), Recovery),
    "future": Codec(Future, lambda _: (), lambda: None),
}
"""Types of other packages by name; what another process is about to give is asked for again."""
