"""Every estimator on the same logs, side by side."""
