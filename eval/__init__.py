"""Evaluation: metrics, yardsticks, tables and figures."""
