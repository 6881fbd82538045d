"""Graphs of objects: circles, shared memory and every bit come back, and only what is known is made."""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.errors import SettingsError
from pathspace_graph.snapshot import FORMAT_ERRORS, Decoder, Encoder, layout


class Node:
    """Refers to others."""

    def __init__(self, value: Any = None) -> None:
        self.value = value
        self.next: Node | None = None
        self._asked = 0

    @property
    def asked(self) -> int:
        self._count = self._asked = self._asked + 1
        return self._asked

    @cached_property
    def costly(self) -> object:
        return object()

    def rename(self, other: Node) -> None:
        self.value, self.name = other.value, "new"
        other.foreign = 1  # type: ignore[attr-defined]


class Heir(Node):
    """Has more."""

    def __init__(self) -> None:
        super().__init__()
        self.more = [self.value for _ in range(2)]


@dataclass(frozen=True)
class Point:
    """Checks its own numbers."""

    x: float
    name: str = ""
    tags: tuple[int, ...] = ()
    array: np.ndarray[Any, Any] | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.x < 0.0:
            raise SettingsError("x: expected a number of at least 0")


CLASSES = {"node": Node, "heir": Heir, "point": Point}


def there_and_back(value: Any) -> Any:
    structure, numbers = Encoder(CLASSES).encode(value)
    return Decoder(CLASSES).decode(json.loads(json.dumps(structure, allow_nan=False)), numbers)


def decoded(nodes: list[Any], classes: list[Any] | None = None, data: bytes = bytes(64)) -> Any:
    return Decoder(CLASSES).decode(
        {"root": [0], "classes": classes or [], "nodes": nodes}, np.frombuffer(data, np.uint8).copy()
    )


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False) | st.text(),
    lambda inner: (
        st.lists(inner)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text() | st.integers(), inner)
        | st.frozensets(st.integers())
        | st.sets(st.text())
        | st.builds(lambda values: deque(values, 3), st.lists(inner))
    ),
)


@given(value=PLAIN)
def test_plain_values_come_back(value: Any) -> None:
    found = there_and_back(value)
    assert repr(found) == repr(value) or found == value
    assert type(found) is type(value)


def test_numbers_that_json_does_not_have_come_back() -> None:
    nan, plus, minus = there_and_back([math.nan, math.inf, -math.inf])
    assert math.isnan(nan) and plus == math.inf and minus == -math.inf


@pytest.mark.parametrize("value", [np.float64(0.1), np.float64("nan"), np.int64(-5), np.bool_(True)])
def test_numpys_numbers_stay_numpys(value: np.generic) -> None:
    found = there_and_back(value)
    assert type(found) is type(value)
    np.testing.assert_equal(found, value)


def test_a_circle_is_a_circle_and_what_is_held_twice_is_one() -> None:
    first, second = Node([1]), Heir()
    first.next, second.next, second.value = second, first, (first.value, first)
    found = there_and_back(first)
    assert type(found.next) is Heir and found.next.next is found
    assert found.next.value[0] is found.value and found.next.value[1] is found


def test_values_that_are_computed_where_they_are_asked_for_are_left_out() -> None:
    node = Node()
    assert node.costly is node.costly
    assert "costly" not in vars(there_and_back(node))


# --- arrays ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(24.0).reshape(4, 6)[1:3, ::-2],
        np.arange(5)[::-1],
        np.array([True, False]),
        np.zeros((0, 2)),
        np.zeros((3, 0), order="F"),
        np.array(2.5),
        np.array([np.nan, -0.0, np.inf]),
    ],
    ids=str,
)
def test_an_array_keeps_its_bytes_its_type_and_its_order(array: np.ndarray[Any, Any]) -> None:
    found = there_and_back(array)
    assert found.dtype == array.dtype and found.shape == array.shape
    assert found.tobytes() == array.tobytes()
    if array.size:
        assert found.strides == array.strides


def test_arrays_that_share_memory_share_it_afterwards_and_others_do_not() -> None:
    whole = np.arange(12.0).reshape(4, 3)
    values = [whole[1], whole, whole[:, 2], np.arange(3.0), whole]
    row, found, column, other, again = there_and_back(values)
    assert again is found
    found[1, 2] = 99.0
    assert row[2] == 99.0 and column[1] == 99.0
    other[:] = 77.0
    assert 77.0 not in found


