"""Plausibility: a log is judged before it is mapped, and likely mistakes in it are told with their cause."""
