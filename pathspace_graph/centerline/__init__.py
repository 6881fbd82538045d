"""Estimators that map a track as one centre line with a width, the paper's future work."""
