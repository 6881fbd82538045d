"""The paper's spline filter."""
