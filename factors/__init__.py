"""Measurement mathematics on plain arrays: B-splines, residuals and their Jacobians, and GTSAM adapters."""
