"""Measurement mathematics on plain arrays: B-splines, residuals and their Jacobians, and GTSAM adapters."""

try:
    from . import _kernels  # noqa: F401 - so that a missing build is told before anything else
except ModuleNotFoundError:
    message = "pathspace_graph.factors._kernels is missing: run pip install -e ."
    raise ImportError(message) from None