def test_what_lies_between_the_rows_of_a_view_is_not_written() -> None:
    secret = np.full((3, 2), 42.0)
    secret[:, 0] = 0.0
    _, numbers = Encoder(CLASSES).encode(secret[:, 0])
    assert not numbers.any()


def test_a_repeated_row_becomes_an_array_of_its_own() -> None:
    repeated = np.broadcast_to(np.arange(3.0), (4, 3))
    found = there_and_back(repeated)
    np.testing.assert_array_equal(found, repeated)
    assert found.strides == (24, 8)


def test_an_array_that_must_not_change_still_must_not() -> None:
    fixed = np.arange(3.0)
    fixed.flags.writeable = False
    assert not there_and_back(fixed).flags.writeable


# --- what cannot be saved --------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [object(), len, lambda: None, int, b"", np.array(["a"]), np.array([None])])
def test_anything_else_is_refused_and_its_holder_is_named(value: object) -> None:
    with pytest.raises(SettingsError, match="in Node, found"):
        Encoder(CLASSES).encode(Node([value]))


# --- structures that are wrong ---------------------------------------------------------------------------


def test_the_layout_of_a_class_is_what_its_code_sets() -> None:
    stored = {"value", "next", "_asked", "_count", "name", "foreign"}
    assert layout(Node) == dict.fromkeys(stored, "")
    assert layout(Heir) == dict.fromkeys(stored | {"more"}, "")
    assert layout(Point) == {
        "x": "float",
        "name": "str",
        "tags": "tuple[int, ...]",
        "array": "np.ndarray[Any, Any] | None",
    }


POINT = [["point", layout(Point), ["x", "name", "tags", "array"]]]
NODE = ["value", "next", "_asked"]


def test_a_structure_that_is_right_is_read() -> None:
    assert decoded([["object", 0, 1.5, "a", [1], None], ["tuple", 1]], POINT) == Point(1.5, "a", (1,))


@pytest.mark.parametrize(
    ("nodes", "classes", "match"),
    [
        ([["object", 0, -1.0, "a", [1], None], ["tuple"]], POINT, "expected a number of at least 0"),
        ([["object", 0, 1.0]], POINT, "argument 2 is shorter"),
        (
            [["object", 0, 1.0]],
            [["point", {"x": "float"}, ["x"]]],
            "attributes of point in this version, found another 'name'",
        ),
        ([["object", 0, 1.0]], [["point", layout(Point) | {"x": "int"}, ["x"]]], "found another 'x'"),
        ([["object", 0, 1.0]], [["point", layout(Point) | {"y": "int"}, ["x"]]], "found another 'y'"),
        ([["object", 0, 1, 1, 1, 1]], [["node", layout(Node), [*NODE, "asked"]]], "found another 'asked'"),
        ([["object", 0, 1, 1, 1, 1]], [["node", layout(Node), [*NODE, "rename"]]], "found another 'rename'"),
        ([["object", 0]], [["os.system", {}, []]], "expected a known class"),
        ([["object", 7]], POINT, "out of range"),
        ([["tuple", [0]]], [], "recursion"),
        ([["list", [1]]], [], "out of range"),
        ([["set", [1]], ["list"]], [], "unhashable"),
        ([["dict", "a"]], [], "shorter"),
        ([["eval", "1"]], [], "eval"),
        ([["KDTree", "1", "2"]], [], "integer"),
        ([["array", "|b1", [1], [1], 0, True]], [], "flags of 0 and 1"),
        ([["array", "|O", [1], [8], 0, True]], [], "expected one of the types"),
        ([["array", "<f8", [9], [8], 0, True]], [], "inside of 64 bytes"),
        ([["array", "<f8", [8], [8], 8, True]], [], "buffer is too small|incompatible"),
        ([["array", "<f8", [2], [-8], 0, True]], [], "incompatible"),
        ([["number", 1]], [], "not subscriptable"),
        ([["nothing"]], [], "nothing"),
    ],
)
def test_a_structure_that_is_wrong_is_refused(nodes: list[Any], classes: list[Any], match: str) -> None:
    with pytest.raises((*FORMAT_ERRORS, SettingsError), match=match):
        decoded(nodes, classes, bytes([7]) * 64)
