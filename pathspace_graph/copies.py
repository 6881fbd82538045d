"""Shallow copies of objects, which are made in every cycle."""

from typing import TypeVar

T = TypeVar("T")


def shallow(one: T) -> T:
    """Return an object with the same attributes, as `copy.copy` does in five times the time."""
    other = object.__new__(type(one))
    vars(other).update(vars(one))
    return other
