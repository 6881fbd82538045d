"""Evaluation: metrics, reference limits, tables and figures."""
