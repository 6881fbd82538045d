"""Measurement mathematics on plain arrays: B-splines, residuals and their Jacobians, and GTSAM adapters."""

try:
    from ._kernels import COMPILER  # noqa: F401 - so that a missing build is told before anything else
except ModuleNotFoundError:
    raise ImportError("pathspace_graph.factors._kernels is missing: run pip install -e .") from None
