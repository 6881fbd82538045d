"""Measurement mathematics on plain arrays: B-splines, residuals and their Jacobians, and GTSAM adapters."""

try:
    from ._kernels import COMPILER  # noqa: F401 - report a missing build before any other error
except ModuleNotFoundError:
    raise ImportError("pathspace_graph.factors._kernels is missing: run pip install -e .") from None
