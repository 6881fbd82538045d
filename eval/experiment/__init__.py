"""Experiments: estimators and settings on many logs, in parallel, as one frame that every table shows."""
