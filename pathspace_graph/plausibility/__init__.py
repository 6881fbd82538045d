"""Plausibility: a log is judged before it is mapped, and what is wrong with it is told with its likely cause."""
