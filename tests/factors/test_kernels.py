"""The compiled functions: their signatures, and shapes that they refuse."""

from __future__ import annotations

import ast
from pathlib import Path
from types import BuiltinFunctionType

import numpy as np
import pytest

from pathspace_graph.factors import _kernels as kernels

KERNELS = {name: one for name, one in vars(kernels).items() if isinstance(one, BuiltinFunctionType)}


def test_every_compiled_function_has_a_signature() -> None:
    stub = ast.parse(Path(str(kernels.__file__)).with_name("_kernels.pyi").read_text())
    declared = [node for node in stub.body if isinstance(node, ast.FunctionDef)]
    assert {function.name for function in declared} == set(KERNELS)
    assert all(ast.get_docstring(function) for function in declared)
    for function in declared:
        assert f"arg{len(function.args.args) - 1}:" in str(KERNELS[function.name].__doc__)
        assert f"arg{len(function.args.args)}:" not in str(KERNELS[function.name].__doc__)


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="shapes that fit"):
        kernels.to_map(np.zeros((3, 2)), np.zeros((2, 3)))
