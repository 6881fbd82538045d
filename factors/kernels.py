"""Compiled versions of functions of arrays, where the package was built with a compiler.

A function in numpy that is decorated with `compiled` is what is documented, what runs without a compiler, and
what the compiled version of the same name in `kernels.cpp` is tested against.
"""

import os
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

NUMPY_ONLY: Final = "PATHSPACE_NUMPY"  # environment variable that keeps the compiled versions out


def _built() -> Any:
    try:
        return None if os.environ.get(NUMPY_ONLY) else import_module("pathspace_graph.factors._kernels")
    except ImportError:
        return None


_KERNELS: Final = _built()
COMPILED: Final = _KERNELS is not None
KERNELS: Final = "compiled" if COMPILED else "numpy"  # as `summary.json` says it
IN_NUMPY: Final[dict[str, Callable[..., Any]]] = {}  # the versions in numpy by name


def compiled(function: F) -> F:
    """Return the compiled version of a function, or the function where there is none."""
    name = function.__name__.lstrip("_")
    IN_NUMPY[name] = function
    version: F = getattr(_KERNELS, name, function)
    return version
